"""CSV formats that are known by name: each is recognised, told and read to SI; what is none is left alone."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import get_args

import numpy as np
import polars as pl
import pytest
from logs_support import vehicle
from preset_files import (
    IMU_FILES,
    ONLY_BY_NAME,
    VPS_FILES,
    XSENS_ABOVE,
    Readings,
    Writer,
    blackbox_decode,
    made,
    mavlogdump,
    motive,
    plotjuggler,
    qualisys,
    rostopic,
    ulog2csv_poses,
    vicon,
)
from scipy.spatial.transform import Rotation

from fieldcal.config.configuration import CsvMap, parse
from fieldcal.config.flight_settings import ACCELEROMETER_IN_MPS2, GYROSCOPE_IN_RADPS
from fieldcal.errors import ConfigurationError
from fieldcal.flight.inspection import inspect_as
from fieldcal.geometry.earth_field import UNIT_IN_TESLA
from fieldcal.logs.csv.dialect import find_dialect
from fieldcal.logs.csv.presets.choice import PRESETS
from fieldcal.logs.csv.presets.layout import Meaning, layout_of
from fieldcal.logs.facts import Facts
from fieldcal.logs.ingest import read_flight
from fieldcal.names import CsvPreset

DEFAULT_IMU = "t_s,gx,gy,gz,ax,ay,az\n" + "".join(f"{5 + i / 100},0.1,0.2,{i},0.3,0.4,9.8\n" for i in range(24))
IMUS = [pytest.param(preset, writer, id=name) for name, (preset, writer) in IMU_FILES.items()]
POSES = [pytest.param(preset, writer, id=name) for name, (preset, writer) in VPS_FILES.items()]
BY_NAME = [pytest.param(preset, writer, id=name) for name, (preset, writer) in ONLY_BY_NAME.items()]
READINGS = made()
DAMAGES = 20
"""Damaged files of each format; 150 each, 3,450 in all, were read without a crash once."""


def read(
    folder: Path, imu: str, vps: str | None = None, csv: CsvMap | None = None, units: dict[str, str] | None = None
) -> tuple[dict[str, pl.DataFrame], Facts]:
    """A log of `imu` alone, or of a folder with `vps`, as every command reads it."""
    if vps is None:
        path = folder / "log.csv"
        path.write_text(imu, encoding="utf-8")
    else:
        path = folder
        (path / "imu.csv").write_text(imu, encoding="utf-8")
        (path / "vps.csv").write_text(vps, encoding="utf-8")
    return read_flight(path, vehicle(csv=csv, units=units))


def told(facts: Facts) -> dict[str, str]:
    return {finding["code"]: finding["sentence"] for finding in facts["findings"]}


def triad(frame: pl.DataFrame, sensor: str) -> np.ndarray:
    return frame.select([f"{sensor}_{axis}" for axis in "xyz"]).to_numpy()


def as_made(frames: dict[str, pl.DataFrame], facts: Facts, r: Readings = READINGS) -> None:
    """The readings, whatever unit they were logged in, turned into SI."""
    assert facts["verdict"] == "ok", facts["reason"]
    imu, units = frames["imu"], facts["units"]
    np.testing.assert_allclose(triad(imu, "gyroscope") * GYROSCOPE_IN_RADPS[units["gyroscope"]], r.rate, atol=1e-12)
    force = triad(imu, "accelerometer") * ACCELEROMETER_IN_MPS2[units["accelerometer"]]
    np.testing.assert_allclose(force, r.force, rtol=1e-12)
    np.testing.assert_array_equal(np.diff(imu["t_ns"].to_numpy()), np.diff(r.t_ns))
    assert facts["gravity_sign"] == "specific_force"
    if "magnetometer" in frames:
        unit = {**UNIT_IN_TESLA, "norm": 5e-5, "counts": 1e-8}[units["magnetometer"]]
        field = triad(frames["magnetometer"], "magnetometer") * unit
        np.testing.assert_allclose(field, r.field, atol=1e-18 if units["magnetometer"] != "counts" else 5e-9)


def poses_as_made(frames: dict[str, pl.DataFrame], world: str | None, r: Readings = READINGS) -> None:
    """Poses in the world that is declared; made ones have z up."""
    turn = Rotation.from_matrix([[0, 1, 0], [1, 0, 0], [0, 0, -1]]) if world == "ned" else Rotation.identity()
    vps = frames["vps"]
    found = Rotation.from_quat(vps.select("qx", "qy", "qz", "qw").to_numpy())
    assert (found * (turn * Rotation.from_quat(r.q)).inv()).magnitude().max() < 1e-9
    np.testing.assert_allclose(vps.select("px_m", "py_m", "pz_m").to_numpy(), turn.apply(r.position), atol=1e-12)
    np.testing.assert_array_equal(np.diff(vps["t_ns"].to_numpy()), np.diff(r.vps_ns))


def recognised(text: str) -> list[str]:
    """Every preset that would take a file by itself."""
    block = text.encode()
    dialect = find_dialect(block, "log", None, None)
    first = block.split(b"\n")[dialect.first_row].decode().split(dialect.separator)
    layout = layout_of(block, dialect, [cell.strip() for cell in first])
    meanings = {name: preset.read(layout) for name, preset in PRESETS.items()}
    return [name for name, meaning in meanings.items() if isinstance(meaning, Meaning) and meaning.certain]


def test_the_configuration_offers_the_presets_that_there_are() -> None:
    assert tuple(PRESETS) == get_args(CsvPreset)
    assert all(preset.name == name for name, preset in PRESETS.items())
    assert {preset for preset, _ in (*IMU_FILES.values(), *VPS_FILES.values(), *ONLY_BY_NAME.values())} == set(PRESETS)


# recognised and read -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("preset", "writer"), IMUS)
def test_an_imu_is_recognised_told_and_read(tmp_path: Path, preset: str, writer: Writer) -> None:
    text = writer(READINGS)
    assert recognised(text) == [preset]
    frames, facts = read(tmp_path, text)
    as_made(frames, facts)
    assert f'csv.preset = "{preset}"' in told(facts)["preset"]
    assert set(told(facts)) <= {"preset", "unit_converted", "clock_wrapped"}
    assert "vps" not in frames  # what an IMU has of attitude is its own estimate
    again, by_name = read(tmp_path, text, csv=CsvMap(preset=preset))
    assert by_name == facts
    assert all(again[table].equals(frames[table]) for table in frames)


@pytest.mark.parametrize(("preset", "writer"), POSES)
def test_poses_are_recognised_told_and_read(tmp_path: Path, preset: str, writer: Writer) -> None:
    text = writer(READINGS)
    assert recognised(text) == [preset]
    frames, facts = read(tmp_path, DEFAULT_IMU, text)
    assert facts["verdict"] == "ok", facts["reason"]
    assert facts["world"] == ("ned" if preset == "ulog2csv" else "enu")
    assert "vps.csv was read as" in told(facts)["preset"]
    assert f'csv.preset = "{preset}"' in told(facts)["preset"]
    assert (facts["body"], facts["gravity_sign"]) == (None, None)  # the IMU's to say
    poses_as_made(frames, facts["world"])


@pytest.mark.parametrize(("preset", "writer"), BY_NAME)
def test_poses_that_are_read_only_by_name(tmp_path: Path, preset: str, writer: Writer) -> None:
    text = writer(READINGS)
    assert preset not in recognised(text)
    frames, facts = read(tmp_path, DEFAULT_IMU, text, CsvMap(preset=preset))
    poses_as_made(frames, facts["world"])
    assert f'csv.preset = "{preset}"' in told(facts)["preset"]


def test_what_may_be_a_format_is_told_and_not_read(tmp_path: Path) -> None:
    frames, facts = read(tmp_path, DEFAULT_IMU, vicon(READINGS, quaternion=False))
    assert "vps" not in frames
    assert 'csv.preset = "vicon_nexus" reads it so (RX, RY, RZ are taken for' in told(facts)["vps_unreadable"]


def test_one_file_with_imu_and_poses(tmp_path: Path) -> None:
    """PlotJuggler writes every topic's rows at their own stamps."""
    imu = plotjuggler(READINGS).splitlines()
    poses = VPS_FILES["plotjuggler_poses"][1](READINGS).splitlines()
    empty, none = "," * imu[0].count(","), "," * poses[0].count(",")
    rows = [
        line for a, b in zip(imu[1:], poses[1:], strict=True) for line in (a + none, b.replace(",", empty + ",", 1))
    ]
    text = "\n".join([imu[0] + poses[0].removeprefix("__time"), *rows]) + "\n"
    frames, facts = read(tmp_path, text)
    as_made(frames, facts)
    poses_as_made(frames, facts["world"])
    assert (facts["world"], facts["body"]) == ("enu", "flu")


def test_several_imus_of_one_dump_are_still_told_apart(tmp_path: Path) -> None:
    lines = mavlogdump(READINGS).splitlines()
    both = [lines[0], *(row for line in lines[1:] for row in (line, line.replace(",0,", ",1,", 1)))]
    frames, facts = read(tmp_path, "\n".join(both) + "\n")
    assert facts["reason_code"] == "several_units"
    frames, facts = read(tmp_path, "\n".join(both) + "\n", csv=CsvMap(instance="0"))
    as_made(frames, facts)
    assert frames["temperature"]["temperature_degc"].unique().to_list() == [41.5]


def test_a_magnetometer_merged_into_a_dump_is_in_milligauss(tmp_path: Path) -> None:
    """As the documentation of message MAG has it."""
    lines = mavlogdump(READINGS).splitlines()
    rows = [
        f"{line},{x!r},{y!r},{z!r}" for line, (x, y, z) in zip(lines[1:], (READINGS.field * 1e7).tolist(), strict=True)
    ]
    frames, facts = read(tmp_path, "\n".join([lines[0] + ",MagX,MagY,MagZ", *rows]) + "\n")
    as_made(frames, facts)
    assert facts["units"]["magnetometer"] == "G"


def test_stamps_that_were_never_filled_in(tmp_path: Path) -> None:
    lines = [line.split(",") for line in rostopic(READINGS).splitlines()]
    for cells in lines[1:]:
        cells[2] = "0"
    frames, _ = read(tmp_path, "\n".join(map(",".join, lines)) + "\n")
    np.testing.assert_array_equal(frames["imu"]["t_ns"].to_numpy(), READINGS.t_ns + 7)


def test_lost_poses_are_none(tmp_path: Path) -> None:
    """Motive leaves them blank; QTM writes zeros, of which no attitude may be made."""
    lines = motive(READINGS).splitlines()
    blank = lines[-3].split(",")
    lines[-3] = ",".join(blank[:2] + [""] * (len(blank) - 2))
    frames, facts = read(tmp_path, DEFAULT_IMU, "\n".join(lines) + "\n")
    assert (len(frames["vps"]), facts["verdict"]) == (len(READINGS.vps_ns) - 1, "ok")
    lines = qualisys(READINGS).splitlines()
    zeros = lines[-3].split("\t")
    lines[-3] = "\t".join(zeros[:2] + ["0.0"] * (len(zeros) - 3) + [""])
    frames, _ = read(tmp_path, DEFAULT_IMU, "\n".join(lines) + "\n")
    assert frames["vps"].row(-3)[1:5] == (0.0, 0.0, 0.0, 0.0)


def test_raw_readings_without_a_scale_stay_counts(tmp_path: Path) -> None:
    text = blackbox_decode(READINGS).replace(" (deg/s)", "").replace(" (g)", "")
    _, facts = read(tmp_path, text)
    assert (facts["units"]["gyroscope"], facts["units"]["accelerometer"]) == ("counts", "counts")
    assert "its readings are raw, in no known unit" in told(facts)["preset"]


def test_inspect_shows_the_preset(tmp_path: Path) -> None:
    (tmp_path / "log.csv").write_text(IMU_FILES["ngimu"][1](READINGS))
    shown = inspect_as(tmp_path / "log.csv", vehicle())
    assert any("read as x-io Technologies' format" in finding["sentence"] for finding in shown.findings)
    assert {sensor.unit_from for sensor in shown.sensors} == {"log"}


# left alone ----------------------------------------------------------------------------------------------------------

NEAR = [
    ("ulog2csv", lambda t: t.replace("gyro_rad[2]", "gyro_rad_2")),
    ("mavlogdump", lambda t: t.replace("timestamp,TimeUS", "time,TimeUS")),
    ("euroc", lambda t: t.replace("rad s^-1", "deg s^-1")),
    (
        "phyphox",
        lambda t: t.replace("Gyroscope", "Gyro").replace("Acceleration", "Linear Acceleration").replace("Field", "F"),
    ),
    ("x_imu3", lambda t: t.replace("Timestamp (us)", "Timestamp (ms)")),
    ("ngimu", lambda t: t.replace("(deg/s)", "(rad/s)")),
    ("rostopic", lambda t: t.replace("%time", "time")),
    ("plotjuggler", lambda t: t.replace("__time", "time")),
    ("plotjuggler_px4", lambda t: t.replace("gyro_rad.00", "gyro_rad.03")),
    ("blackbox_decode", lambda t: t.replace("loopIteration", "iteration")),
    ("blackbox_explorer", lambda t: t.replace("Blackbox flight data recorder", "Another recorder")),
    ("xsens_mt", lambda t: t.removeprefix(XSENS_ABOVE)),  # as Xsens DOT writes: other units under the same names
    ("euroc_poses", lambda t: t.replace(" q_RS_w []", " q_RS_v []")),
    ("rostopic_poses", lambda t: t.replace("field.pose.orientation.w", "field.pose.orientation")),
    ("plotjuggler_poses", lambda t: t.replace("/quad/pose", "/robot_pose_ekf/odom")),
    ("ulog2csv_poses", lambda t: t.replace(",1,100\n", ",3,100\n")),  # a frame that PX4 does not place
    ("motive", lambda t: t.replace("Quaternion", "XYZ")),
    ("motive", lambda t: t.replace("Coordinate Space,Global", "Coordinate Space,Local")),
    ("vicon", lambda t: t.replace("\n100\n", "\nrate\n")),
    ("qualisys", lambda t: t.replace("Rot[8]", "Rot")),
    ("qualisys", lambda t: t.replace("DATA_INCLUDED\t6D", "DATA_INCLUDED\t3D")),
]


@pytest.mark.parametrize(("name", "change"), NEAR, ids=[f"{i}-{name}" for i, (name, _) in enumerate(NEAR)])
def test_a_near_miss_is_no_such_file(tmp_path: Path, name: str, change: Callable[[str], str]) -> None:
    preset, writer = {**IMU_FILES, **VPS_FILES}[name]
    text = writer(READINGS)
    changed = change(text)
    assert changed != text
    assert recognised(changed) == []
    imu, vps = (changed, None) if name in IMU_FILES else (DEFAULT_IMU, changed)
    _, facts = read(tmp_path, imu, vps)
    assert "preset" not in told(facts)
    own_imu = {of: own(READINGS) for of, own in IMU_FILES.values()}.get(preset, DEFAULT_IMU)
    _, facts = read(tmp_path, imu if vps is None else own_imu, vps, CsvMap(preset=preset))
    if name in IMU_FILES:
        assert facts["reason_code"] == "preset_not_fitting"
        sentence = str(facts["reason"])
    else:  # a VPS costs nothing of the IMU
        sentence = told(facts)["vps_unreadable"]
    assert f'csv.preset = "{preset}" asks for: ' in sentence
    assert any(word in sentence for word in ("it ", "its ", "no ")), sentence


@pytest.mark.parametrize(
    "names",
    [
        "timestamp,q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z [],b_w_RS_S_x [rad s^-1]",
        "t,field.orientation.x,field.orientation.y,field.orientation.z,field.orientation.w",
        "time,roll,pitch,yaw",
    ],
)
def test_names_that_were_read_before_are_read_as_before(tmp_path: Path, names: str) -> None:
    vps = (
        names
        + "\n"
        + "".join(",".join([f"{i}", "0.5", "0.5", "0.5", "0.5", "0"][: names.count(",") + 1]) + "\n" for i in range(9))
    )
    frames, facts = read(tmp_path, DEFAULT_IMU, vps)
    without, plain = read(tmp_path, DEFAULT_IMU, vps, CsvMap(preset="none"))
    assert "preset" not in told(facts)
    assert told(facts) == told(plain)
    assert frames.keys() == without.keys()


def test_an_odometry_is_no_vps(tmp_path: Path) -> None:
    lines = VPS_FILES["rostopic_poses"][1](READINGS).replace("field.pose.", "field.pose.pose.").splitlines()
    text = "\n".join([lines[0] + ",field.twist.twist.linear.x", *(line + ",0.1" for line in lines[1:])]) + "\n"
    assert recognised(text) == []
    assert recognised("\n".join(lines) + "\n") == ["rostopic"]  # PoseWithCovarianceStamped


# the configuration goes first ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(("preset", "writer"), IMUS)
def test_configured_columns_are_read_as_before(tmp_path: Path, preset: str, writer: Writer) -> None:
    """Where the configuration names a sensor, nothing is recognised; beside a forced preset, its columns go first."""
    text = writer(READINGS)
    block = text.encode()
    dialect = find_dialect(block, "log", None, None)
    meaning = PRESETS[preset].read(
        layout_of(block, dialect, block.split(b"\n")[dialect.first_row].decode().split(dialect.separator))
    )
    assert isinstance(meaning, Meaning)
    names = {"t": meaning.imu["t"], "gyroscope": meaning.imu["accelerometer"]}
    rate = {"rate_hz": 100.0} if preset == "xsens_mt" else {}
    units = {"gyroscope": "rad/s"}
    frames, facts = read(tmp_path, text, csv=CsvMap(imu=names, time_unit=None if rate else "us", **rate), units=units)
    assert "preset" not in told(facts)
    assert frames["imu"]["accelerometer_x"].is_null().all()
    forced, facts = read(tmp_path, text, csv=CsvMap(imu={"gyroscope": names["gyroscope"]}, preset=preset), units=units)
    assert "preset" in told(facts)
    np.testing.assert_array_equal(triad(forced["imu"], "gyroscope"), triad(frames["imu"], "gyroscope"))
    factor = meaning.factors.get("accelerometer", 1.0)
    np.testing.assert_allclose(triad(forced["imu"], "accelerometer"), triad(frames["imu"], "gyroscope") * factor)


def test_configured_units_world_and_time_go_first(tmp_path: Path) -> None:
    text = IMU_FILES["x_imu3"][1](READINGS)
    frames, facts = read(tmp_path, text, csv=CsvMap(time_unit="ms"), units={"gyroscope": "rad/s", "accelerometer": "g"})
    assert facts["units"]["gyroscope"] == "rad/s"
    assert frames["imu"]["t_ns"][0] == READINGS.t_ns[0] * 1000
    np.testing.assert_allclose(triad(frames["imu"], "gyroscope"), np.degrees(READINGS.rate))
    text = IMU_FILES["blackbox_explorer"][1](READINGS)  # counts stay what they are where a unit is configured
    frames, _ = read(tmp_path, text, units={"accelerometer": "counts"})
    np.testing.assert_allclose(triad(frames["imu"], "accelerometer"), READINGS.force / 9.80665 * 2048)
    text = IMU_FILES["xsens_packets"][1](READINGS)
    frames, _ = read(tmp_path, text, csv=CsvMap(rate_hz=50.0))
    np.testing.assert_array_equal(np.diff(frames["imu"]["t_ns"].to_numpy()), 20_000_000)


def test_the_rate_of_the_imus_packets_is_not_that_of_a_vps(tmp_path: Path) -> None:
    """Unless the configuration names the VPS's time, too."""
    imu = IMU_FILES["xsens_packets"][1](READINGS)
    frames, facts = read(tmp_path, imu, vicon(READINGS), CsvMap(rate_hz=50.0))
    np.testing.assert_array_equal(np.diff(frames["imu"]["t_ns"].to_numpy()), 20_000_000)
    np.testing.assert_array_equal(np.diff(frames["vps"]["t_ns"].to_numpy()), 10_000_000)
    csv = CsvMap(rate_hz=50.0, preset="vicon_nexus", vps={"t": "Frame"})
    frames, facts = read(tmp_path, imu, vicon(READINGS), csv)
    np.testing.assert_array_equal(np.diff(frames["vps"]["t_ns"].to_numpy()), 20_000_000)
    assert len([finding for finding in facts["findings"] if finding["code"] == "preset"]) == 2


def test_no_preset(tmp_path: Path) -> None:
    _, facts = read(tmp_path, IMU_FILES["euroc"][1](READINGS), csv=CsvMap(preset="none"))
    assert facts["reason_code"] == "missing_sensor"


def test_one_of_several_bodies_is_chosen_by_the_configuration(tmp_path: Path) -> None:
    text = motive(READINGS, bodies=("wand", "quad"), unit="Meters")
    assert recognised(text) == []
    for csv in (None, CsvMap(preset="motive")):
        frames, facts = read(tmp_path, DEFAULT_IMU, text, csv)
        assert "vps" not in frames
        assert "it holds several bodies, wand, quad" in told(facts)["vps_unreadable"]
    columns = {
        "quaternion_xyzw": tuple(f"quad Rotation {axis}" for axis in "XYZW"),
        "position": tuple(f"quad Position {axis}" for axis in "XYZ"),
    }
    frames, facts = read(tmp_path, DEFAULT_IMU, text, CsvMap(preset="motive", vps=columns))
    poses_as_made(frames, facts["world"])
    _, facts = read(tmp_path, DEFAULT_IMU, qualisys(READINGS, bodies=2), CsvMap(preset="qualisys"))
    assert "it holds 2 bodies" in told(facts)["vps_unreadable"]


def test_a_first_line_as_long_as_the_rows_is_no_header(tmp_path: Path) -> None:
    lines = motive(READINGS).splitlines()
    cells = lines[-1].count(",")
    lines[0] += "," * (cells - lines[0].count(",")) if lines[0].count(",") < cells else ""
    lines[0] = ",".join(lines[0].split(",")[: cells + 1]) if lines[0].count(",") > cells else lines[0]
    frames, facts = read(tmp_path, DEFAULT_IMU, "\n".join(lines) + "\n", CsvMap(preset="motive_z_up"))
    assert len(frames["vps"]) == len(READINGS.vps_ns), told(facts)


def test_a_preset_of_poses_leaves_the_imus_file_alone(tmp_path: Path) -> None:
    _, facts = read(tmp_path, DEFAULT_IMU, csv=CsvMap(preset="motive"))
    assert (facts["verdict"], told(facts)) == ("ok", {})
    frames, facts = read(tmp_path, IMU_FILES["euroc"][1](READINGS), motive(READINGS), CsvMap(preset="motive"))
    assert [finding["code"] for finding in facts["findings"]] == ["preset", "preset"]
    as_made(frames, facts)


def test_an_older_topic_of_poses(tmp_path: Path) -> None:
    text = ulog2csv_poses(READINGS)
    for i, axis in enumerate("xyz"):
        text = text.replace(f"position[{i}]", axis)
    frames, facts = read(tmp_path, DEFAULT_IMU, text.replace("pose_frame", "local_frame"))
    poses_as_made(frames, facts["world"])


def test_an_unknown_preset_names_the_nearest() -> None:
    with pytest.raises(ConfigurationError, match=r'"Motiv" is not one of none, betaflight.*; did you mean "motive"\?$'):
        parse('[vehicles.a.csv]\npreset = "Motiv"', None)


# damage --------------------------------------------------------------------------------------------------------------


def damaged(text: str, rng: np.random.Generator) -> bytes:
    """A file cut, with bytes flipped or lost, lines swapped, or a piece doubled; mostly near the beginning."""
    data = bytearray(text.encode())
    near = len(data) if rng.uniform() < 0.3 else min(len(data), 600)
    kind = int(rng.integers(5))
    if kind == 0:
        return bytes(data[: int(rng.integers(1, len(data)))])
    if kind == 1:
        for place in rng.integers(0, near, 8).tolist():
            data[place] = int(rng.integers(256))
        return bytes(data)
    if kind == 2:
        start = int(rng.integers(near))
        del data[start : start + int(rng.integers(1, 80))]
        return bytes(data)
    if kind == 3:
        start = int(rng.integers(near))
        return bytes(data[:start] + data[start // 2 :])
    lines = bytes(data).split(b"\n")
    a, b = rng.integers(0, min(len(lines), 14), 2).tolist()
    lines[a], lines[b] = lines[b], lines[a]
    return b"\n".join(lines)


@pytest.mark.parametrize("name", [*IMU_FILES, *VPS_FILES, *ONLY_BY_NAME])
def test_damage_is_no_crash(tmp_path: Path, name: str) -> None:
    """Recognised or forced: a verdict, and a sentence where nothing is read."""
    preset, writer = {**IMU_FILES, **VPS_FILES, **ONLY_BY_NAME}[name]
    rng = np.random.default_rng(7)
    text = writer(READINGS)
    log = tmp_path / "log.csv" if name in IMU_FILES else tmp_path
    own_imu = {of: own(READINGS) for of, own in IMU_FILES.values()}.get(preset, DEFAULT_IMU)
    (tmp_path / "imu.csv").write_text(own_imu)
    for number in range(DAMAGES):
        (log if name in IMU_FILES else tmp_path / "vps.csv").write_bytes(damaged(text, rng))
        tables, facts = read_flight(log, vehicle(csv=CsvMap(preset=preset if number % 2 else None)))
        assert tables or facts["reason"]
        assert "imu" in tables or name in IMU_FILES
