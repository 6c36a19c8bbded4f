"""Presets, columns, units of a CSV file and the IMUs in it, small cases at their limits."""

from __future__ import annotations

import math
import struct
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from logs_support import vehicle
from scipy.spatial.transform import Rotation

from fieldcal.config.configuration import CsvMap
from fieldcal.errors import UnreadableLog
from fieldcal.logs import LogSummary, read_log
from fieldcal.logs.csv import conversion, instances
from fieldcal.logs.csv.attitude import MATRIX, quaternion_by_names
from fieldcal.logs.csv.columns import (
    IMU_DEFAULTS,
    Columns,
    attitude_columns,
    find_columns,
    known_by_names,
    no_attitude,
    signal_groups,
    without_absent,
)
from fieldcal.logs.csv.dialect import Dialect
from fieldcal.logs.csv.folder import folder_layout, optional_files
from fieldcal.logs.csv.losses import Losses
from fieldcal.logs.csv.presets.betaflight import BETAFLIGHT
from fieldcal.logs.csv.presets.by_columns import X_IO
from fieldcal.logs.csv.presets.choice import PRESETS, ReadAs, read_as
from fieldcal.logs.csv.presets.layout import Layout, Meaning, layout_of, positive
from fieldcal.logs.csv.presets.motion_capture import MOTIVE, QUALISYS, VICON_NEXUS
from fieldcal.logs.csv.presets.plotjuggler import PLOTJUGGLER
from fieldcal.logs.csv.presets.xsens import XSENS_MT
from fieldcal.reason_codes import ReasonCode


def layout(names: str, above: tuple[str, ...] = (), cells: str = "", units: str = "", separator: str = ",") -> Layout:
    def cut(text: str) -> tuple[str, ...]:
        return tuple(text.split(separator)) if text else ()

    return Layout(cut(names), cut(units), above, cut(cells), separator)


def meaning(preset: str, of: Layout) -> Meaning:
    found = PRESETS[preset].read(of)
    assert isinstance(found, Meaning), found
    return found


# presets -------------------------------------------------------------------------------------------------------------

GYRO, ACC = "gyroADC[0],gyroADC[1],gyroADC[2]", "accSmooth[0],accSmooth[1],accSmooth[2]"
EXPLORER = '"Product","Blackbox flight data recorder by Nicholas Sherlock"'


@pytest.mark.parametrize(
    ("header", "gyroscope"),
    [
        (('"gyroScale","1.7453292519943296e-8"',), 1.0),  # rad/µs
        (('"gyro_scale","0x' + struct.pack(">f", 0.0625).hex() + '"',), 0.0625),
        (('"gyro_scale","0x3d80000"',), None),
        (('"gyro_scale","0x00000000"',), None),
        (('"gyroScale","1.7453292519943296e-8"', '"gyro_scale","0x3d800000"'), 1.0),
        (('"gyroScale","1.7453292519943296e-8"', '"blackbox_high_resolution","1"'), 0.1),
        (('"gyroScale","1.7453292519943296e-8"', '"blackbox_high_resolution","0"'), 1.0),
        (('"gyroScale","1.7453292519943296e-8"', '"blackbox_high_resolution",""'), 1.0),
        (("gyroScale",), None),
    ],
)
def test_scales_of_a_blackbox(header: tuple[str, ...], gyroscope: float | None) -> None:
    above = (EXPLORER, '"acc_1G","2048"', *header)
    found = meaning("betaflight", layout(f"loopIteration,time,{GYRO},{ACC}", above))
    assert found.factors.get("gyroscope") == (None if gyroscope is None else pytest.approx(gyroscope, rel=1e-12))
    assert found.units.get("gyroscope") == ("counts" if gyroscope is None else "deg/s")
    assert (found.factors["accelerometer"], found.units["accelerometer"], found.told) == (1 / 2048, "g", "")


def test_the_explorers_readings_are_not_told_as_raw() -> None:
    assert meaning("betaflight", layout(f"loopIteration,time,{GYRO},{ACC}", (EXPLORER,))).told == ""


def test_a_blackbox_has_a_loop_a_time_and_a_gyroscope() -> None:
    whole = f"loopIteration,time (us),{GYRO},{ACC}"
    assert meaning("betaflight", layout(whole)).told == "its readings are raw, in no known unit"
    for part in ("loopIteration", "time (us)", "gyroADC[1]"):
        assert isinstance(BETAFLIGHT.read(layout(whole.replace(part, "other"))), str)
    assert isinstance(BETAFLIGHT.read(layout(f"loopIteration,time,{GYRO},{ACC}", ('"Product","Other"',))), str)


def test_cells_of_a_layout() -> None:
    of = layout("a,b,c", ("x,y", "1,2,3,4"), "5,6")
    assert [of.cell(name) for name in "abc"] == ["5", "6", ""]
    assert [of.above_cells(n) for n in (1, 2, 3)] == [["1", "2", "3"], ["x", "y", ""], ["", "", ""]]
    assert of.has("a", "c")
    assert not of.has("a", "d")
    assert not layout("a,a").has("a")
    assert [positive(text) for text in ("1.5", "0", "-1", "inf", "nan", "x", "")] == [1.5, *[None] * 6]


def test_what_is_read_of_a_file_that_fits_no_line_is_what_the_nearest_lacks() -> None:
    names = "Timestamp (us),Gyroscope X (deg/s),Gyroscope Y (deg/s),Gyroscope Z (deg/s),Accelerometer X (g)"
    assert X_IO.read(layout(names)) == "it has no column 'Accelerometer Y (g)'"
    assert X_IO.read(layout("Timestamp (us),Temperature")) == "it has no column 'Gyroscope X (deg/s)'"
    assert X_IO.read(layout("Timestamp (us),Temperature (degC),Temperature (degC)")) != X_IO.read(layout("a"))


def plotted(*topics: str, parts: str = "angular_velocity,linear_acceleration") -> str:
    return ",".join(["__time", *(f"{t}/{part}/{axis}" for t in topics for part in parts.split(",") for axis in "xyz")])


def test_of_several_topics_none_is_chosen() -> None:
    assert meaning("plotjuggler", layout(plotted("/a"))).imu["gyroscope"] == tuple(
        f"/a/angular_velocity/{a}" for a in "xyz"
    )
    assert str(PLOTJUGGLER.read(layout(plotted("/a", "/b")))).startswith("it has several IMUs, /a, /b:")
    fields = plotted("/m", parts="magnetic_field").removeprefix("__time")
    assert "magnetometer" in meaning("plotjuggler", layout(plotted("/a") + fields)).imu
    two = fields + plotted("/n", parts="magnetic_field").removeprefix("__time")
    assert "magnetometer" not in meaning("plotjuggler", layout(plotted("/a") + two)).imu
    pose = [f"{{}}/pose/{part}" for part in ("orientation/x", "orientation/y", "orientation/z", "orientation/w")]
    pose += [f"{{}}/pose/position/{axis}" for axis in "xyz"]
    poses = {name: ",".join(["__time", *(part.format(name) for part in pose)]) for name in ("/p", "/q")}
    assert meaning("plotjuggler", layout(poses["/p"])).world == "enu"
    both = poses["/p"] + poses["/q"].removeprefix("__time")
    assert str(PLOTJUGGLER.read(layout(both))).startswith("it has several poses, /p, /q:")
    assert isinstance(PLOTJUGGLER.read(layout("time," + plotted("/a"))), str)
    for estimate in ("/odometry/filtered", "/ekf/pose"):
        named_so = ",".join(["__time", *(part.format(estimate) for part in pose)])
        assert isinstance(PLOTJUGGLER.read(layout(named_so)), str)
    twist = ",/p/twist/twist/linear/x"
    assert isinstance(PLOTJUGGLER.read(layout(poses["/p"] + twist)), str)
    px4 = "__time," + ",".join(f"sensor_combined/gyro_rad.0{i}" for i in range(3))
    assert isinstance(PLOTJUGGLER.read(layout(px4)), str)
    px4 += "," + ",".join(f"sensor_combined/accelerometer_m_s2.0{i}" for i in range(3))
    assert meaning("plotjuggler", layout(px4)).body == "frd"


BODY = "X,Y,Z,Roll,Pitch,Yaw,Residual," + ",".join(f"Rot[{i}]" for i in range(9))


@pytest.mark.parametrize(
    ("above", "names", "time"),
    [
        (("DATA_INCLUDED,6D", "FREQUENCY,100"), f"Frame,Time,{BODY}", ("Time", "s", None)),
        (("DATA_INCLUDED,6D", "FREQUENCY,100"), f"Frame,{BODY}", ("Frame", None, 100.0)),
        (("DATA_INCLUDED,6D", "FREQUENCY,100"), BODY, (None, None, 100.0)),
        (("DATA_INCLUDED,6D", "FREQUENCY"), f"Frame,{BODY}", None),
        (("DATA_INCLUDED,6D", "FREQUENCY,0"), f"Frame,{BODY}", None),
        (("DATA_INCLUDED,3D",), f"Frame,Time,{BODY}", None),
        (("DATA_INCLUDED",), f"Frame,Time,{BODY}", None),
        (("DATA_INCLUDED,6D",), f"Frame,Time,{BODY},{BODY}", None),
        (("DATA_INCLUDED,6D",), f"Frame,Time,{BODY[:-7]}", None),
    ],
)
def test_times_and_bodies_of_qualisys(
    above: tuple[str, ...], names: str, time: tuple[str | None, str | None, float | None] | None
) -> None:
    of = layout(names.replace(",", "\t"), tuple(line.replace(",", "\t") for line in above), separator="\t")
    found = QUALISYS.read(of)
    if time is None:
        assert isinstance(found, str)
        return
    assert isinstance(found, Meaning)
    assert (found.vps.get("t"), found.time_unit, found.rate_hz) == time
    assert found.vps["rotation_matrix"] == tuple(f"body Rot[{i}]" for i in range(9))
    assert found.vps["position"] == ("body X", "body Y", "body Z")
    assert found.names is not None
    own = [f"body {name}" for name in ("X", "Y", "Z")], [f"body Rot[{i}]" for i in range(9)]
    before = names.split(",")[: -len(BODY.split(","))]
    assert list(found.names) == [*before, *own[0], "Roll", "Pitch", "Yaw", "Residual", *own[1]]
    assert found.metre == 1e-3


def motive_layout(first: str = "", bodies: int = 1) -> Layout:
    place = [*["Rotation"] * 4, *["Position"] * 3] * bodies
    owners = [f"b{i}" for i in range(bodies) for _ in range(7)]
    names = ["Frame", "Time (Seconds)", *["X", "Y", "Z", "W", "X", "Y", "Z"] * bodies]
    above = [f"Format Version,1.23{first}", ",".join(["", "Type", *["Rigid Body"] * 7 * bodies])]
    above += [",".join(["", "Name", *owners]), ",".join(["", "", *place])]
    return layout(",".join(names), tuple(above))


def test_units_spaces_and_bodies_of_motive() -> None:
    for first, metre in (
        ("", 1.0),
        (",Length Units,Meters", 1.0),
        (",Length Units,Centimeters", 1e-2),
        (",Length Units,Millimeters", 1e-3),
    ):
        found = meaning("motive", motive_layout(first))
        assert (found.metre, found.certain, found.world) == (metre, True, "enu")
        assert found.vps["quaternion_xyzw"] == tuple(f"b0 Rotation {axis}" for axis in "XYZW")
        assert found.vps["position"] == tuple(f"b0 Position {axis}" for axis in "XYZ")
    for first in (",Length Units,Feet", ",Rotation Type,XYZ", ",Coordinate Space,Local"):
        assert isinstance(MOTIVE.read(motive_layout(first)), str)
    assert not meaning("motive", motive_layout(bodies=2)).certain
    assert not meaning("motive_z_up", motive_layout()).certain
    assert meaning("motive_z_up", motive_layout()).world_from_logged is None
    assert meaning("motive_z_up", motive_layout(bodies=2)).told.startswith("it holds several bodies, b0, b1:")
    turn = meaning("motive", motive_layout()).world_from_logged
    assert turn is not None
    assert np.allclose(Rotation.from_quat(turn).apply([0.0, 1.0, 0.0]), [0.0, 0.0, 1.0], atol=1e-12)


def test_names_and_lines_of_motive() -> None:
    whole = motive_layout()
    found = meaning("motive", whole)
    owned = [f"b0 Rotation {axis}" for axis in "XYZW"] + [f"b0 Position {axis}" for axis in "XYZ"]
    assert found.names == ("Frame", "Time (Seconds)", *owned)
    assert found.vps["t"] == "Time (Seconds)"
    place = whole.names[:6]
    above = tuple(",".join(line.split(",")[:6]) for line in whole.above)
    turned = MOTIVE.read(Layout(place, (), above, (), ","))
    assert isinstance(turned, Meaning)
    assert set(turned.vps) == {"t", "quaternion_xyzw"}
    for names in (("Frame",), ("Frame", "Clock"), ("Row", "Time")):
        assert str(MOTIVE.read(Layout(names, (), above, (), ","))).startswith("its columns do not begin")
    for lines in (above[:1], above[:2]):
        assert MOTIVE.read(Layout(place, (), lines, (), ",")) == "it holds no rigid body"
    short = (above[0], ",Type", ",Name,b0,b0,b0,b0", above[3])
    assert MOTIVE.read(Layout(place, (), short, (), ",")) == "it holds no rigid body"
    for kinds, owners in (("Rigid Body," * 4, "b0,b0,b0"), ("Rigid Body," * 3, "b0,b0,b0,b0")):
        lines = (above[0], f",,{kinds.rstrip(',')}", f",,{owners}", above[3])
        cut = MOTIVE.read(Layout(place, (), lines, (), ","))
        assert isinstance(cut, Meaning)
        assert cut.told == "it has no rigid body with an attitude"
    marker = (above[0], above[1].replace("Rigid Body", "Marker", 1), *above[2:])
    other = MOTIVE.read(Layout(place, (), marker, (), ","))
    assert isinstance(other, Meaning)
    assert other.names is not None
    assert other.names[2:] == ("X", *(f"b0 Rotation {axis}" for axis in "YZW"))


def test_a_block_above_the_header_is_laid_out_line_by_line() -> None:
    block = b"\xef\xbb\xbfone\n\n two \nt,gx\n1,2\n"
    found = layout_of(block, Dialect(",", ".", ("t", "gx"), b"t,gx", None, 4, 2, 4), ["1", "2"])
    assert found == Layout(("t", "gx"), (), ("one", "two"), ("1", "2"), ",")
    assert layout_of(b"t\n", Dialect(",", ".", ("t",), b"t", ("s",), 1), []).units == ("s",)


def vicon_layout(names: str, owners: str, units: str, above: tuple[str, ...] = ("Objects", "120")) -> Layout:
    return layout(f"Frame,Sub Frame,{names}", (*above, f",,{owners}"), units=f",,{units}")


QUATERNION, VECTOR = "RX,RY,RZ,RW,TX,TY,TZ", "RX,RY,RZ,TX,TY,TZ"


@pytest.mark.parametrize(
    ("of", "found"),
    [
        (vicon_layout(QUATERNION, "quad,,,,,,", ",,,,mm,mm,mm"), ("quaternion_xyzw", True)),
        (vicon_layout(VECTOR, "quad,,,,,", "rad,rad,rad,mm,mm,mm"), ("rotation_vector", False)),
        (vicon_layout(VECTOR, "quad,,,,,", "deg,deg,deg,mm,mm,mm"), None),
        (vicon_layout(QUATERNION, "quad,,,,,,", ",,,,m,m,m"), None),
        (vicon_layout(QUATERNION, "quad,,,,,,", ",,,,mm,mm,mm", ("Objects", "fast")), None),
        (layout(f"Frame,{QUATERNION}", ("120", ",quad")), None),
        (vicon_layout(QUATERNION, "quad,,,,,,", ",,,,mm,mm,mm", ("120",)), ("quaternion_xyzw", True)),
        (layout(f"Frame,Sub Frame,{QUATERNION}", ("120",)), None),
    ],
)
def test_attitudes_of_vicon(of: Layout, found: tuple[str, bool] | None) -> None:
    read = VICON_NEXUS.read(of)
    if found is None:
        assert isinstance(read, str)
    else:
        assert isinstance(read, Meaning)
        assert (found[0] in read.vps, read.certain, read.rate_hz, read.metre) == (True, found[1], 120.0, 1e-3)
        assert read.vps["position"] == ("quad TX", "quad TY", "quad TZ")


def test_a_pose_without_a_place() -> None:
    found = meaning("vicon_nexus", vicon_layout("RX,RY,RZ,RW,TX", "quad,,,,", ",,,,mm"))
    assert set(found.vps) == {"t", "quaternion_xyzw"}
    turned = meaning("vicon_nexus", vicon_layout(VECTOR, "quad,,,,,", "rad,rad,rad,mm,mm,mm"))
    assert turned.told.startswith("RX, RY, RZ are taken for a rotation vector")
    two = meaning("vicon_nexus", vicon_layout(f"{QUATERNION},{QUATERNION}", "a,,,,,,,b,,,,,,", ",,,,mm,mm,mm," * 2))
    assert two.told.startswith("it holds several bodies, a, b:")


def test_times_of_xsens() -> None:
    axes = ",".join(f"{sensor}_{axis}" for sensor in ("Gyr", "Acc", "Mag") for axis in "XYZ")
    above = ("// General information", "// Update Rate: 100.5Hz", "another line")
    fine = meaning("xsens_mt", layout(f"SampleTimeFine,{axes}", above, "123"))
    assert (fine.time_unit, fine.rate_hz, fine.units["magnetometer"]) == ("100us", None, "norm")
    counted = meaning("xsens_mt", layout(f"PacketCounter,SampleTimeFine,{axes}", above, "7,"))
    assert (counted.imu["t"], counted.time_unit, counted.rate_hz) == ("PacketCounter", None, 100.5)
    for of in (layout(f"PacketCounter,{axes}", above[::2]), layout(f"PacketCounter,{axes}"), layout(axes, above)):
        assert isinstance(XSENS_MT.read(of), str)
    assert isinstance(XSENS_MT.read(layout("PacketCounter," + axes.replace("Acc_Y", "Acc"), above)), str)


def test_configured_attitudes_go_before_a_presets() -> None:
    own = Meaning(vps={"t": "t", "quaternion_xyzw": ("a", "b", "c", "d"), "position": ("x", "y", "z")}, time_unit="ms")
    read = ReadAs(PRESETS["motive"], own, frozenset({"vps"}))
    assert read.columns("vps", {}) == own.vps
    assert read.columns("vps", {"roll_pitch_yaw": ("r", "p", "w")}) == {
        "t": "t", "position": ("x", "y", "z"), "roll_pitch_yaw": ("r", "p", "w")
    }  # fmt: skip
    assert read.columns("imu", {}) == {}
    assert (read.has("vps"), read.has("imu"), ReadAs().has("vps")) == (True, False, False)
    assert (read.time_unit("vps", {}), read.time_unit("vps", {"t": "other"}), read.time_unit("imu", {})) == (
        "ms",
        None,
        None,
    )


def test_a_presets_rate_goes_first_for_a_vps_alone() -> None:
    own = Meaning(vps={"quaternion_xyzw": ("a", "b", "c", "d")}, rate_hz=120.0)
    for tables, csv, rate in (
        ({"vps"}, CsvMap(rate_hz=50.0), 120.0),
        ({"vps"}, CsvMap(rate_hz=50.0, vps={"t": "x"}), 50.0),
        ({"imu", "vps"}, CsvMap(rate_hz=50.0), 50.0),
        ({"imu", "vps"}, CsvMap(), 120.0),
    ):
        assert ReadAs(PRESETS["motive"], own, frozenset(tables)).rate_hz(csv) == rate


def test_a_preset_is_asked_for_or_recognised() -> None:
    of = motive_layout()
    names = {"tables": ("vps",), "known": (), "log_name": "log"}
    assert read_as(CsvMap(), of, **names).preset is PRESETS["motive"]
    assert read_as(CsvMap(preset="none"), of, **names).preset is None
    assert read_as(CsvMap(), of, ("vps",), ("vps",), "log").preset is None
    assert read_as(CsvMap(preset="motive_z_up"), of, **names).preset is PRESETS["motive_z_up"]
    assert read_as(CsvMap(preset="motive_z_up"), of, ("imu",), (), "log").preset is None
    with pytest.raises(UnreadableLog, match="it holds several bodies"):
        read_as(CsvMap(preset="motive"), motive_layout(bodies=2), **names)
    chosen = CsvMap(preset="motive", vps={"quaternion_xyzw": tuple(f"b1 Rotation {a}" for a in "XYZW")})
    assert read_as(chosen, motive_layout(bodies=2), **names).preset is PRESETS["motive"]


# columns -------------------------------------------------------------------------------------------------------------


def named(names: str) -> Dialect:
    return Dialect(",", ".", tuple(names.split(",")), b"", None, 1)


@pytest.mark.parametrize(
    ("names", "csv", "known"),
    [
        ("t,gx", CsvMap(), {"imu"}),
        ("t,mz [uT]", CsvMap(), {"imu"}),
        ("t,a", CsvMap(imu={"gyroscope": ("a", "b", "c")}), {"imu"}),
        ("t,qx", CsvMap(), {"vps"}),
        ("t,pose.orientation.x,pose.orientation.y,pose.orientation.z,pose.orientation.w", CsvMap(), {"vps"}),
        ("clock,qx", CsvMap(), set()),
        ("clock,qx", CsvMap(rate_hz=5.0), {"vps"}),
        ("t,a", CsvMap(rate_hz=5.0), set()),
        ("t,a", CsvMap(vps={"t": "a"}), {"vps"}),
    ],
)
def test_tables_that_names_tell(names: str, csv: CsvMap, known: set[str]) -> None:
    assert known_by_names(named(names), csv) == known


def test_a_vps_has_one_attitude() -> None:
    both = {"quaternion_xyzw": (0, 1, 2, 3), "roll_pitch_yaw": (4, 5, 6), "position": (7, 8, 9)}
    assert set(attitude_columns(named("t"), Columns(0, both)).values) == {"roll_pitch_yaw", "position"}
    scalar_first = attitude_columns(named("t"), Columns(0, {"quaternion_wxyz": (3, 0, 1, 2)}))
    assert scalar_first.values == {"quaternion_xyzw": (0, 1, 2, 3)}
    by_names = attitude_columns(named("q_w,q_x,q_y,q_z"), Columns(0, {}))
    assert by_names.values == {"quaternion_xyzw": (1, 2, 3, 0)}
    assert attitude_columns(named("a,b"), Columns(0, {"position": (0, 1, 1)})).values == {"position": (0, 1, 1)}


@pytest.mark.parametrize(
    ("names", "found"),
    [
        ("qx,qy,qz,qw", (0, 1, 2, 3)),
        ("q_w,q_x,q_y,q_z", (1, 2, 3, 0)),
        ("rot.X (-),rot.Y (-),rot.Z (-),rot.W (-)", (0, 1, 2, 3)),
        ("qx,qy,qz", None),
        ("qx,qy,qz,qw,qw", None),
        ("qx,qx,qy,qz,qw", None),
        ("qx,qy,qz,qw,rot_x,rot_y,rot_z,rot_w", None),
        ("est_q_x,est_q_y,est_q_z,est_q_w", None),
        ("wx,wy,wz,ww", None),
        ("q0,q1,q2,q3", None),
    ],
)
def test_quaternions_that_names_tell(names: str, found: tuple[int, ...] | None) -> None:
    assert quaternion_by_names(names.split(",")) == found


def test_signals_need_their_columns() -> None:
    imu = Columns(0, {"gyroscope": (1, 2, 3), "accelerometer": (4, 5, 6), "gnss_velocity_sd": (7,), "throttle": (8,)})
    for apart in (False, True):
        groups = {table: [key for key, _ in own] for table, own in signal_groups(imu, None, apart=apart)}
        inertial = {"imu": ["gyroscope", "accelerometer"]}
        expected = {"gyroscope": ["gyroscope"], "accelerometer": ["accelerometer"]} if apart else inertial
        assert groups == {
            **expected,
            "magnetometer": [],
            "temperature": [],
            "power": ["throttle"],
            "gnss_velocity": [],
            "vps": [],
        }
    vps = signal_groups(None, Columns(0, {"position": (1, 2, 3)}), apart=False)
    assert dict(vps)["vps"] == [("position", ("px_m", "py_m", "pz_m"))]


def test_columns_are_found_with_their_units_and_nearest_names_are_told() -> None:
    found = find_columns(named("t [s],gx [rad/s],gy [rad/s],gz [rad/s]"), {}, IMU_DEFAULTS, "imu", "log")
    assert found == Columns(0, {"gyroscope": (1, 2, 3)})
    for name, told in (("abxy", "nearest: 'abxy'"), ("axyz", "it has 'axyz'")):  # half the letters, and a quarter
        with pytest.raises(UnreadableLog) as refused:
            find_columns(named(name), {"gyroscope": ("abcd", "b", "c")}, IMU_DEFAULTS, "imu", "log")
        assert told in refused.value.sentence
    both = Columns(0, {"gnss_velocity": (1, 2, 3), "gnss_velocity_sd": (4,)})
    assert [key for key, _ in dict(signal_groups(both, None, apart=False))["gnss_velocity"]] == list(both.values)


def test_an_optional_column_may_be_absent() -> None:
    summary = LogSummary("csv")
    wanted = {"temperature": "warm", "throttle": "thr", "gyroscope": ("a", "b", "c"), "position": ("a", "x", "b")}
    kept = without_absent(named("a,b,c,thr,worm"), wanted, "imu", summary, "log")
    assert kept == {"throttle": "thr", "gyroscope": ("a", "b", "c")}
    assert [(finding.code, finding.count) for finding in summary.findings] == [("missing_column", 1)] * 2
    first, second = (finding.sentence for finding in summary.findings)
    assert "'warm' (csv.imu.temperature); nearest: 'worm'" in first
    assert "'x' (csv.imu.position)" in second
    listed = no_attitude(named(",".join(f"c{i:02d}" for i in range(30))), "log", "").sentence
    assert ("c19" in listed, "c20" in listed) == (True, False)


def test_angles_vectors_and_matrices_become_quaternions() -> None:
    turns = Rotation.random(5, random_state=2)
    by_angles = dict(zip(("yaw", "pitch", "roll"), turns.as_euler("ZYX", degrees=True).T, strict=True))
    by_vector = dict(zip((f"rotation_{axis}" for axis in "xyz"), turns.as_rotvec().T, strict=True))
    matrices = turns.as_matrix()
    by_matrix = {name: matrices[:, k % 3, k // 3] for k, name in enumerate(MATRIX)}
    for values, to_rad in ((by_angles, math.pi / 180), (by_vector, 1.0), (by_matrix, 1.0)):
        found = conversion.with_quaternion(values, to_rad)
        assert list(found) == ["qx", "qy", "qz", "qw"]
        q = np.column_stack(list(found.values()))
        assert np.allclose(np.abs(np.sum(q * turns.as_quat(), axis=1)), 1.0, atol=1e-12)
        assert conversion.with_quaternion(found, 1.0) == found
    still = conversion.in_world(found, (0.0, 0.0, 1.0, 0.0), 5.0)
    assert list(still) == ["qx", "qy", "qz", "qw"]


def test_matrices_that_are_no_rotation_are_no_attitude() -> None:
    turn = Rotation.from_rotvec([0.3, -0.2, 0.9])
    for scale, proper in (
        (1.0, True),
        (0.951 ** (1 / 3), True),
        (0.949 ** (1 / 3), False),
        (1.049 ** (1 / 3), True),
        (1.051 ** (1 / 3), False),
        (-1.0, False),
    ):
        matrix = scale * turn.as_matrix()
        values = {name: np.array([matrix[:, k // 3][k % 3]]) for k, name in enumerate(MATRIX)}
        found = conversion.with_quaternion({**values, "px_m": np.array([5.0])}, 1.0)
        q = np.array([found[f"q{axis}"][0] for axis in "xyzw"])
        assert np.allclose(abs(q @ turn.as_quat()), 1.0 if proper else 0.0, atol=1e-12)
        assert set(found) == {"qx", "qy", "qz", "qw", "px_m"}


def test_poses_in_another_world() -> None:
    generator = np.random.default_rng(0)
    turn, q, p = (
        Rotation.from_rotvec([0.4, 0.1, -0.7]),
        Rotation.random(5, random_state=1),
        generator.normal(size=(5, 3)),
    )
    values = {f"q{axis}": q.as_quat()[:, i] for i, axis in enumerate("xyzw")}
    values |= {f"p{axis}_m": p[:, i] for i, axis in enumerate("xyz")}
    x, y, z, w = turn.as_quat()
    moved = conversion.in_world(values, (x, y, z, w), 1e-3)
    found_p = np.column_stack([moved[f"p{axis}_m"] for axis in "xyz"])
    found_q = Rotation.from_quat(np.column_stack([moved[f"q{axis}"] for axis in "xyzw"]))
    assert np.allclose(found_p, turn.apply(p) * 1e-3, atol=1e-15)
    assert np.allclose((found_q * (turn * q).inv()).magnitude(), 0.0, atol=1e-7)
    still = conversion.in_world(values, None, 2.0)
    assert np.array_equal(still["px_m"], 2.0 * values["px_m"])
    assert np.array_equal(still["qx"], values["qx"])


@pytest.mark.parametrize(("unit", "degc"), [("degC", 20.0), ("K", 20.0 - 273.15), ("degF", (20.0 - 32.0) * 5 / 9)])
def test_temperatures_become_degrees_celsius(unit: str, degc: float) -> None:
    summary = LogSummary("csv")
    of = Dialect(",", ".", ("t", f"temp [{unit}]"), b"", None, 1)
    factor, offset = conversion.temperature_scale(of, Columns(0, {"temperature": (1,)}), summary, "log")
    assert factor * 20.0 + offset == pytest.approx(degc, abs=1e-12)
    assert [(finding.code, finding.count) for finding in summary.findings] == [("unit_converted", 1)] * (unit != "degC")


def test_units_with_a_prefix_are_converted_unless_the_configuration_has_its_own() -> None:
    for configured, found in (
        ({}, ({"accelerometer": "g"}, {"accelerometer": 1e-3})),
        ({"accelerometer": "g"}, ({"accelerometer": "mg"}, {})),
    ):
        summary = LogSummary("csv")
        assert (
            conversion.sensor_factors({"accelerometer": "mg"}, vehicle(units=configured).units, summary, "log") == found
        )
        assert [finding.count for finding in summary.findings] == [1] * len(found[1])


@pytest.mark.parametrize(
    ("unit", "row", "factor"),
    [("deg", None, math.pi / 180), ("rad", None, 1.0), ("x", ("", "deg", "deg", "deg"), math.pi / 180)],
)
def test_angles_become_radians(unit: str, row: tuple[str, ...] | None, factor: float) -> None:
    of = Dialect(",", ".", ("t", *(f"{name} [{unit}]" for name in ("roll", "pitch", "yaw"))), b"", row, 1)
    places = Columns(0, {"roll_pitch_yaw": (1, 2, 3)})
    assert conversion.radians(CsvMap(), of, places, "log") == factor
    mixed = Dialect(",", ".", ("t", "roll [deg]", "pitch [rad]", "yaw [deg]"), b"", None, 1)
    with pytest.raises(UnreadableLog, match="does not say in which unit"):
        conversion.radians(CsvMap(), mixed, places, "log")
    told = CsvMap(vps_angle_unit="rad", vps={"roll_pitch_yaw": ("roll", "pitch", "yaw")})
    assert conversion.radians(told, mixed, places, "log") == 1.0


# several IMUs --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("cells", "found"),
    [
        (["0", "1"] * 10, ["0", "1"]),  # twenty rows
        ((["0", "1"] * 10)[:19], []),
        (["a"] * 20, []),
        ([str(i % 8) for i in range(24)], list("01234567")),
        ([str(i % 9) for i in range(27)], []),
        (["0"] * 15 + ["1", "0", "1", "0", "1"], ["0", "1"]),  # five changes in twenty rows
        (["0"] * 16 + ["1", "0"] * 2, []),
        (["b", " a ", "b", "a"] * 5, ["a", "b"]),
        ([None, "0", "1"] * 10, ["0", "1"]),
    ],
)
def test_rows_of_several_imus_alternate(cells: list[str | None], found: list[str]) -> None:
    assert instances.interleaved(pl.Series(cells, dtype=pl.String)) == found


def test_names_and_rows_of_imus() -> None:
    cells = pl.Series(["b", " a", None, "b "])
    assert instances.names_in(cells) == ["a", "b"]
    assert instances.names_in(pl.Series([str(i) for i in range(10)])) == list("01234567")
    assert instances.rows_of(cells, "b").tolist() == [True, False, False, True]
    assert "there are a, b. Correct" in instances.absent_unit("log", "i", cells, "c").sentence
    assert "there are none. Correct" in instances.absent_unit("log", "i", cells[:0], "c").sentence
    assert instances.instance_column(("t", " IMU ", "i"), set()) == 2
    assert instances.instance_column(("t", " IMU ", "i"), {2}) == 1
    assert instances.instance_column(("t", "gx"), set()) is None


# what is told --------------------------------------------------------------------------------------------------------


def test_losses_of_each_kind_lose_data_but_a_repeated_header() -> None:
    losses = Losses()
    kinds = [ReasonCode.RAGGED_ROW, ReasonCode.NUL_BYTES, ReasonCode.BAD_TIME, ReasonCode.BAD_NUMBER]
    kinds += [ReasonCode.INCOMPLETE_ROW, ReasonCode.HEADER_CHANGED, ReasonCode.REPEATED_HEADER]
    for kind in kinds:
        losses.add(kind, np.array([3, 4]))
    found = {f.code: f for f in losses.findings("log", "x" * 60)}
    assert {f.code: f.loses_data for f in found.values()} == {k: k != ReasonCode.REPEATED_HEADER for k in kinds}
    assert f"'{'x' * 60}' is none" in found[ReasonCode.BAD_TIME].sentence
    assert "' is none" not in found[ReasonCode.BAD_NUMBER].sentence
    assert all("' is none" not in f.sentence for f in losses.findings("log", None))
    found = {f.code: f for f in losses.findings("log", "x" * 61)}
    assert f"'{'x' * 60}…' is none" in found[ReasonCode.BAD_TIME].sentence


def test_a_vps_that_is_not_understood_loses_data_and_the_imu_is_read(tmp_path: Path) -> None:
    rows = "".join(f"{i},1,2,3,0,0,0\n" for i in range(9))
    (tmp_path / "log.csv").write_text("t,gx,gy,gz,roll,pitch,yaw\n" + rows)
    csv = CsvMap(vps={"roll_pitch_yaw": ("roll", "pitch", "yaw")})
    frames, summary = read_log(tmp_path / "log.csv", vehicle(csv=csv))
    assert set(frames) == {"imu"}
    assert [(f.code, f.count, f.loses_data) for f in summary.findings] == [("unit_not_supported", 1, True)]


@pytest.mark.parametrize(
    ("files", "apart"),
    [
        (("imu.csv",), False),
        (("Gyroscope.csv", "Accelerometer.csv"), True),
        (("Inertial.csv",), False),
        (("Gyroscope.csv",), None),
        (("vps.csv",), None),
        ((), None),
    ],
)
def test_folders_that_are_logs(tmp_path: Path, files: tuple[str, ...], apart: bool | None) -> None:
    for name in files:
        (tmp_path / name).touch()
    found = folder_layout(tmp_path)
    assert (None if found is None else found.apart) == apart
    if found is not None:
        assert list(optional_files(tmp_path, found)) == []
        for name in ("Magnetometer.csv", "vps.csv"):
            (tmp_path / name).touch()
        expected = [("Magnetometer.csv", "imu"), ("vps.csv", "vps")]
        assert list(optional_files(tmp_path, found)) == expected[not found.optional :]
