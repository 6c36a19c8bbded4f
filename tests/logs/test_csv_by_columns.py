"""Formats that their columns alone tell: which columns are read, and what a file is told to lack, cell by cell."""

from __future__ import annotations

import pytest

from fieldcal.logs.csv.presets.by_columns import EUROC, MAVLOGDUMP, PHYPHOX, ROSTOPIC, ULOG2CSV, X_IO
from fieldcal.logs.csv.presets.layout import Layout, Meaning, Preset


def read(preset: Preset, columns: dict[str, str]) -> Meaning | str:
    """What a file with these columns means, which has those cells in its first row."""
    return preset.read(Layout(tuple(columns), (), (), tuple(columns.values()), ","))


def named(line: str) -> dict[str, str]:
    return dict.fromkeys(line.split(","), "0")


Q = named("q[0],q[1],q[2],q[3]")
POSITION = named("position[0],position[1],position[2]")
OLD_POSITION = named("x,y,z")


@pytest.mark.parametrize(
    ("sampled", "stamp"),
    [({"timestamp_sample": "5"}, "timestamp_sample")]
    + [(given, "timestamp") for given in ({"timestamp_sample": "0"}, {"timestamp_sample": ""}, {})],
)
@pytest.mark.parametrize(
    ("place", "frame", "known", "foreign"),
    [(POSITION, "pose_frame", ("1", "2"), ("0", "3", "")), (OLD_POSITION, "local_frame", ("0", "1"), ("2", "3", ""))],
)
def test_poses_of_px4_have_the_time_of_the_sample_and_a_frame_whose_z_is_down(
    sampled: dict[str, str],
    stamp: str,
    place: dict[str, str],
    frame: str,
    known: tuple[str, ...],
    foreign: tuple[str, ...],
) -> None:
    """Frames by PX4's VehicleOdometry.msg: POSE_FRAME_NED 1, FRD 2; before 1.14 LOCAL_FRAME_NED 0, FRD 1."""
    columns = {"timestamp": "6", **sampled, **Q, **place}
    for number in known:
        meaning = read(ULOG2CSV, {**columns, frame: number})
        assert isinstance(meaning, Meaning)
        assert meaning.vps == {"t": stamp, "quaternion_wxyz": tuple(Q), "position": tuple(place)}
        assert (meaning.imu, meaning.time_unit, meaning.world) == ({}, "us", "ned")
    for number in foreign:
        assert read(ULOG2CSV, {**columns, frame: number}) == f"its {frame} is {number}, not one of {', '.join(known)}"
    assert isinstance(read(ULOG2CSV, columns), str)


PX4_IMU = named(
    "timestamp,gyro_rad[0],gyro_rad[1],gyro_rad[2],accelerometer_m_s2[0],accelerometer_m_s2[1],accelerometer_m_s2[2]"
)
IMU_OF = {
    "ulog2csv": (ULOG2CSV, PX4_IMU, "us"),
    "mavlogdump": (MAVLOGDUMP, named("timestamp,TimeUS,GyrX,GyrY,GyrZ,AccX,AccY,AccZ"), "us"),
    "euroc": (
        EUROC,
        named(
            "timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],a_RS_S_x [m s^-2],"
            "a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]"
        ),
        "ns",
    ),
    "x-IMU3": (
        X_IO,
        named(
            "Timestamp (us),Gyroscope X (deg/s),Gyroscope Y (deg/s),Gyroscope Z (deg/s),Accelerometer X (g),"
            "Accelerometer Y (g),Accelerometer Z (g)"
        ),
        "us",
    ),
    "NGIMU": (
        X_IO,
        named(
            "Time (s),Gyroscope X (deg/s),Gyroscope Y (deg/s),Gyroscope Z (deg/s),Accelerometer X (g),"
            "Accelerometer Y (g),Accelerometer Z (g)"
        ),
        "s",
    ),
    "phyphox": (PHYPHOX, named("Time (s),Gyroscope x (rad/s),Gyroscope y (rad/s),Gyroscope z (rad/s)"), "s"),
    "rostopic": (
        ROSTOPIC,
        named(
            "%time,field.angular_velocity.x,field.angular_velocity.y,field.angular_velocity.z,"
            "field.linear_acceleration.x,field.linear_acceleration.y,field.linear_acceleration.z"
        ),
        "ns",
    ),
}


@pytest.mark.parametrize("name", IMU_OF)
def test_every_column_of_an_imu_is_needed_once(name: str) -> None:
    preset, columns, unit = IMU_OF[name]
    meaning = read(preset, columns)
    assert isinstance(meaning, Meaning)
    assert (meaning.time_unit, meaning.vps, meaning.gravity_sign) == (unit, {}, "specific_force")
    assert read(preset, {**columns, "another": "1"}) == meaning
    for column in columns:
        names = tuple(columns)
        lacking = preset.read(Layout(tuple(n for n in names if n != column), (), (), (), ","))
        twice = preset.read(Layout((*names, column), (), (), (), ","))
        assert isinstance(lacking, str)
        assert isinstance(twice, str)
        if name not in ("phyphox", "NGIMU"):  # any sensor does; without its time it may as well be an x-IMU3's
            assert lacking == f"it has no column {column!r}"
            assert twice == f"it has {column!r} twice"


@pytest.mark.parametrize("stamp", ["0", "", " ", " 0"])
def test_stamps_of_ros_that_were_never_filled_in_give_way_to_the_recorders(stamp: str) -> None:
    _, columns, _ = IMU_OF["rostopic"]
    for cell, time in ((stamp, "%time"), ("5", "field.header.stamp")):
        meaning = read(ROSTOPIC, {**columns, "field.header.stamp": cell})
        assert isinstance(meaning, Meaning)
        assert meaning.imu["t"] == time


@pytest.mark.parametrize("prefix", ["pose.{}", "pose.pose.{}", "transform.{}"])
def test_poses_of_ros_are_read_unless_a_twist_says_that_they_are_an_odometry(prefix: str) -> None:
    where, how = ("translation", "rotation") if "transform" in prefix else ("position", "orientation")
    place = tuple(f"field.{prefix.format(where)}.{axis}" for axis in "xyz")
    turned = tuple(f"field.{prefix.format(how)}.{axis}" for axis in "xyzw")
    columns = dict.fromkeys(("%time", *place, *turned), "0")
    meaning = read(ROSTOPIC, columns)
    assert isinstance(meaning, Meaning)
    assert meaning.vps == {"t": "%time", "quaternion_xyzw": turned, "position": place}
    assert (meaning.time_unit, meaning.world) == ("ns", "enu")
    twist = "field.twist.twist.linear.x"
    assert read(ROSTOPIC, {**columns, twist: "0"}) == f"it has a column {twist!r}, as no such file has"


def test_optional_columns_are_read_where_all_of_them_are_there() -> None:
    field = named("MagX,MagY,MagZ")
    _, columns, _ = IMU_OF["mavlogdump"]
    for more, keys in [
        ({}, set()),
        ({"T": "41"}, {"temperature"}),
        (field, {"magnetometer"}),
        ({**field, "T": "41"}, {"magnetometer", "temperature"}),
        (named("MagX,MagY"), set()),
    ]:
        meaning = read(MAVLOGDUMP, {**columns, **more})
        assert isinstance(meaning, Meaning)
        assert set(meaning.imu) - {"t", "gyroscope", "accelerometer"} == keys


def test_a_sensor_of_phyphox_needs_its_time_and_three_columns() -> None:
    for sensor, pattern in [
        ("gyroscope", "Gyroscope {} (rad/s)"), ("accelerometer", "Acceleration {} (m/s^2)"),
        ("magnetometer", "Magnetic Field {} (µT)"), ("magnetometer", "Magnetic field {} (μT)"),
    ]:  # fmt: skip
        columns = tuple(pattern.format(axis) for axis in "xyz")
        meaning = read(PHYPHOX, dict.fromkeys(("Time (s)", *columns), "0"))
        assert isinstance(meaning, Meaning)
        assert meaning.imu == {"t": "Time (s)", sensor: columns}
        for lacking in (columns, ("Time (s)", *columns[1:]), ("Time (s)",)):
            assert isinstance(read(PHYPHOX, dict.fromkeys(lacking, "0")), str)
