"""PlotJuggler's CSV export: one column a plotted series, named by topic and field, one row a stamp."""

from __future__ import annotations

from collections.abc import Iterable

from fieldcal.logs.csv.presets.by_columns import BY_PX4, SI, XYZW
from fieldcal.logs.csv.presets.layout import Layout, Meaning, Preset, axes
from fieldcal.logs.messages.topics import is_estimate

TIME = "__time"
PX4_IMU = {"gyroscope": "sensor_combined/gyro_rad.0*", "accelerometer": "sensor_combined/accelerometer_m_s2.0*"}
ROS_IMU = {"gyroscope": "/angular_velocity/*", "accelerometer": "/linear_acceleration/*"}
ROS_FIELD = "/magnetic_field/*"
ROS_POSES = (("/pose/orientation/*", "/pose/position/*"), ("/transform/rotation/*", "/transform/translation/*"))


def read(layout: Layout) -> Meaning | str:
    """Of a ROS log: the one topic with an Imu's fields, the one with a MagneticField's and the one with a pose's, none
    of the vehicle's own estimates. Of a PX4 log: sensor_combined. Times are s."""
    if layout.names[:1] != (TIME,):
        return f"its first column is not {TIME!r}"
    indices = ("0", "1", "2")
    px4 = {sensor: axes(pattern, indices) for sensor, pattern in PX4_IMU.items()}
    if all(layout.has(*names) for names in px4.values()):
        return Meaning(
            imu={"t": TIME, **px4},
            time_unit="s",
            units=SI,
            body="frd",
            gravity_sign="specific_force",
            told=BY_PX4,
        )
    topics = _topics(layout, ROS_IMU.values())
    fields = _topics(layout, (ROS_FIELD,))
    poses = [(topic, q, p) for q, p in ROS_POSES for topic in _topics(layout, (q, p)) if _is_reference(layout, topic)]
    if len(topics) > 1:
        return f"it has several IMUs, {', '.join(topics)}: name the columns of one under csv.imu"
    if len(poses) > 1:
        return f"it has several poses, {', '.join(topic for topic, *_ in poses)}: name the columns of one under csv.vps"
    if not topics and not poses:
        return "it has no topic with '/angular_velocity/x' … and '/linear_acceleration/x' …, and none with a pose"
    imu = {sensor: axes(topics[0] + pattern) for sensor, pattern in ROS_IMU.items()} if topics else {}
    if topics and len(fields) == 1:
        imu["magnetometer"] = axes(fields[0] + ROS_FIELD)
    vps: dict[str, tuple[str, ...]] = {}
    for topic, orientation, position in poses:
        vps = {"quaternion_xyzw": axes(topic + orientation, XYZW), "position": axes(topic + position)}
    return Meaning(
        imu={"t": TIME, **imu} if imu else {},
        vps={"t": TIME, **vps} if vps else {},
        time_unit="s",
        units={**SI, "magnetometer": "T"},
        world="enu" if vps else None,
        body="flu",
        gravity_sign="specific_force",
    )


def _topics(layout: Layout, patterns: Iterable[str]) -> list[str]:
    """Topics that have the x, y and z of every pattern."""
    first, *others = (pattern.replace("*", "") for pattern in patterns)
    stems = [name.removesuffix(first + "x") for name in layout.names if name.endswith(first + "x")]
    whole = [
        stem for stem in stems if layout.has(*(f"{stem}{part}{axis}" for part in (first, *others) for axis in "xyz"))
    ]
    return sorted(whole)


def _is_reference(layout: Layout, topic: str) -> bool:
    """Whether a pose is no estimate of the vehicle's own: by its name, and an Odometry has a twist beside the pose."""
    odometry = f"{topic}/twist/twist/linear/x" in layout.names
    return not odometry and not is_estimate(topic)


PLOTJUGGLER = Preset("plotjuggler", "PlotJuggler's", "both", read)
"""Conventions of ROS by REP 103, of PX4 by its message definitions. Poses of PX4 are left to the configuration."""
