"""The field of motors: found exactly where it is, no more often than claimed where it is not, told and refused from
the log to the verdict."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
from logs_support import vehicle
from mcap_ros2.writer import Writer as Ros2Writer
from numerics_support import autoregressive
from scipy.spatial.transform import Rotation

import fieldcal
from fieldcal.config.configuration import CsvMap, McapMap
from fieldcal.estimation import motor_field as numerics
from fieldcal.estimation.motor_field import (
    FATAL_SHARE,
    REPORTED_SHARE,
    SIGNIFICANT_P,
    MotorField,
    motor_fault,
    motor_field,
)
from fieldcal.logs import read_log
from fieldcal.logs.encodings.ros2_definitions import full_text
from fieldcal.simulation.archive import write_flights
from fieldcal.simulation.experiment import Experiment, simulate

DIP_RAD = 1.0
FIELD_UT = 48.0
NOISE = 0.01  # of the field: what a calibrated magnetometer's length scatters by in flight
HONEST_ALARMS = 0.02
"""Share of flights with an independent current that may be told of one although residual and current both remember a
fifth of the flight: no test knows its own number of independent samples better than that."""

SLOPE_UT_PER_A = np.array([0.09, -0.05, 0.12])


@cache
def field_ut() -> np.ndarray:
    """The local field in sensor axes along the simulated manoeuvre, (n, 3)."""
    attitude = Rotation.from_quat(simulate(seed=21, dip_rad=DIP_RAD, vps=False).q[::8])
    return np.asarray(FIELD_UT * attitude.inv().apply([np.cos(DIP_RAD), 0.0, np.sin(DIP_RAD)]))


def current_a(seed: int, n: int, memory: float) -> np.ndarray:
    """A current about 20 A with a coloured part of 5 A rms."""
    return np.abs(20.0 + 5.0 * autoregressive(np.random.default_rng([1, seed]), (n,), memory))


def found(field: np.ndarray, drive: np.ndarray) -> MotorField:
    result = motor_field(field, drive, FIELD_UT)
    assert result is not None
    return result


# the numerics --------------------------------------------------------------------------------------------------------


def test_the_slope_is_exact_whatever_hard_and_soft_iron_is_left() -> None:
    h, current = field_ut(), current_a(0, len(field_ut()), 0.99)
    added = h + np.outer(current - current.mean(), SLOPE_UT_PER_A)
    iron = np.array([[1.03, 0.01, -0.02], [0.01, 0.98, 0.0], [-0.02, 0.0, 1.01]])
    result = found((added - [1.0, -2.0, 0.5]) @ np.linalg.inv(iron).T, current)
    np.testing.assert_allclose(result.slope, SLOPE_UT_PER_A, rtol=1e-6)
    span = np.ptp(np.percentile(current, [1.0, 99.0]))
    assert result.span == pytest.approx(span)
    assert result.share == pytest.approx(np.linalg.norm(SLOPE_UT_PER_A) * span / FIELD_UT, rel=1e-6)
    assert result.correlation == pytest.approx(1.0, abs=1e-6)


def test_turning_the_sensor_turns_the_slope_and_the_unit_of_the_field_scales_it() -> None:
    h, current = field_ut(), current_a(1, len(field_ut()), 0.99)
    noisy = h + np.outer(current, SLOPE_UT_PER_A) + NOISE * FIELD_UT * np.random.default_rng(1).normal(size=h.shape)
    straight, turn = found(noisy, current), Rotation.from_rotvec([0.3, -0.5, 0.8])
    turned = found(turn.apply(noisy), current)
    np.testing.assert_allclose(turned.slope, turn.apply(straight.slope), rtol=1e-4, atol=1e-6)
    tesla = motor_field(noisy * 1e-6, current * 1000.0, FIELD_UT * 1e-6)
    assert tesla is not None
    np.testing.assert_allclose(tesla.slope, straight.slope * 1e-9, rtol=1e-6)
    assert tesla.p_value == pytest.approx(straight.p_value, rel=1e-6)


@pytest.mark.parametrize(("memory", "of_current"), [(0.5, 0.99), (0.98, 0.99)])
def test_the_claimed_sd_is_the_scatter(memory: float, of_current: float) -> None:
    h, z = field_ut(), []
    for seed in range(100):
        rng = np.random.default_rng([2, seed])
        current = current_a(seed, len(h), of_current)
        noise = NOISE * FIELD_UT * autoregressive(rng, h.shape, memory)
        result = motor_field(h + np.outer(current - current.mean(), SLOPE_UT_PER_A) + noise, current, FIELD_UT)
        if result is not None:
            z.append((result.slope - SLOPE_UT_PER_A) / result.slope_sd)
    assert len(z) >= 95
    assert 0.8 < np.sqrt(np.mean(np.square(z))) < 1.3


@pytest.mark.parametrize(("memory", "of_current"), [(0.5, 0.99), (0.9, 0.99), (0.98, 0.998), (0.995, 0.995)])
def test_an_independent_current_is_hardly_ever_told(memory: float, of_current: float) -> None:
    h, told, said = field_ut(), 0, 0
    for seed in range(150):
        noise = NOISE * FIELD_UT * autoregressive(np.random.default_rng([3, seed]), h.shape, memory)
        result = motor_field(h + noise, current_a(seed, len(h), of_current), FIELD_UT)
        if result is not None:
            said += 1
            fault = motor_fault(result, "current", "A", "uT")
            told += fault is not None
            assert fault is None or not fault.fatal
    assert said >= 140
    assert told <= HONEST_ALARMS * said


def test_a_current_is_found_in_coloured_noise() -> None:
    h = field_ut()
    for seed in range(20):
        current = current_a(seed, len(h), 0.99)
        noise = NOISE * FIELD_UT * autoregressive(np.random.default_rng([4, seed]), h.shape, 0.5)
        slope = 0.15 * FIELD_UT * SLOPE_UT_PER_A / np.linalg.norm(SLOPE_UT_PER_A)
        result = found(h + np.outer(current / np.ptp(np.percentile(current, [1.0, 99.0])), slope) + noise, current)
        assert result.p_value < SIGNIFICANT_P
        assert result.share == pytest.approx(0.15, abs=0.05)


def test_what_says_nothing() -> None:
    h = field_ut()
    assert motor_field(h, np.full(len(h), 12.0), FIELD_UT) is None
    assert motor_field(h[:50], np.arange(50.0), FIELD_UT) is None
    assert motor_field(h * np.inf, np.arange(float(len(h))), FIELD_UT) is None
    part = h.copy()
    part[7, 1] = np.nan
    assert motor_field(part, np.arange(float(len(h))), FIELD_UT) is None


def result_of(share: float, p_value: float) -> MotorField:
    return MotorField(SLOPE_UT_PER_A, SLOPE_UT_PER_A / 10, 24.0, share, 0.001, 0.8, 400.0, p_value)


def exact(n: int, k: np.ndarray) -> MotorField | None:
    """Readings of a field of length 1 to which a drive between −½ and ½ adds k per unit."""
    rng = np.random.default_rng(9)
    e = rng.normal(size=(n, 3))
    drive = rng.permutation(np.linspace(-0.5, 0.5, n))
    return motor_field(e / np.linalg.norm(e, axis=1, keepdims=True) + drive[:, None] * k, drive, 1.0)


def test_a_hundred_samples_are_the_fewest() -> None:
    assert exact(99, np.array([0.1, 0.0, 0.0])) is None
    result = exact(100, np.array([0.1, 0.0, 0.0]))
    assert result is not None
    assert result.slope == pytest.approx([0.1, 0.0, 0.0], abs=1e-6)
    assert result.span == pytest.approx(0.98)


@pytest.mark.parametrize("slope", [0.1, 0.6])
def test_the_sd_of_a_share_is_that_of_the_component_which_is_sure(slope: float) -> None:
    """Along one axis; what is not sure on the others is not in the share, nor is what is not sure of it."""
    rng = np.random.default_rng(10)
    e, drive = rng.normal(size=(4000, 3)), rng.permutation(np.linspace(-0.5, 0.5, 4000))
    h = e / np.linalg.norm(e, axis=1, keepdims=True) + 0.02 * rng.normal(size=e.shape)
    result = motor_field(h + drive[:, None] * [slope, 0.0, 0.0], drive, 1.0)
    assert result is not None
    assert result.share == pytest.approx(slope * 0.98, rel=0.05)
    assert result.share_sd == pytest.approx(result.slope_sd[0] * 0.98, rel=0.2)


@pytest.mark.parametrize(
    ("share", "share_sd", "p_value", "limit"),
    [
        (0.02, 0.001, 1e-9, None),
        (0.0201, 0.001, 1e-9, 0.02),
        (0.0201, 0.001, 1e-4, 0.02),
        (0.0201, 0.001, 1.05e-4, None),
        (0.125, 0.0125, 1e-9, 0.02),
        (0.125, 0.0124, 1e-9, 0.10),
    ],
)
def test_two_per_cent_are_told_and_ten_refuse_where_they_are_sure(
    share: float, share_sd: float, p_value: float, limit: float | None
) -> None:
    """One in ten thousand by chance; two standard deviations beyond the limit."""
    fault = motor_fault(
        MotorField(np.array([0.1, -0.25, 0.0]), np.ones(3), 7.0, share, share_sd, 0.5, 40.0, p_value),
        "current",
        "A",
        "uT",
    )
    if limit is None:
        assert fault is None
        return
    assert fault is not None
    assert (fault.limit, fault.fatal, fault.value) == (limit, limit == 0.10, share)
    said = f"by {100 * share:.1f} % of the local field (sd {100 * share_sd:.1f} %) over its range of 7 A"
    assert said in fault.sentence
    assert "(0.1, -0.25, 0) uT per A along x, y, z (correlation 0.50, 40 independent samples)" in fault.sentence


def test_limits_and_sentence() -> None:
    assert motor_fault(result_of(0.5, 2 * SIGNIFICANT_P), "current", "A", "uT") is None
    assert motor_fault(result_of(REPORTED_SHARE, 0.0), "current", "A", "uT") is None
    unsure = motor_fault(result_of(FATAL_SHARE + 0.001, 0.0), "current", "A", "uT")  # its sd is 0.001
    assert unsure is not None
    assert not unsure.fatal
    told, fatal = (motor_fault(result_of(share, 0.0), "current", "A", "uT") for share in (0.05, FATAL_SHARE + 0.01))
    assert told is not None
    assert (told.code, told.value, told.limit, told.fatal) == ("motor_field", 0.05, REPORTED_SHARE, False)
    assert "5.0 % of the local field" in told.sentence
    assert "(0.09, -0.05, 0.12) uT per A" in told.sentence
    assert fatal is not None
    assert (fatal.value, fatal.limit, fatal.fatal) == (FATAL_SHARE + 0.01, FATAL_SHARE, True)
    throttle = motor_fault(result_of(0.05, 0.0), "throttle", "", "norm")
    assert throttle is not None
    assert "local fields per full throttle" in throttle.sentence


# from the log to the verdict -----------------------------------------------------------------------------------------


def flown(folder: Path, share: float, *columns: str, memory: float = 0.998) -> Path:
    """A CSV log of a simulated flight, its magnetometer disturbed by `share` of the field over the current's range;
    `columns` among current_a, throttle and percent stand beside it, filled in every fourth row."""
    experiment = Experiment(seed=21, dip_rad=DIP_RAD, vps=False)
    log = write_flights(folder, experiment, log_format="csv")[0]
    rows = pl.read_csv(log / "imu.csv", infer_schema=False)
    current = current_a(7, len(rows), memory)
    slope = share * SLOPE_UT_PER_A / np.linalg.norm(SLOPE_UT_PER_A) / np.ptp(np.percentile(current, [1.0, 99.0]))
    added = np.outer(current, slope) / experiment.scale["magnetometer"]
    disturbed = {
        name: pl.Series((rows[name].cast(pl.Float64).to_numpy() + added[:, i]).round()).cast(pl.Int64).cast(pl.String)
        for i, name in enumerate(("mx", "my", "mz"))
    }
    drives = {"current_a": current, "throttle": current / 60.0, "percent": current / 0.6}
    fourth = pl.int_range(pl.len()) % 4 == 0
    rows.with_columns(**disturbed).with_columns(
        pl.when(fourth).then(pl.Series(drives[name].round(4)).cast(pl.String)).otherwise(pl.lit("")).alias(name)
        for name in columns
    ).write_csv(log / "imu.csv")
    return log


def calibrated(log: Path) -> tuple[dict[str, Any], dict[str, Any], set[tuple[str, str | None]]]:
    """The flight's row, what `vectors` measured, and status and code of the magnetometer's rows."""
    document = fieldcal.calibrate(log, method="serial").document
    vectors = next(row for row in document["run"] if row["stage"] == "vectors")
    assert vectors["status"] == "ok"
    own = [r for r in document["calibration"] if r["sensor"] == "magnetometer" and r["method"] != "motor_field"]
    rows = {(r["status"], r["reason_code"]) for r in own}
    return document["flight"], vectors["measured"], rows


def codes(flight: dict[str, Any]) -> list[str]:
    return [finding["code"] for finding in flight["findings"]]


def test_a_log_without_the_field_is_clean_and_one_without_the_current_as_ever(tmp_path: Path) -> None:
    flight, measured, rows = calibrated(flown(tmp_path / "a", 0.0, "current_a", "throttle"))
    assert (flight["verdict"], codes(flight), rows) == ("ok", [], {("ok", None)})
    assert measured["motor_field"]["drive"] == "current_a"
    assert measured["motor_field"]["share"] < REPORTED_SHARE
    flight, measured, rows = calibrated(flown(tmp_path / "b", 0.05))
    assert (flight["verdict"], codes(flight), measured, rows) == ("ok", [], {}, {("ok", None)})


@pytest.mark.parametrize("drive", ["current_a", "throttle"])
def test_a_field_of_five_per_cent_is_told(tmp_path: Path, drive: str) -> None:
    flight, measured, rows = calibrated(flown(tmp_path, 0.05, drive))
    assert (flight["verdict"], codes(flight), rows) == ("ok", ["motor_field"], {("ok", None)})
    result = measured["motor_field"]
    assert result["drive"] == drive
    assert result["share"] == pytest.approx(0.05, abs=0.01)
    z = (np.array(result["slope"]) - expected_slope(0.05, result["span"])) / result["slope_sd"]
    assert np.abs(z).max() < 4.0
    assert f"{100 * result['share']:.1f} %" in flight["findings"][0]["sentence"]


@pytest.mark.parametrize("method", ["serial", "joint"])
def test_the_sd_allows_for_a_field_that_was_told(tmp_path: Path, method: str) -> None:
    """A slow current's field is taken for scale: by 4.7 % here by the ellipsoid, which no residual shows."""
    truth = Experiment(seed=21).scale["magnetometer"]
    document = fieldcal.calibrate(flown(tmp_path, 0.05, "current_a"), method=method).document
    own = [row for row in document["calibration"] if row["sensor"] == "magnetometer" and row["parameter"] == "scale"]
    rows = [row for row in own if (row["method"] == "joint") == (method == "joint")]
    assert {row["status"] for row in rows} == {"ok"}
    found, sd = (np.array([row[column] for row in rows]) for column in ("value", "sd"))
    assert np.abs((found - truth) / sd).max() < 2.0
    if method == "serial":
        assert np.abs(found / truth - 1.0).max() > 0.02
    assert np.abs(sd / truth).max() == pytest.approx(0.05, abs=0.015)


def expected_slope(share: float, span: float) -> np.ndarray:
    return np.asarray(share * SLOPE_UT_PER_A / np.linalg.norm(SLOPE_UT_PER_A) / span)


def test_a_field_of_thirteen_per_cent_refuses_the_magnetometer_with_the_number(tmp_path: Path) -> None:
    """A current that changes so quickly that the ellipsoid's residual looks like noise: the fit alone calls it good."""
    flight, measured, rows = calibrated(flown(tmp_path, 0.13, "current_a", memory=0.95))
    assert rows == {("refused", "motor_field")}
    assert "motor_field" in codes(flight)
    fault = measured["faults"][0]
    assert (fault["fatal"], fault["limit"]) == (True, FATAL_SHARE)
    assert fault["value"] == pytest.approx(0.13, abs=0.015)
    assert "No constant calibration describes it" in fault["sentence"]


def test_no_gyroscope_is_fitted_to_an_attitude_from_such_a_magnetometer(tmp_path: Path) -> None:
    """Its scale would be off by 5 % about z."""
    document = fieldcal.calibrate(flown(tmp_path, 0.13, "current_a", memory=0.95), method="serial").document
    assert [r for r in document["calibration"] if r["sensor"] == "gyroscope" and r["status"] == "ok"] == []
    pass2 = next(row for row in document["run"] if row["stage"] == "gyro_equation_pass2")
    assert (pass2["status"], pass2["reason_code"]) == ("refused", "motor_field")


def test_the_joint_estimate_publishes_no_such_magnetometer(tmp_path: Path) -> None:
    log = flown(tmp_path, 0.13, "current_a", memory=0.95)
    config = tmp_path / "fieldcal.toml"
    text = config.read_text(encoding="utf-8").replace('world = "ned"', 'world = "ned"\nmethod = "joint"')
    config.write_text(text, encoding="utf-8")
    rows = fieldcal.calibrate(log).document["calibration"]
    own = [r for r in rows if r["sensor"] == "magnetometer" and r["status"] == "ok"]
    assert {r["method"] for r in own} == {"motor_field"}  # what the current adds is known well


@pytest.mark.parametrize("share", [0.13, 0.3])
def test_a_field_so_large_that_there_is_no_good_fit_is_told_as_its_cause(tmp_path: Path, share: float) -> None:
    flight, measured, rows = calibrated(flown(tmp_path, share, "current_a"))
    assert ("ok", None) not in rows
    assert codes(flight) == ["motor_field"]
    assert measured["faults"][0]["value"] == pytest.approx(share, rel=0.1)


def test_a_throttle_in_per_cent_is_not_compared_and_told(tmp_path: Path) -> None:
    log = flown(tmp_path, 0.05, "percent")
    config = tmp_path / "fieldcal.toml"
    named = '\n[vehicles."sim-1".csv]\nimu = { throttle = "percent" }\n'
    config.write_text(config.read_text(encoding="utf-8") + named, encoding="utf-8")
    flight, measured, _ = calibrated(log)
    assert codes(flight) == ["throttle_range"]
    assert "motor_field" not in measured


# reading it ----------------------------------------------------------------------------------------------------------


def test_csv_cells_of_either_may_be_empty_and_columns_may_be_named(tmp_path: Path) -> None:
    header = "t_s,gx,gy,gz,amps,throttle\n"
    cells = ["12.5,0.5", ",0.25", "-3,", ",", "7,1", "8,0"]
    (tmp_path / "log.csv").write_text(header + "".join(f"0.{i},1,2,{i},{c}\n" for i, c in enumerate(cells)))
    frames, summary = read_log(tmp_path / "log.csv", vehicle(csv=CsvMap(imu={"current": "amps"})))
    assert frames["power"]["t_ns"].to_list() == [0, 100_000_000, 200_000_000, 400_000_000, 500_000_000]
    read = [[None if v is None or np.isnan(v) else v for v in row[1:]] for row in frames["power"].iter_rows()]
    assert read == [[12.5, 0.5], [None, 0.25], [-3.0, None], [7.0, 1.0], [8.0, 0.0]]
    assert len(frames["imu"]) == 6
    assert summary.findings == []
    frames, _ = read_log(tmp_path / "log.csv", vehicle())
    assert frames["power"]["throttle"].to_list() == [0.5, 0.25, 1.0, 0.0]
    assert frames["power"]["current_a"].null_count() == 4


def battery_log(path: Path, topics: dict[str, list[float]]) -> Path:
    """An MCAP file with an IMU and batteries, written by mcap_ros2."""
    with path.open("wb") as stream:
        writer = Ros2Writer(stream)
        imu = writer.register_msgdef("sensor_msgs/msg/Imu", full_text("sensor_msgs/Imu"))
        battery = writer.register_msgdef("sensor_msgs/msg/BatteryState", full_text("sensor_msgs/BatteryState"))
        for row in range(20):
            stamp = {"sec": 1_700_000_000 + row, "nanosec": row}
            rates = {"x": 0.1 * row, "y": 0.2, "z": 0.3}
            message = {
                "header": {"stamp": stamp, "frame_id": "imu"},
                "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0},
                "orientation_covariance": [0.0] * 9,
                "angular_velocity": rates,
                "angular_velocity_covariance": [0.0] * 9,
                "linear_acceleration": rates,
                "linear_acceleration_covariance": [0.0] * 9,
            }
            writer.write_message("/imu", imu, message, log_time=row)
        for topic, currents in topics.items():
            for row, current in enumerate(currents):
                message = {
                    "header": {"stamp": {"sec": 1_700_000_000 + row, "nanosec": 5}, "frame_id": "b" * (row % 3)},
                    **dict.fromkeys(("voltage", "temperature", "charge", "capacity"), 14.8),
                    "current": current,
                    **dict.fromkeys(("design_capacity", "percentage"), 0.5),
                    **dict.fromkeys(STATUS, 1),
                    "present": True,
                    "cell_voltage": [3.7] * (row % 4),
                    "cell_temperature": [],
                    "location": "bay",
                    "serial_number": "7",
                }
                writer.write_message(topic, battery, message, log_time=row)
        writer.finish()
    return path


STATUS = ("power_supply_status", "power_supply_health", "power_supply_technology")


def test_mcap_batteries_are_read_by_type_or_topic_and_as_magnitudes(tmp_path: Path) -> None:
    one = battery_log(tmp_path / "one.mcap", {"/battery": [-12.5, float("nan"), -0.25, 3.0]})
    frames, summary = read_log(one, vehicle())
    assert frames["power"]["current_a"].to_list() == [12.5, 0.25, 3.0]
    assert frames["power"]["throttle"].null_count() == 3
    assert frames["power"]["t_ns"].to_list() == [(1_700_000_000 + i) * 10**9 + 5 for i in (0, 2, 3)]
    assert summary.findings == []
    two = battery_log(tmp_path / "two.mcap", {"/a": [-1.0, -2.0], "/b": [-3.0, -4.0]})
    frames, summary = read_log(two, vehicle())
    assert frames["power"]["current_a"].to_list() == [1.0, 2.0]
    assert [finding.code for finding in summary.findings] == ["ambiguous_topic"]
    frames, summary = read_log(two, vehicle(mcap=McapMap(power="/b")))
    assert frames["power"]["current_a"].to_list() == [3.0, 4.0]
    assert summary.findings == []
    frames, summary = read_log(two, vehicle(mcap=McapMap(power="/c")))
    assert "power" not in frames
    assert [finding.code for finding in summary.findings] == ["missing_topic"]
    assert "mcap.power" in summary.findings[0].sentence


def test_a_log_without_a_current_has_no_such_table(tmp_path: Path) -> None:
    frames, _ = read_log(battery_log(tmp_path / "log.mcap", {}), vehicle())
    assert set(frames) == {"imu"}


def test_fifty_steps_are_the_most(monkeypatch: pytest.MonkeyPatch) -> None:
    """When no step is small enough nothing is said."""
    steps: list[None] = []
    real = numerics._residual

    def counted(h: np.ndarray, u: np.ndarray, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        steps.append(None)
        return real(h, u, theta)

    monkeypatch.setattr(numerics, "_residual", counted)
    monkeypatch.setattr(numerics, "CONVERGED_STEP", 0.0)
    assert motor_field(field_ut(), current_a(0, len(field_ut()), 0.99), FIELD_UT) is None
    assert len(steps) == 50
