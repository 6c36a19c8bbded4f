"""Recordings and calibrations: what the pipeline found, typed, and out of reach once refused."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import fieldcal
from fieldcal.flight.calibrate import identify, read, run_stages

SENSORS = ("magnetometer", "accelerometer", "gyroscope")
NEVER_ABOUT_Z = (1.0, 1.0, 0.0)


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    archive = tmp_path_factory.mktemp("api") / "archive"
    return fieldcal.write_flights(archive, fieldcal.Experiment(seed=5, duration_s=25.0))[0]


@pytest.fixture(scope="module")
def calibration(log: Path) -> fieldcal.Calibration:
    return fieldcal.calibrate(log)


@pytest.fixture(scope="module")
def refused(tmp_path_factory: pytest.TempPathFactory) -> fieldcal.Calibration:
    archive = tmp_path_factory.mktemp("api") / "refused"
    experiment = fieldcal.Experiment(seed=0, duration_s=20.0, turned=NEVER_ABOUT_Z)
    return fieldcal.calibrate(fieldcal.write_flights(archive, experiment)[0], method="serial")


def test_a_recording_tells_what_was_read(log: Path) -> None:
    recording = fieldcal.read_log(str(log))
    assert (recording.verdict, recording.reason, recording.reason_code, recording.findings) == ("ok", None, None, ())
    assert (recording.vehicle_id, recording.session_id, recording.path) == ("sim-1", "2026-01-12", log)
    assert recording.units == dict.fromkeys(SENSORS, "counts")
    t, readings = recording.readings("magnetometer")
    assert t[0] == 0.0
    assert readings.shape == (recording.facts["rows"]["magnetometer"], 3)
    with pytest.raises(ValueError, match="sensor is one of"):
        recording.readings("barometer")


def test_a_bad_log_is_a_verdict_and_not_an_exception(tmp_path: Path) -> None:
    (tmp_path / "empty.mcap").write_bytes(b"")
    recording = fieldcal.read_log(tmp_path / "empty.mcap")
    assert (recording.verdict, recording.reason_code, recording.tables) == ("rejected", "empty_file", {})
    assert recording.reason
    with pytest.raises(fieldcal.FieldcalError, match="nothing to plot"):
        recording.plot()
    calibration = fieldcal.calibrate(recording)
    assert (calibration.verdict, calibration.rows.height) == ("rejected", 0)
    with pytest.raises(fieldcal.Refused, match=r"gyroscope's bias was refused.*empty"):
        _ = calibration.gyroscope.bias.value
    with pytest.raises(fieldcal.Refused, match="No sensor has constants"):
        calibration.constants()


def test_what_is_calibrated_is_what_the_pipeline_found(log: Path, calibration: fieldcal.Calibration) -> None:
    assert calibration.document == run_stages(read(*identify(log))).document
    assert fieldcal.calibrate(fieldcal.read_log(log)).document == calibration.document
    rows = {(r["sensor"], r["method"], r["parameter"], r["axis"]): r for r in calibration.document["calibration"]}
    for name in SENSORS:
        sensor = calibration.sensor(name)
        for estimate in (sensor.scale, sensor.bias, sensor.zero):
            own = [rows[name, sensor.method, estimate.parameter, axis] for axis in "xyz"]
            assert estimate.value.tolist() == [row["value"] for row in own]
            assert estimate.sd.tolist() == [row["sd"] for row in own]
            assert {estimate.unit} == {row["unit"] for row in own}
            assert estimate.temperature_degc == own[0]["temperature_degc"] == 25.0
            assert [estimate[axis] for axis in "xyz"] == estimate.value.tolist()
            assert np.asarray(estimate).tolist() == estimate.value.tolist()


def test_constants_are_those_of_the_truth(log: Path, calibration: fieldcal.Calibration) -> None:
    truth = json.loads(log.with_name("flight-01.truth.json").read_text())["constants"]
    for name in SENSORS:
        scale = calibration.sensor(name).scale
        assert (np.abs(scale.value - truth[name]["scale"]) < 4.0 * scale.sd).all(), name


def test_the_most_exact_method_speaks_unless_another_is_asked_for(calibration: fieldcal.Calibration) -> None:
    assert calibration.methods("gyroscope") == ("joint", "output_error", "equation_error")
    assert calibration.gyroscope.method == "joint"
    equation = calibration.sensor("gyroscope", "equation_error")
    assert equation.scale["x"] != calibration.gyroscope.scale["x"]
    with pytest.raises(ValueError, match="there is: joint, output_error, equation_error"):
        calibration.sensor("gyroscope", "ellipsoid")
    with pytest.raises(ValueError, match="one of magnetometer"):
        calibration.sensor("barometer")


def test_a_refused_value_is_out_of_reach(refused: fieldcal.Calibration) -> None:
    scale = refused.magnetometer.scale
    assert (scale.ok, scale.status, scale.reason_code) == (False, ("refused",) * 3, "scale_uncertain")
    attempts = (
        lambda: scale.value,
        lambda: scale["x"],
        lambda: np.asarray(scale),
        lambda: refused.magnetometer.apply(np.zeros((1, 3))),
        lambda: refused.magnetometer.triad("a test"),
    )
    for attempt in attempts:
        with pytest.raises(fieldcal.Refused, match="uncertain by") as told:
            attempt()
        assert told.value.reason_code == "scale_uncertain"
    written = {r["axis"]: r["value"] for r in refused.rows.iter_rows(named=True) if r["parameter"] == "scale"}
    assert np.isfinite(scale.refused_value()).all()
    assert len(written) == 3
    assert "refused" in repr(scale)


def test_a_sensor_without_numbers_says_what_it_lacked(refused: fieldcal.Calibration) -> None:
    assert (refused.methods("gyroscope"), refused.gyroscope.method, refused.gyroscope.ok) == ((), None, False)
    with pytest.raises(fieldcal.Refused, match="Magnetometer: A scale is uncertain"):
        _ = refused.gyroscope.scale.value
    assert np.isnan(refused.gyroscope.scale.refused_value()).all()


def test_constants_leave_refused_sensors_out(refused: fieldcal.Calibration) -> None:
    assert set(refused.constants().triads) == {"accelerometer"}
    assert "magnetometer" not in fieldcal.export(refused, "c").text


def test_an_axis_that_was_not_refused_can_be_asked_for() -> None:
    nan = np.full(3, np.nan)
    estimate = fieldcal.Estimate(
        "gyroscope",
        "joint",
        "scale",
        "1",
        nan,
        None,
        ("ok", "refused", "ok"),
        "axis_not_turned",
        "Why.",
        np.eye(3) * 2.0,
    )
    assert (estimate["x"], estimate["xy"], estimate["zz"]) == (2.0, 0.0, 2.0)
    for axis in ("y", "yx"):
        with pytest.raises(fieldcal.Refused, match=r"scale \(y\) by joint was refused. Why."):
            estimate[axis]
    with pytest.raises(KeyError):
        estimate["xyz"]


def test_a_value_cannot_be_changed_behind_its_estimate(calibration: fieldcal.Calibration) -> None:
    scale = calibration.gyroscope.scale
    scale.value[:] = 0.0
    assert scale["x"] != 0.0


def test_the_clock_is_typed(calibration: fieldcal.Calibration) -> None:
    row, clock = calibration.document["sync"], calibration.sync
    assert clock is not None
    for name in ("lag_s", "lag_mid_s", "lag_sd_s", "skew_ppm", "skew_sd_ppm", "peak", "runner_up", "status"):
        assert getattr(clock, name) == row[name]


def test_a_clock_that_was_refused_is_out_of_reach(log: Path) -> None:
    clock = fieldcal.calibrate(log, parameters={"vps_min_peak": 1.0}).sync
    assert clock is not None
    assert clock.status == "refused"
    for attempt in (lambda: clock.lag_s, lambda: clock.skew_ppm, clock.plot):
        with pytest.raises(fieldcal.Refused, match="clock"):
            attempt()


def test_without_a_vps_there_is_no_clock(tmp_path: Path) -> None:
    log = fieldcal.write_flights(tmp_path, fieldcal.Experiment(duration_s=20.0, vps=False))[0]
    assert fieldcal.calibrate(log).sync is None


def test_choices_are_those_of_the_command_line(log: Path) -> None:
    paper = fieldcal.calibrate(log, profile="onboard", parameters={"ellipsoid": "li", "gyro_output": False})
    assert paper.methods("magnetometer") == ("ellipsoid",)
    joint = fieldcal.calibrate(log, method="joint")
    assert joint.gyroscope.method == joint.magnetometer.method == "joint"
    with pytest.raises(fieldcal.ConfigurationError, match="ellipsoid"):
        fieldcal.calibrate(log, parameters={"elipsoid": "li"})
    with pytest.raises(ValueError, match="serial"):
        fieldcal.calibrate(log, method="both")
    with pytest.raises(ValueError, match="belong to read_log"):
        fieldcal.calibrate(fieldcal.read_log(log), vehicle="other")


def test_applied_constants_are_eq_5(log: Path, calibration: fieldcal.Calibration) -> None:
    recording = fieldcal.read_log(log)
    calibrated = fieldcal.apply(recording, calibration)
    for name in SENSORS:
        _, z = calibrated.readings[name]
        _, logged = recording.readings(name)
        assert np.abs(z - calibration.sensor(name).apply(logged)).max() < 1e-9 * np.abs(z).max()


def test_a_report_is_written(calibration: fieldcal.Calibration, tmp_path: Path) -> None:
    assert "Figure 10" in calibration.report(tmp_path / "flight.html").read_text(encoding="utf-8")
