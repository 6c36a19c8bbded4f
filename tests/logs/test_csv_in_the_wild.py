"""CSV logs as exporters and people write them, each kind made small: what is read, what is told, what is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import polars as pl
import pytest
from logs_support import vehicle
from scipy.spatial.transform import Rotation

from fieldcal.config.configuration import CsvMap, Vehicle, parse
from fieldcal.errors import ConfigurationError, UnreadableLog
from fieldcal.logs import LogSummary, read_log
from fieldcal.logs.csv.attitude import quaternion_by_names
from fieldcal.logs.csv.instances import interleaved
from fieldcal.logs.csv.units import angle_unit, prefixed_unit, sensor_unit, temperature_unit
from fieldcal.logs.ingest import read_flight

NAMES = "t_s,gx,gy,gz,ax,ay,az"
S = 1_000_000_000


def readings(rows: int, seed: int = 0) -> np.ndarray:
    """(rows, 6), of few digits, so that text holds them whole."""
    return np.round(np.random.default_rng(seed).normal(size=(rows, 6)), 4)


def lines(times: list[str], values: np.ndarray, header: str = NAMES) -> str:
    rows = [",".join([time, *map(repr, row)]) for time, row in zip(times, values.tolist(), strict=True)]
    return "\n".join([header, *rows]) + "\n"


def read(tmp_path: Path, text: str, of: Vehicle | None = None) -> tuple[dict[str, pl.DataFrame], LogSummary]:
    (tmp_path / "log.csv").write_text(text)
    return read_log(tmp_path / "log.csv", of or vehicle())


def codes(summary: LogSummary) -> list[str]:
    return [finding.code.value for finding in summary.findings]


def folder(tmp_path: Path, vps: str, of: Vehicle | None = None) -> tuple[dict[str, pl.DataFrame], LogSummary]:
    """A log of twenty good IMU rows beside a VPS file."""
    (tmp_path / "imu.csv").write_text(lines([f"{i / 100}" for i in range(20)], readings(20)))
    (tmp_path / "vps.csv").write_text(vps)
    frames, summary = read_log(tmp_path, of or vehicle())
    assert len(frames["imu"]) == 20
    return frames, summary


# units ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("sensor", "column", "unit"),
    [
        ("gyroscope", "w_RS_S_x [rad s^-1]", "rad/s"),
        ("gyroscope", "wx (deg·s⁻¹)", "deg/s"),
        ("accelerometer", "a_RS_S_x [m s^-2]", "m/s^2"),
        ("accelerometer", "ax (m⋅s⁻²)", "m/s^2"),
        ("magnetometer", "magx[1]", None),
        ("magnetometer", "mag(x)", None),
        ("gyroscope", "gyro_rad[0]", None),
        ("accelerometer", "accelerometer_m_s2[2]", "m/s^2"),
        ("magnetometer", "magnetometer_ga[1]", "G"),
        ("accelerometer", "ax [filtered]", None),
        ("accelerometer", "ax [furlong]", None),
        ("accelerometer", "ax_mg", "mg"),
        ("accelerometer", "ax [mg]", "mg"),
    ],
)
def test_only_units_are_units(sensor: str, column: str, unit: str | None) -> None:
    assert sensor_unit(sensor, column, None) == unit


def test_units_of_temperatures_and_angles() -> None:
    assert [temperature_unit(name, None) for name in ("temp", "temp [K]", "temp_degf", "T (°C)")] == [
        "degC",
        "K",
        "degF",
        "degC",
    ]
    assert temperature_unit("temp", "K") == "K"
    assert [angle_unit(name, None) for name in ("roll", "roll_deg", "roll [rad]", "roll (°)")] == [
        None,
        "deg",
        "rad",
        "deg",
    ]
    assert prefixed_unit("accelerometer", "mg") == ("g", 1e-3)
    assert prefixed_unit("gyroscope", "mrad s^-1") == ("rad/s", 1e-3)
    assert prefixed_unit("gyroscope", "rad/s") is None


def test_default_names_with_units_in_brackets_are_the_default_names(tmp_path: Path) -> None:
    values = readings(20)
    header = "t [ms],gx (deg/s),gy (deg/s),gz (deg/s),ax [m/s^2],ay [m/s^2],az [m/s^2]"
    frames, summary = read(tmp_path, lines([str(10 * i) for i in range(20)], values, header))
    assert (summary.units["gyroscope"], summary.units["accelerometer"]) == ("deg/s", "m/s^2")
    assert frames["imu"]["t_ns"].diff()[1] == 10_000_000
    np.testing.assert_array_equal(frames["imu"].select("gyroscope_x", "accelerometer_z"), values[:, [0, 5]])
    twice = header.replace("gz (deg/s)", "gx [rad/s]")
    with pytest.raises(UnreadableLog, match="gx"):
        read(tmp_path, lines([str(10 * i) for i in range(20)], values, twice))


def test_prefixes_and_kelvin_are_converted_and_told(tmp_path: Path) -> None:
    text = (
        "t_s,gx,gy,gz,ax,ay,az,temp\ns,mdps,mdps,mdps,mg,mg,mg,K\n0.1,1500,2,3,981,5,6,298.15\n0.2,1,2,3,4,5,6,273.15\n"
    )
    frames, summary = read(tmp_path, text)
    assert frames["imu"]["gyroscope_x"][0] == pytest.approx(1.5, rel=1e-12)
    assert frames["imu"]["accelerometer_x"][0] == pytest.approx(0.981, rel=1e-12)
    assert frames["temperature"]["temperature_degc"].to_list() == pytest.approx([25.0, 0.0], abs=1e-9)
    assert (summary.units["gyroscope"], summary.units["accelerometer"]) == ("deg/s", "g")
    assert codes(summary) == ["unit_converted"] * 3
    frames, summary = read(tmp_path, text, vehicle(units={"gyroscope": "deg/s", "accelerometer": "counts"}))
    assert frames["imu"].row(0)[1:5] == (1500.0, 2.0, 3.0, 981.0)
    assert codes(summary) == ["unit_converted"]
    frames, _ = read(tmp_path, "t_s,gx,gy,gz,temp\ns,dps,dps,dps,°F\n0.1,1,2,3,212\n")
    assert frames["temperature"]["temperature_degc"][0] == pytest.approx(100.0, abs=1e-9)


# header --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("comma", [False, True])
def test_a_preamble_is_passed_over_and_told(tmp_path: Path, comma: bool) -> None:
    values = readings(40)
    times = [f"{i / 100}" for i in range(40)]
    preamble = '"Product","Blackbox"\n"looptime","125"\n' + "".join(f'"key{i}","{i}"\n' for i in range(100 * comma))
    frames, summary = read(tmp_path, preamble + '"rollPID","45,80,40"\n' + lines(times, values))
    assert frames["imu"].select(pl.exclude("t_ns")).to_numpy().tolist() == values.tolist()
    above = 3 + 100 * comma
    assert [(f.code, f.count, f.loses_data) for f in summary.findings] == [("preamble", above, False)]
    assert f"line {above + 1} is taken for the header" in summary.findings[0].sentence


def test_a_title_units_below_the_header_and_slashes(tmp_path: Path) -> None:
    values = readings(30)
    rows = lines([f"{i / 100}" for i in range(30)], values).splitlines()
    text = "\n".join(
        ["// start", "Segments", "120", "// a", rows[0], "s,dps,dps,dps,g,g,g", *rows[1:9], "// b", *rows[9:]]
    )
    frames, summary = read(tmp_path, text + "\n")
    assert frames["imu"].select(pl.exclude("t_ns")).to_numpy().tolist() == values.tolist()
    assert summary.units["gyroscope"] == "deg/s"
    assert [(f.code, f.count) for f in summary.findings] == [("preamble", 2)]
    assert "line 5 " in summary.findings[0].sentence


def test_rows_that_no_names_stand_above_have_no_preamble(tmp_path: Path) -> None:
    with pytest.raises(UnreadableLog) as refused:
        read(tmp_path, "title\n" + "0.1,1,2,3,4,5,6\n" * 30)
    assert refused.value.reason_code == "missing_sensor"


@pytest.mark.parametrize("configured", [None, ","])
def test_decimal_commas_in_quotes(tmp_path: Path, configured: str | None) -> None:
    values = readings(30)
    rows = [
        ",".join(f'"{str(cell).replace(".", ",")}"' for cell in [f"{i / 100:.2f}", *row])
        for i, row in enumerate(values.tolist())
    ]
    csv = CsvMap.model_validate({"decimal": configured} if configured else {})
    frames, summary = read(tmp_path, "\n".join([NAMES, *rows]) + "\n", vehicle(csv=csv))
    assert frames["imu"].select(pl.exclude("t_ns")).to_numpy().tolist() == values.tolist()
    assert frames["imu"]["t_ns"].to_list() == [i * 10_000_000 for i in range(30)]
    assert codes(summary) == []


def test_a_decimal_comma_without_quotes_is_refused_and_no_crash(tmp_path: Path) -> None:
    csv = CsvMap(decimal=",", separator=",")
    with pytest.raises(UnreadableLog) as refused:
        read(tmp_path, NAMES + "\n" + "0,1,1,2,2,3,3,4,4,5,5,6,6,7\n" * 20, vehicle(csv=csv))
    assert refused.value.reason_code == "ragged_rows"


# clock ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("unit", "tick_ns", "period"),
    [
        *(("ms", 1_000_000, 2**bits) for bits in (16, 24, 32)),
        *(("us", 1000, 2**bits) for bits in (24, 31, 32)),
        ("s", S, 86_400),
        ("s", S, 604_800),
        ("ms", 1_000_000, 86_400_000),
    ],
)
def test_a_clock_that_begins_again_goes_on(tmp_path: Path, unit: str, tick_ns: int, period: int) -> None:
    """Four seconds before and after the end of the counter, 200 Hz."""
    true_ns = period * tick_ns + np.arange(-800, 800) * 5_000_000
    cells = [f"{t // tick_ns}.{(t % tick_ns) * S // tick_ns:09d}" for t in (true_ns % (period * tick_ns)).tolist()]
    frames, summary = read(tmp_path, lines(cells, readings(1600), NAMES.replace("t_s", f"t_{unit}")))
    assert frames["imu"]["t_ns"].to_list() == true_ns.tolist()
    assert [(f.code, f.count) for f in summary.findings] == [("clock_wrapped", 1)]
    assert f"began again 1 time(s) after {period * tick_ns / S:.3f} s" in summary.findings[0].sentence


@pytest.mark.parametrize("bits", [8, 12, 16])
@pytest.mark.parametrize("block_bytes", [300, 1 << 22])
def test_sample_numbers_of_any_width(
    tmp_path: Path, bits: int, block_bytes: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fieldcal.logs.csv.text.BLOCK_BYTES", block_bytes)
    true = 2**bits - 300 % 2**bits + np.arange(700)
    true = np.delete(true, [50, 51, 400])  # packets that were lost
    csv = CsvMap(rate_hz=100.0, imu={"t": "counter"})
    text = lines([str(n) for n in (true % 2**bits).tolist()], readings(len(true)), NAMES.replace("t_s", "counter"))
    frames, summary = read(tmp_path, text, vehicle(csv=csv))
    assert np.diff(frames["imu"]["t_ns"].to_numpy()).tolist() == (np.diff(true) * 10_000_000).tolist()
    assert codes(summary) == ["clock_wrapped"]


def test_a_vps_whose_clock_begins_again_at_another_moment(tmp_path: Path) -> None:
    """The IMU's file is all before midnight; the VPS's goes over it, in time of day."""
    vps = ["t,qx,qy,qz,qw"]
    vps += [f"23:59:5{i}.5,0,0,0,1" for i in range(10)] + [f"0:00:0{i}.5,0,0,0,1" for i in range(10)]
    frames, summary = folder(tmp_path, "\n".join(vps) + "\n")
    assert frames["vps"]["t_ns"].to_list() == [(86_390 + i) * S + S // 2 for i in range(20)]
    assert codes(summary) == ["clock_wrapped"]


@pytest.mark.parametrize(("pause_s", "wraps"), [(600, True), (601, False)])
def test_a_pause_over_midnight(tmp_path: Path, pause_s: int, wraps: bool) -> None:
    true_s = np.r_[86_390:86_398, 86_397 + pause_s + np.arange(20)]
    frames, _ = read(tmp_path, lines([str(t % 86_400) for t in true_s.tolist()], readings(28)))
    assert (frames["imu"]["t_ns"].to_list() == (true_s * S).tolist()) == wraps


def test_late_rows_about_the_turn_stay_beside_their_neighbours(tmp_path: Path) -> None:
    true_ms = 2**24 + 5 * np.arange(-200, 200)
    true_ms[[199, 200]] = true_ms[[200, 199]]
    frames, summary = read(
        tmp_path, lines([str(t) for t in (true_ms % 2**24).tolist()], readings(400), NAMES.replace("t_s", "t_ms"))
    )
    assert frames["imu"]["t_ns"].to_list() == np.sort(true_ms * 1_000_000).tolist()
    assert codes(summary) == ["clock_wrapped"]


@pytest.mark.parametrize("late", [17, 20, 24, 25])
def test_a_late_row_near_the_start_is_no_turn_of_a_small_counter(tmp_path: Path, late: int) -> None:
    """The first row comes behind one of nearly 256 ms."""
    t_ms = 10 * np.r_[1:late, 0, late:60]
    frames, summary = read(tmp_path, lines([str(t) for t in t_ms.tolist()], readings(60), NAMES.replace("t_s", "t_ms")))
    assert frames["imu"]["t_ns"].to_list() == [10_000_000 * i for i in range(60)]
    assert codes(summary) == []


def test_a_counter_of_an_unknown_period_is_refused_with_it_until_it_is_given(tmp_path: Path) -> None:
    true = 35.0 + np.arange(500) / 100
    text = lines([f"{t % 37.5:.2f}" for t in true], readings(500))
    _, facts = read_flight_of(tmp_path, text, vehicle())
    assert (facts["verdict"], facts["reason_code"]) == ("quarantined", "clock_reset")
    assert "after 37.490 s" in str(facts["reason"])
    frames, facts = read_flight_of(tmp_path, text, vehicle(csv=CsvMap(clock_period_s=37.5)))
    assert frames["imu"]["t_ns"].to_list() == np.rint(true * 100).astype(int).__mul__(10_000_000).tolist()
    assert facts["verdict"] == "ok"


def read_flight_of(tmp_path: Path, text: str, of: Vehicle) -> tuple[dict[str, pl.DataFrame], dict[str, object]]:
    (tmp_path / "log.csv").write_text(text)
    frames, facts = read_flight(tmp_path / "log.csv", of)
    return frames, dict(facts)


def test_times_of_day_and_cells_that_are_no_time(tmp_path: Path) -> None:
    text = "t,gx,gy,gz\n13:45:01.000001,1,2,3\n13:45:01.5,1,2,3\n 9:00:00 ,1,2,3\n24:00:00,1,2,3\nnoon,1,2,3\n"
    frames, summary = read(tmp_path, text)
    day = [(13 * 60 + 45) * 60 * S + S + 1000, (13 * 60 + 45) * 60 * S + 3 * S // 2, 9 * 3600 * S]
    assert sorted(frames["imu"]["t_ns"].to_list()) == sorted(day)
    assert [(f.code, f.count) for f in summary.findings] == [("bad_time", 2)]
    assert "'24:00:00' is none: times are numbers, ISO 8601 or HH:MM:SS" in summary.findings[0].sentence


@pytest.mark.parametrize(
    ("header", "csv", "seconds"),
    [
        ("Time (Seconds)", {"time_unit": "us"}, 2.0),
        ("time", {"time_unit": "us"}, 2e-6),
        ("time", {"time_unit": "us", "vps_time_unit": "ms"}, 2e-3),
        ("t_s", {"vps_time_unit": "ms"}, 2e-3),
    ],
)
def test_the_unit_of_a_vps_time(tmp_path: Path, header: str, csv: dict[str, str], seconds: float) -> None:
    of = vehicle(csv=CsvMap.model_validate({**csv, "vps": {"t": header}}))
    frames, _ = folder(tmp_path, f"{header},qx,qy,qz,qw\n2,0,0,0,1\n", of)
    assert frames["vps"]["t_ns"].to_list() == [round(seconds * 1e9)]


# rows ----------------------------------------------------------------------------------------------------------------


def apart(gaps: set[int] = frozenset()) -> str:
    """Gyroscope at 100 Hz, accelerometer (a ramp of time) 3 ms later, magnetometer 5 ms later; rows of their own."""
    rows = []
    for i in range(60):
        t_ms = 10 * i
        rows.append(f"{t_ms},{i},{2 * i},{3 * i},,,,,,")
        if i not in gaps:
            rows.append(f"{t_ms + 3},,,,{t_ms + 3},{2 * (t_ms + 3)},9.8,,,")
        rows.append(f"{t_ms + 5},,,,,,,1,2,{i}")
    return "\n".join(["t_ms,gx,gy,gz,ax,ay,az,mx,my,mz", *rows]) + "\n"


def test_sensors_in_rows_of_their_own_are_joined_on_the_gyroscopes_stamps(tmp_path: Path) -> None:
    frames, summary = read(tmp_path, apart())
    t_ms = np.arange(10, 600, 10)
    assert frames["imu"]["t_ns"].to_list() == (t_ms * 1_000_000).tolist()
    assert frames["imu"]["gyroscope_z"].to_list() == (0.3 * t_ms).round().tolist()
    np.testing.assert_allclose(frames["imu"]["accelerometer_x"], t_ms, rtol=1e-12)
    np.testing.assert_allclose(frames["imu"]["accelerometer_y"], 2 * t_ms, rtol=1e-12)
    assert frames["magnetometer"]["t_ns"].to_list() == [(10 * i + 5) * 1_000_000 for i in range(60)]
    assert [(f.code, f.count, f.loses_data) for f in summary.findings] == [("sensors_joined", 59, False)]
    assert "at most 0.04 s apart. 1 gyroscope readings" in summary.findings[0].sentence
    assert summary.counts == {"imu": 59, "magnetometer": 60}


def test_nothing_is_interpolated_over_more_than_four_readings(tmp_path: Path) -> None:
    """Readings of 10 ms are missing three times (an interval of 40 ms) and four times (50 ms)."""
    frames, summary = read(tmp_path, apart({10, 11, 12, 30, 31, 32, 33}))
    left_out = sorted({*range(10, 600, 10)} - {t // 1_000_000 for t in frames["imu"]["t_ns"].to_list()})
    assert left_out == [300, 310, 320, 330, 340]
    assert summary.findings[0].loses_data


def test_a_slower_accelerometer_in_the_gyroscopes_rows_is_joined_too(tmp_path: Path) -> None:
    rows = [f"{i / 100},1,2,3," + (f"{i / 100},0,9.8" if i % 4 == 0 else ",,") for i in range(80)]
    frames, summary = read(tmp_path, "\n".join([NAMES, *rows]) + "\n")
    np.testing.assert_allclose(frames["imu"]["accelerometer_x"], frames["imu"]["t_ns"] * 1e-9, atol=1e-12)
    assert (len(frames["imu"]), codes(summary)) == (76, ["sensors_joined"])


def two_imus(column: str = "I") -> str:
    rows = [f"{i / 200},{i % 2},{10 * (i % 2) + i},2,3,4,5,6" for i in range(60)]
    return "\n".join([f"t_s,{column},gx,gy,gz,ax,ay,az", *rows]) + "\n"


def test_two_imus_in_one_file_are_refused_or_split(tmp_path: Path) -> None:
    with pytest.raises(UnreadableLog) as refused:
        read(tmp_path, two_imus())
    assert refused.value.reason_code == "several_units"
    assert "column 'I': 0, 1. Choose the primary one: set csv.instance to '0' or '1'" in refused.value.sentence
    for chosen in (0, 1):
        frames, summary = read(tmp_path, two_imus(), vehicle(csv=CsvMap(instance=str(chosen))))
        assert frames["imu"]["gyroscope_x"].to_list() == [10 * chosen + i for i in range(chosen, 60, 2)]
        assert frames["imu.1"]["gyroscope_x"].to_list() == [10 * (1 - chosen) + i for i in range(1 - chosen, 60, 2)]
        assert codes(summary) == ["further_units"]
    csv = CsvMap(instance="1", imu={"instance": "which"})
    frames, _ = read(tmp_path, two_imus("which"), vehicle(csv=csv))
    assert len(frames["imu"]) == 30
    frames, _ = read(tmp_path, two_imus("which"))
    assert len(frames["imu"]) == 60


def test_an_instance_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(UnreadableLog) as refused:
        read(tmp_path, two_imus(), vehicle(csv=CsvMap(instance="2")))
    assert refused.value.reason_code == "several_units"
    assert "No row" in refused.value.sentence


def test_what_changes_seldom_tells_no_imus_apart() -> None:
    alternating = pl.Series(["a", "b"] * 20)
    assert interleaved(alternating) == ["a", "b"]
    assert interleaved(pl.Series(["a"] * 20 + ["b"] * 20)) == []
    assert interleaved(pl.Series([str(i) for i in range(40)])) == []
    assert interleaved(alternating[:19]) == []
    assert interleaved(alternating[:20]) == ["a", "b"]


@pytest.mark.parametrize(("units", "told"), [(2, True), (8, True), (9, False)])
def test_eight_imus_are_the_most_that_are_told_apart(units: int, told: bool) -> None:
    names = [f"imu{i}" for i in range(units)]
    assert interleaved(pl.Series(names * 10)) == (names if told else [])


@pytest.mark.parametrize(("switches", "told"), [(8, False), (9, True)])
def test_imus_alternate_where_more_than_a_fifth_of_the_rows_is_another_s(switches: int, told: bool) -> None:
    """Of forty rows with a name; blanks and rows without one do not count."""
    held = [name for i in range(switches) for name in ["a", "b"][i % 2]]
    rows = held + [["a", "b"][switches % 2]] * (40 - switches)
    cells = pl.Series([f" {name} " for name in rows] + [None] * 100)
    assert interleaved(cells) == (["a", "b"] if told else [])


# visual positioning system -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "vps",
    [
        "time,roll,pitch,yaw\n0,0,0,1\n1,0,0,1\n",
        "t_s,q0,q1,q2,q3\n0,1,0,0,0\n",
        "Segments\n120\nFrame,Sub Frame,RX,RY,RZ,TX\n,,rad,rad,rad,mm\n" + "1,0,.1,.2,.3,4\n" * 9,
        "t_s,px,py,pz\n0,1,2,3\n",
    ],
)
def test_a_vps_that_is_not_understood_is_told_with_its_columns(tmp_path: Path, vps: str) -> None:
    frames, summary = folder(tmp_path, vps)
    assert "vps" not in frames
    assert codes(summary) == ["vps_unreadable"]
    sentence = summary.findings[0].sentence
    names = next(line for line in vps.splitlines() if line.count(",") > 2).split(",")
    assert "no known quaternion columns; it has " + ", ".join(names) in sentence
    assert "csv.vps.quaternion_xyzw" in sentence


@pytest.mark.parametrize("unit", ["deg", "rad"])
def test_declared_angles_give_the_attitude(tmp_path: Path, unit: str) -> None:
    angles = np.random.default_rng(2).uniform(-170, 170, (30, 3))
    angles[:, 1] /= 2
    truth = Rotation.from_euler("ZYX", angles[:, ::-1], degrees=True)
    written = angles if unit == "deg" else np.radians(angles)
    rows = [f"{i / 10},{r!r},{p!r},{y!r}" for i, (r, p, y) in enumerate(written.tolist())]
    names = {"roll_pitch_yaw": ("roll", "pitch", "yaw")}
    text = "\n".join(["t_s,roll,pitch,yaw", *rows]) + "\n"
    frames, summary = folder(tmp_path, text, vehicle(csv=CsvMap(vps=names, vps_angle_unit=unit)))
    found = Rotation.from_quat(frames["vps"].select("qx", "qy", "qz", "qw").to_numpy())
    assert (found * truth.inv()).magnitude().max() < 1e-12
    assert codes(summary) == []
    _, summary = folder(tmp_path, text, vehicle(csv=CsvMap(vps=names)))
    assert codes(summary) == ["vps_unreadable"]
    assert "Set csv.vps_angle_unit" in summary.findings[0].sentence
    frames, _ = folder(
        tmp_path,
        "\n".join([f"t_s,roll_{unit},pitch_{unit},yaw_{unit}", *rows]) + "\n",
        vehicle(csv=CsvMap(vps={"roll_pitch_yaw": tuple(f"{name}_{unit}" for name in ("roll", "pitch", "yaw"))})),
    )
    assert len(frames["vps"]) == 30


@pytest.mark.parametrize(
    ("names", "places"),
    [
        ("t,q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z []", (2, 3, 4, 1)),
        ("t,pose.orientation.x,pose.orientation.y,pose.orientation.z,pose.orientation.w", (1, 2, 3, 4)),
        ("Quat W,Quat X,Quat Y,Quat Z,t", (1, 2, 3, 0)),
        ("t,q0,q1,q2,q3", None),
        ("t,x,y,z,w", None),
        ("t,qx,qy,qz", None),
        ("a_q_x,a_q_y,a_q_z,a_q_w,b_q_x,b_q_y,b_q_z,b_q_w", None),
        ("t,seq_x,seq_y,seq_z,seq_w", None),
    ],
)
def test_quaternions_by_their_names(names: str, places: tuple[int, ...] | None) -> None:
    assert quaternion_by_names(names.split(",")) == places


def test_a_scalar_first_quaternion_that_is_declared(tmp_path: Path) -> None:
    csv = CsvMap(vps={"quaternion_wxyz": ("q0", "q1", "q2", "q3")})
    frames, _ = folder(tmp_path, "t_s,q0,q1,q2,q3\n0,0.5,0.1,0.7,0.5\n", vehicle(csv=csv))
    assert frames["vps"].row(0)[1:5] == (0.1, 0.7, 0.5, 0.5)


def test_a_configured_vps_that_the_imus_file_lacks_costs_nothing_else(tmp_path: Path) -> None:
    csv = CsvMap(vps={"quaternion_xyzw": ("a", "b", "c", "d")}, imu={"temperature": "degrees"})
    frames, summary = read(tmp_path, lines(["0.1", "0.2"], readings(2)), vehicle(csv=csv))
    assert (len(frames["imu"]), list(frames)) == (2, ["imu"])
    assert codes(summary) == ["missing_column", "missing_column"]


# configuration -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("separator = '.'", "stands in numbers"),
        ("vps = { quaternion_xyzw = ['a','b','c','d'], roll_pitch_yaw = ['e','f','g'] }", "one attitude"),
        ("vps_angle_unit = 'deg'", "needs csv.vps.roll_pitch_yaw"),
        ("imu = { gyroscope = ['a','b','c'], accelerometer = ['c','d','e'] }", '"c" cannot be gyroscope and accel'),
        ("imu = { t = 'a', temperature = 'a' }", '"a" cannot be t and temperature'),
        ("clock_period_s = 0.0", "above zero"),
        ("vps_time_unit = 'days'", "days"),
    ],
)
def test_a_configuration_that_contradicts_itself(text: str, told: str) -> None:
    with pytest.raises(ConfigurationError, match=told):
        parse(f"[defaults.csv]\n{text}\n", None)
