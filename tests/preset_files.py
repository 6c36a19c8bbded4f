"""Writers of the CSV formats that are known by name, as their exporters lay them out, from readings in SI."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

Array = np.ndarray
G = 9.80665


@dataclass(frozen=True)
class Readings:
    """An IMU and a VPS: `t_ns` (n,), `rate` (n, 3) rad/s, `force` (n, 3) m/s² (specific force), `field` (n, 3) T;
    `vps_ns` (m,), `q` (m, 4) body to a world with z up, scalar last, `position` (m, 3) m."""

    t_ns: Array
    rate: Array
    force: Array
    field: Array
    vps_ns: Array
    q: Array
    position: Array


def made(rows: int = 24, seed: int = 0) -> Readings:
    """Readings of few digits at 100 Hz."""
    rng = np.random.default_rng(seed)
    rate, force, field = np.round(rng.normal(size=(3, rows, 3)), 4)
    t_ns = 5_000_000_000 + np.arange(rows) * 10_000_000
    return Readings(
        t_ns,
        rate,
        force + np.array([0.0, 0.0, 9.0]),
        field * 1e-5,
        t_ns.copy(),
        Rotation.random(rows, rng=rng).as_quat(),
        np.round(rng.normal(size=(rows, 3)), 4),
    )


def table(names: Sequence[str], columns: Iterable[object], separator: str = ",", header: bool = True) -> str:
    """Lines of a header and rows; columns are arrays (n,) or (n, k), integers written as such, or one text for all."""
    blocks = [np.asarray(column) for column in columns]
    rows = max(len(block) for block in blocks if block.ndim)
    cells: list[list[str]] = []
    for block in blocks:
        if not block.ndim:
            cells.append([str(block)] * rows)
            continue
        columns_of = block.reshape(rows, -1).T.tolist()
        cells += [[value if isinstance(value, str) else repr(value) for value in column] for column in columns_of]
    assert len(cells) == len(names)
    lines = [separator.join(row) for row in zip(*cells, strict=True)]
    return "\n".join([separator.join(names)] * header + lines) + "\n"


def seconds(t_ns: Array) -> Array:
    """Seconds as text, whole."""
    return np.array([f"{t // 10**9}.{t % 10**9:09d}" for t in t_ns.tolist()])


def over(pattern: str, parts: Sequence[str] = ("x", "y", "z")) -> list[str]:
    return [pattern.replace("*", part) for part in parts]


XYZ, WXYZ, INDICES = ("X", "Y", "Z"), ("w", "x", "y", "z"), ("0", "1", "2")


def scalar_first(q: Array) -> Array:
    return q[:, [3, 0, 1, 2]]


# IMUs ----------------------------------------------------------------------------------------------------------------


def ulog2csv(r: Readings) -> str:
    names = ["timestamp", *over("gyro_rad[*]", INDICES), "gyro_integral_dt", "accelerometer_timestamp_relative"]
    names += [
        *over("accelerometer_m_s2[*]", INDICES),
        "accelerometer_integral_dt",
        *over("magnetometer_ga[*]", INDICES),
    ]
    return table(names, [r.t_ns // 1000, r.rate, "5000", "0", r.force, "5000", r.field * 1e4])


def mavlogdump(r: Readings) -> str:
    names = ["timestamp", "TimeUS", "I", *over("Gyr*", XYZ), *over("Acc*", XYZ), "EG", "EA", "T", "GH", "AH"]
    date = np.array([f"{1704628006 + t * 1e-9:.8f}" for t in r.t_ns.tolist()])
    return table(names, [date, r.t_ns // 1000, "0", r.rate, r.force, "0", "0", "41.5", "1", "1"])


def euroc(r: Readings) -> str:
    names = ["#timestamp [ns]", *over("w_RS_S_* [rad s^-1]"), *over("a_RS_S_* [m s^-2]")]
    return table(names, [r.t_ns, r.rate, r.force])


def phyphox(r: Readings) -> str:
    names = ["Time (s)", *over("Gyroscope * (rad/s)"), *over("Acceleration * (m/s^2)"), *over("Magnetic Field * (µT)")]
    return table([f'"{name}"' for name in names], [seconds(r.t_ns), r.rate, r.force, r.field * 1e6])


def x_imu3(r: Readings) -> str:
    names = ["Timestamp (us)", *over("Gyroscope * (deg/s)", XYZ), *over("Accelerometer * (g)", XYZ)]
    return table(names, [r.t_ns // 1000, np.degrees(r.rate), r.force / G])


def ngimu(r: Readings) -> str:
    names = ["Time (s)", *over("Gyroscope * (deg/s)", XYZ), *over("Accelerometer * (g)", XYZ)]
    names += [*over("Magnetometer * (uT)", XYZ), "Barometer (hPa)"]
    return table(names, [seconds(r.t_ns), np.degrees(r.rate), r.force / G, r.field * 1e6, "1013.0"])


def rostopic(r: Readings) -> str:
    names = ["%time", "field.header.seq", "field.header.stamp", "field.header.frame_id"]
    names += [*over("field.orientation.*", ("x", "y", "z", "w")), *over("field.orientation_covariance*", INDICES)]
    names += [*over("field.angular_velocity.*"), *over("field.linear_acceleration.*")]
    own = np.tile([0.0, 0.0, 0.0, 1.0], (len(r.t_ns), 1))
    still = np.zeros((len(r.t_ns), 3))
    return table(names, [r.t_ns + 7, r.t_ns // 10**7, r.t_ns, "imu", own, still, r.rate, r.force])


def plotjuggler(r: Readings) -> str:
    names = ["__time", *over("/imu/data/angular_velocity/*"), "/imu/data/header/seq"]
    names += [*over("/imu/data/linear_acceleration/*"), *over("/imu/data/orientation/*", ("w", "x", "y", "z"))]
    names += over("/imu/mag/magnetic_field/*")
    own = np.tile([1.0, 0.0, 0.0, 0.0], (len(r.t_ns), 1))
    return table(names, [seconds(r.t_ns), r.rate, "1", r.force, own, r.field])


def plotjuggler_px4(r: Readings) -> str:
    names = [
        "__time",
        *over("sensor_combined/accelerometer_m_s2.0*", INDICES),
        *over("sensor_combined/gyro_rad.0*", INDICES),
    ]
    return table(names, [seconds(r.t_ns), r.force, r.rate])


def blackbox_decode(r: Readings) -> str:
    names = ["loopIteration", "time (us)", "axisP[0]", "amperageLatest (A)", *over("gyroADC[*] (deg/s)", INDICES)]
    names += [*over("accSmooth[*] (g)", INDICES), "flightModeFlags (flags)"]
    count = np.arange(len(r.t_ns))
    cells = [count, r.t_ns // 1000, "3", "1.50", np.degrees(r.rate), r.force / G, "ANGLE_MODE|HEADFREE"]
    return table(names, cells, ", ")


def blackbox_explorer(r: Readings) -> str:
    """gyroScale is that of whole degrees a second, in rad/µs; Betaflight's high resolution multiplies by ten."""
    above = [("Product", "Blackbox flight data recorder by Nicholas Sherlock"), ("firmwareType", "Betaflight")]
    above += [("gyroScale", repr(np.pi / 180 * 1e-6)), ("acc_1G", "2048"), ("blackbox_high_resolution", "1")]
    above += [("rollPID", "45,80,40"), ("debug_mode", "")]
    names = [
        "loopIteration",
        "time",
        *over("gyroADC[*]", INDICES),
        *over("accSmooth[*]", INDICES),
        *over("magADC[*]", INDICES),
    ]
    count = np.arange(len(r.t_ns))
    cells = [count, r.t_ns // 1000, np.degrees(r.rate) * 10, r.force / G * 2048, np.rint(r.field * 1e8)]
    return "".join(f'"{key}","{value}"\n' for key, value in above) + table([f'"{name}"' for name in names], cells)


XSENS_ABOVE = (
    "// Start Time: Unknown\n// Update Rate: 100.0Hz\n// Filter Profile: human (46.1)\n// Firmware Version: 4.0.2\n"
)


def xsens_mt(r: Readings, fine: bool = True) -> str:
    """SampleTimeFine just before its 32 bits are full, or empty; PacketCounter before its 16 are."""
    names = ["PacketCounter", "SampleTimeFine", *over("Acc_*", XYZ), *over("Gyr_*", XYZ), *over("Mag_*", XYZ)]
    names += over("Quat_q*", ("0", "1", "2", "3"))
    packets = (65530 + np.arange(len(r.t_ns))) % 2**16
    ticks = (2**32 - 500 + (r.t_ns - r.t_ns[0]) // 100_000) % 2**32
    own = np.tile([1.0, 0.0, 0.0, 0.0], (len(r.t_ns), 1))
    return XSENS_ABOVE + table(names, [packets, ticks if fine else "", r.force, r.rate, r.field / 5e-5, own], "\t")


def xsens_packets(r: Readings) -> str:
    return xsens_mt(r, fine=False)


# poses ---------------------------------------------------------------------------------------------------------------


def euroc_poses(r: Readings) -> str:
    names = ["#timestamp [ns]", *over(" p_RS_R_* [m]"), *over(" q_RS_* []", WXYZ)]
    return table(names, [r.vps_ns, r.position, scalar_first(r.q)])


def rostopic_poses(r: Readings) -> str:
    names = ["%time", "field.header.seq", "field.header.stamp", "field.header.frame_id"]
    names += [*over("field.pose.position.*"), *over("field.pose.orientation.*", ("x", "y", "z", "w"))]
    return table(names, [r.vps_ns + 7, "1", r.vps_ns, "world", r.position, r.q])


def plotjuggler_poses(r: Readings) -> str:
    names = ["__time", *over("/quad/pose/header/*", ("seq",)), *over("/quad/pose/pose/orientation/*", WXYZ)]
    names += over("/quad/pose/pose/position/*")
    return table(names, [seconds(r.vps_ns), "1", scalar_first(r.q), r.position])


NED_FROM_ENU = Rotation.from_matrix([[0, 1, 0], [1, 0, 0], [0, 0, -1]])


def ulog2csv_poses(r: Readings) -> str:
    """PX4's world is NED."""
    names = ["timestamp", "timestamp_sample", *over("position[*]", INDICES), *over("q[*]", ("0", "1", "2", "3"))]
    names += ["pose_frame", "quality"]
    q = scalar_first((NED_FROM_ENU * Rotation.from_quat(r.q)).as_quat())
    return table(names, [r.vps_ns // 1000 + 900, r.vps_ns // 1000, NED_FROM_ENU.apply(r.position), q, "1", "100"])


def motive(r: Readings, y_up: bool = True, bodies: Sequence[str] = ("quad",), unit: str = "Centimeters") -> str:
    """One marker a body beside its pose. y up: (x, z, −y) of what z up gives."""
    turn = Rotation.from_matrix([[1, 0, 0], [0, 0, 1], [0, -1, 0]] if y_up else np.eye(3))
    above = (
        "Format Version,1.23,Take Name,Take 1,Take Notes,,Capture Frame Rate,100.000000,Export Frame Rate,100.000000,"
    )
    above += f"Total Exported Frames,{len(r.vps_ns)},Rotation Type,Quaternion,Length Units,{unit},"
    above += "Coordinate Space,Global\n\n"
    kinds, names, ids, quantities, axes = ([["", ""] for _ in range(4)]) + [["Frame", "Time (Seconds)"]]
    position = turn.apply(r.position) * {"Meters": 1, "Centimeters": 100, "Millimeters": 1000}[unit]
    cells: list[object] = [np.arange(len(r.vps_ns)), seconds(r.vps_ns)]
    for body in bodies:
        kinds += ["Rigid Body"] * 8 + ["Rigid Body Marker"] * 3
        names += [body] * 8 + [f"{body}:Marker1"] * 3
        ids += ["1"] * 11
        quantities += ["Rotation"] * 4 + ["Position"] * 3 + ["Mean Marker Error"] + ["Position"] * 3
        axes += ["X", "Y", "Z", "W", "X", "Y", "Z", "", "X", "Y", "Z"]
        cells += [(turn * Rotation.from_quat(r.q)).as_quat(), position, "0.0003", position]
    return above + "".join(",".join(row) + "\n" for row in (kinds, names, ids, quantities)) + table(axes, cells)


def motive_z_up(r: Readings) -> str:
    return motive(r, y_up=False)


def vicon(r: Readings, quaternion: bool = True, unit: str = "rad") -> str:
    """At 100 frames a second."""
    frames = np.rint((r.vps_ns - r.vps_ns[0]) / 1e7).astype(int)
    turned = Rotation.from_quat(r.q)
    rotation = ["RX", "RY", "RZ", "RW"] if quaternion else ["RX", "RY", "RZ"]
    units = [""] * 4 if quaternion else [unit] * 3
    names = ["Frame", "Sub Frame", *rotation, "TX", "TY", "TZ"]
    blank = "," * (len(names) - 3)
    above = f"{'Objects' if quaternion else 'Segments'}\n100\n,,quad:quad{blank}\n{','.join(names)}\n"
    above += ",".join(["", "", *units, "mm", "mm", "mm"]) + "\n"
    attitude = turned.as_quat() if quaternion else turned.as_rotvec()
    return above + table(names, [frames, "0", attitude, r.position * 1000], header=False)


def vicon_vectors(r: Readings) -> str:
    return vicon(r, quaternion=False)


def qualisys(r: Readings, timed: bool = True, bodies: int = 1) -> str:
    """Six degrees of freedom as TSV: a tab behind the last cell too."""
    named = [f"quad{i or ''}" for i in range(bodies)]
    above = (
        f"NO_OF_FRAMES\t{len(r.vps_ns)}\nNO_OF_CAMERAS\t4\nNO_OF_BODIES\t{bodies}\nFREQUENCY\t100\nDESCRIPTION\t--\n"
    )
    above += (
        "TIME_STAMP\t2020-01-22, 17:47:17\t22107.99179716\nDATA_INCLUDED\t6D\n"
        + "\t".join(["BODY_NAMES", *named])
        + "\n"
    )
    body = ["Y", "Z", "Roll", "Pitch", "Yaw", "Residual", *over("Rot[*]", [str(i) for i in range(9)])]
    names = [*(["Frame", "Time"] if timed else []), *(name for b in named for name in (f"{b} X", *body)), ""]
    matrices = Rotation.from_quat(r.q).as_matrix().transpose(0, 2, 1).reshape(-1, 9)
    pose: list[object] = [r.position * 1000, "0.0", "0.0", "0.0", "1.5", matrices]
    cells: list[object] = [np.arange(len(r.vps_ns)) + 1, seconds(r.vps_ns)] if timed else []
    return above + table(names, [*cells, *pose * bodies, ""], "\t")


def qualisys_by_rows(r: Readings) -> str:
    return qualisys(r, timed=False)


Writer = Callable[[Readings], str]
IMU_FILES: dict[str, tuple[str, Writer]] = {
    writer.__name__: (preset, writer)
    for preset, writer in (
        ("ulog2csv", ulog2csv),
        ("mavlogdump", mavlogdump),
        ("euroc", euroc),
        ("phyphox", phyphox),
        ("x_io", x_imu3),
        ("x_io", ngimu),
        ("rostopic", rostopic),
        ("plotjuggler", plotjuggler),
        ("plotjuggler", plotjuggler_px4),
        ("betaflight", blackbox_decode),
        ("betaflight", blackbox_explorer),
        ("xsens_mt", xsens_mt),
        ("xsens_mt", xsens_packets),
    )
}
"""Name of a writer → the preset that its files are of, and the writer."""
VPS_FILES: dict[str, tuple[str, Writer]] = {
    writer.__name__: (preset, writer)
    for preset, writer in (
        ("euroc", euroc_poses),
        ("rostopic", rostopic_poses),
        ("plotjuggler", plotjuggler_poses),
        ("ulog2csv", ulog2csv_poses),
        ("motive", motive),
        ("vicon_nexus", vicon),
        ("qualisys", qualisys),
        ("qualisys", qualisys_by_rows),
    )
}
ONLY_BY_NAME: dict[str, tuple[str, Writer]] = {
    "motive_z_up": ("motive_z_up", motive_z_up),
    "vicon_vectors": ("vicon_nexus", vicon_vectors),
}
"""Poses that are read only where the configuration asks."""
