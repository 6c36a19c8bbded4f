"""Formats that their columns alone tell: one line of exact names, the same in every file."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

from fieldcal.config.values import Paths
from fieldcal.logs.csv.presets.layout import XYZ, Layout, Meaning, Preset, axes

INDICES = ("0", "1", "2")
WXYZ = ("w", "x", "y", "z")
XYZW = ("x", "y", "z", "w")
UPPER = ("X", "Y", "Z")


@dataclass(frozen=True)
class Columns:
    """A line of columns and what it means. All of `meaning.imu` and `meaning.vps` must be there, and `beside`; none of
    `never` may. `optional`: columns of the IMU that are taken where they are there."""

    meaning: Meaning
    beside: tuple[str, ...] = ()
    never: tuple[str, ...] = ()
    optional: Mapping[str, Paths] = field(default_factory=dict)

    def read(self, layout: Layout) -> Meaning | str:
        """What a file with this layout means, or what it lacks."""
        needed = {**self.meaning.imu, **self.meaning.vps}
        wanted = [name for key in needed for name in _names(needed[key])] + list(self.beside)
        absent = [name for name in wanted if not layout.has(name)]
        if absent:
            return f"it has no column {absent[0]!r}" if absent[0] not in layout.names else f"it has {absent[0]!r} twice"
        foreign = [name for name in self.never if name in layout.names]
        if foreign:
            return f"it has a column {foreign[0]!r}, as no such file has"
        there = {key: names for key, names in self.optional.items() if layout.has(*_names(names))}
        return replace(self.meaning, imu={**self.meaning.imu, **there}) if there else self.meaning


def _names(names: Paths) -> tuple[str, ...]:
    return (names,) if isinstance(names, str) else names


def first_of(*lines: Columns) -> Callable[[Layout], Meaning | str]:
    """A reader by the first line that fits; of none, what the one nearest to the file lacks is told."""

    def read(layout: Layout) -> Meaning | str:
        found = [line.read(layout) for line in lines]
        nearest = max(range(len(lines)), key=lambda i: _known(lines[i], layout))
        return next((meaning for meaning in found if isinstance(meaning, Meaning)), found[nearest])

    return read


def _known(line: Columns, layout: Layout) -> int:
    needed = {**line.meaning.imu, **line.meaning.vps}
    return sum(layout.has(name) for names in needed.values() for name in _names(names))


SI = {"gyroscope": "rad/s", "accelerometer": "m/s^2"}
"""Units of most formats."""
BY_PX4 = "PX4 had corrected the readings by its own calibration; the .ulg tells how"


def _px4_pose(stamp: str, position: Paths) -> Meaning:
    q = axes("q[*]", ("0", "1", "2", "3"))
    return Meaning(vps={"t": stamp, "quaternion_wxyz": q, "position": position}, time_unit="us", world="ned")


_PX4_IMU = Columns(
    Meaning(
        imu={
            "t": "timestamp",
            "gyroscope": axes("gyro_rad[*]", INDICES),
            "accelerometer": axes("accelerometer_m_s2[*]", INDICES),
        },
        time_unit="us",
        units={**SI, "magnetometer": "G"},
        body="frd",
        gravity_sign="specific_force",
        told=BY_PX4,
    ),
    optional={"magnetometer": axes("magnetometer_ga[*]", INDICES)},
)
_PX4_FRAMES = {"pose_frame": ("1", "2"), "local_frame": ("0", "1")}
"""Frames whose z is down, as the topics of either generation number them."""


def _read_ulog2csv(layout: Layout) -> Meaning | str:
    """By the sample's own stamp where there is one; poses in a frame whose z is down."""
    for column, known in _PX4_FRAMES.items():
        if layout.has(column) and layout.cell(column) not in known:
            return f"its {column} is {layout.cell(column)}, not one of {', '.join(known)}"
    sampled = layout.has("timestamp_sample") and layout.cell("timestamp_sample") not in ("", "0")
    stamp = "timestamp_sample" if sampled else "timestamp"
    return first_of(
        _PX4_IMU,
        Columns(_px4_pose(stamp, axes("position[*]", INDICES)), beside=("pose_frame",)),
        Columns(_px4_pose(stamp, XYZ), beside=("local_frame",)),
    )(layout)


ULOG2CSV = Preset("ulog2csv", "PX4's ulog2csv", "both", _read_ulog2csv)
"""Topic sensor_combined; vehicle_visual_odometry and vehicle_mocap_odometry since PX4 1.14, and before. Which topic a
file is of stands in its name alone: vehicle_odometry, PX4's own estimate, has the same columns. Times are µs since
boot, quaternions scalar first, body front-right-down to a world whose z is down (PX4's message definitions)."""

MAVLOGDUMP = Preset(
    "mavlogdump",
    "ArduPilot's mavlogdump",
    "imu",
    Columns(
        Meaning(
            imu={
                "t": "TimeUS",
                "gyroscope": axes("Gyr*", UPPER),
                "accelerometer": axes("Acc*", UPPER),
            },
            time_unit="us",
            units={**SI, "magnetometer": "mgauss"},
            body="frd",
            gravity_sign="specific_force",
            told="ArduPilot had corrected the readings by its own calibration; the .bin tells how",
        ),
        beside=("timestamp",),
        optional={"temperature": "T", "magnetometer": axes("Mag*", UPPER)},
    ).read,
)
"""Message IMU: `TimeUS` is µs since boot and exact, `timestamp` a date rounded in floating point. Several IMUs stand in
one file, told apart by column I. MagX …, where MAG was merged in, is in mG."""

EUROC = Preset(
    "euroc",
    "EuRoC's ASL",
    "both",
    first_of(
        Columns(
            Meaning(
                imu={
                    "t": "timestamp [ns]",
                    "gyroscope": axes("w_RS_S_* [rad s^-1]"),
                    "accelerometer": axes("a_RS_S_* [m s^-2]"),
                },
                time_unit="ns",
                units=SI,
                gravity_sign="specific_force",
            )
        ),
        Columns(
            Meaning(
                vps={
                    "t": "timestamp [ns]",
                    "quaternion_wxyz": axes("q_RS_* []", WXYZ),
                    "position": axes("p_RS_R_* [m]"),
                },
                time_unit="ns",
                world="enu",
            ),
            never=axes("b_w_RS_S_* [rad s^-1]"),
        ),
    ),
)
"""imu0, and vicon0 or mocap0 of a motion capture system, whose world has z up. `state_groundtruth_estimate0` is none of
these: it was estimated with the IMU's help. Sensor axes are as mounted and left to the configuration."""

_PHYPHOX = (
    ("gyroscope", "Gyroscope * (rad/s)"),
    ("accelerometer", "Acceleration * (m/s^2)"),
    *(("magnetometer", f"Magnetic {field} * ({micro}T)") for field in ("Field", "field") for micro in ("µ", "μ")),
)
"""Sensor → columns. Both cases of the magnetometer's name occur, and either of the two signs that mean micro may."""


def _read_phyphox(layout: Layout) -> Meaning | str:
    """Any of the three sensors."""
    there = {sensor: axes(pattern) for sensor, pattern in _PHYPHOX if layout.has(*axes(pattern))}
    if not layout.has("Time (s)") or not there:
        return "it has not both 'Time (s)' and the three columns of a sensor, as 'Gyroscope x (rad/s)'"
    return Meaning(
        imu={"t": "Time (s)", **there},
        time_unit="s",
        units={**SI, "magnetometer": "uT"},
        gravity_sign="specific_force",
    )


PHYPHOX = Preset("phyphox", "phyphox'", "imu", _read_phyphox)
"""Times in s from the start. "Acceleration" is the one with g, as Android gives it (+g on the axis that points up);
"Linear Acceleration", without it, is not read. Axes are the phone's and left to the configuration."""

_X_IO = {
    "gyroscope": axes("Gyroscope * (deg/s)", UPPER),
    "accelerometer": axes("Accelerometer * (g)", UPPER),
}
_X_IMU3_UNITS = {"magnetometer": "counts"}
_X_IO_UNITS = {"gyroscope": "deg/s", "accelerometer": "g", "magnetometer": "uT"}
_X_IMU3 = Meaning(
    imu={"t": "Timestamp (us)", **_X_IO}, time_unit="us", units=_X_IO_UNITS, gravity_sign="specific_force"
)
X_IO = Preset(
    "x_io",
    "x-io Technologies'",
    "imu",
    first_of(
        Columns(_X_IMU3),
        *(
            Columns(
                replace(_X_IMU3, imu={"t": "Timestamp (us)", "magnetometer": axes(pattern, UPPER)}, units=_X_IMU3_UNITS)
            )
            for pattern in ("* (a.u.)", "* Axis (a.u.)")
        ),
        Columns(replace(_X_IMU3, imu={"t": "Timestamp (us)", "temperature": "Temperature (degC)"})),
        Columns(
            replace(_X_IMU3, imu={"t": "Time (s)", **_X_IO}, time_unit="s"),
            optional={"magnetometer": axes("Magnetometer * (uT)", UPPER)},
        ),
    ),
)
"""x-IMU3's Inertial.csv, Magnetometer.csv (of arbitrary unit) and Temperature.csv; NGIMU's sensors.csv. Axes are those
printed on the device and left to the configuration."""


def _ros_pose(stamp: str, position: str, orientation: str) -> Meaning:
    quaternion, place = axes(f"field.{orientation}.*", XYZW), axes(f"field.{position}.*")
    vps: dict[str, Paths] = {"t": stamp, "quaternion_xyzw": quaternion, "position": place}
    return Meaning(vps=vps, time_unit="ns", world="enu")


def _rostopic(stamp: str) -> Callable[[Layout], Meaning | str]:
    twist = ("field.twist.twist.linear.x",)
    return first_of(
        Columns(
            Meaning(
                imu={
                    "t": stamp,
                    "gyroscope": axes("field.angular_velocity.*"),
                    "accelerometer": axes("field.linear_acceleration.*"),
                },
                time_unit="ns",
                units=SI,
                body="flu",
                gravity_sign="specific_force",
            ),
            beside=("%time",),
        ),
        Columns(_ros_pose(stamp, "pose.position", "pose.orientation"), ("%time",), twist),
        Columns(_ros_pose(stamp, "pose.pose.position", "pose.pose.orientation"), ("%time",), twist),
        Columns(_ros_pose(stamp, "transform.translation", "transform.rotation"), ("%time",), twist),
    )


def _read_rostopic(layout: Layout) -> Meaning | str:
    """By the message's own stamp; by the recorder's where that was never filled in."""
    stamp = "field.header.stamp"
    if not layout.has(stamp) or layout.cell(stamp).strip() in ("", "0"):
        return _rostopic("%time")(layout)
    return _rostopic(stamp)(layout)


ROSTOPIC = Preset("rostopic", "rostopic echo -p's", "both", _read_rostopic)
"""sensor_msgs/Imu; geometry_msgs/PoseStamped, PoseWithCovarianceStamped, TransformStamped. Times in ns, units and axes
by REP 103. An Imu's orientation and an Odometry are the vehicle's own estimates, and no VPS."""
