"""The whole chain on simulated recordings: exact without noise, good with it, and never good when it cannot know."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
from serial_accuracy import study

from fieldcal.config.configuration import load, parse
from fieldcal.config.flight_settings import flight_settings
from fieldcal.config.parameters import PROFILES
from fieldcal.config.stage_settings import as_json, from_json, taken_from
from fieldcal.geometry.frames import FRD_FROM_FLU, FRD_FROM_FLU_QUATERNION, NED_FROM_ENU_QUATERNION
from fieldcal.geometry.rotation import (
    angle_between,
    body_from_inertial,
    conjugate,
    from_rotation_vector,
    multiply,
)
from fieldcal.logs import find_logs, read_log
from fieldcal.simulation.archive import settings, signals, truth, write_flights
from fieldcal.simulation.experiment import Experiment, SimulatedFlight, simulate
from fieldcal.stages.pipeline import PIPELINE, run_flight
from fieldcal.stages.results import StageResult
from fieldcal.stages.tables import AXES, QUATERNION, columns_of, matrix, triad

VECTOR_EXACT, GYRO_EXACT = 1e-6, 1e-3
EXACT = {"noise": False, "quantisation": False, "band_limit": False}
PLACE = {
    "magnetometer": ("magnetometer", None),
    "accelerometer": ("accelerometer_pass2", None),
    "gyroscope": ("gyro_output", "output_error"),
}
SENSORS = tuple(PLACE)


def values(results: dict[str, StageResult], sensor: str, parameter: str = "scale") -> np.ndarray:
    """Three values of a sensor's final method; NaN where it has no row or the row is refused."""
    stage, method = PLACE[sensor]
    rows = results[stage].tables.get("calibration")
    if rows is None:
        return np.full(3, np.nan)
    rows = rows.filter(parameter=parameter, status="ok")
    rows = rows if method is None else rows.filter(method=method)
    found = dict(rows.select("axis", "value").iter_rows())
    return np.array([found.get(axis, np.nan) for axis in AXES])


def run(recording: SimulatedFlight, **changes: Any) -> dict[str, StageResult]:
    return run_flight(signals(recording), settings(recording.experiment, **changes))


@pytest.fixture(scope="module")
def flight() -> SimulatedFlight:
    return simulate(seed=1001)


@pytest.mark.parametrize("log_format", ["mcap", "csv"])
def test_without_noise_the_files_give_the_constants_back(tmp_path: Path, log_format: str) -> None:
    write_flights(tmp_path, Experiment(seed=1, **EXACT), log_format=log_format)
    (log,) = find_logs(tmp_path)
    vehicle = load(tmp_path / "fieldcal.toml").vehicle(log.vehicle_id)
    read, summary = read_log(log.path, vehicle)
    chosen = flight_settings(vehicle, units=summary.units, world=summary.world, body=summary.body)
    results = run_flight(read, chosen.changed(smoothing_cutoff_hz=0.0))
    known = json.loads((log.path.parent / "flight-01.truth.json").read_text())
    for sensor, tolerance in zip(SENSORS, (VECTOR_EXACT, VECTOR_EXACT, GYRO_EXACT), strict=True):
        for parameter in ("scale", "bias", "zero"):
            true = np.array(known["constants"][sensor][parameter])
            assert np.abs(values(results, sensor, parameter) / true - 1).max() < tolerance, (sensor, parameter)
    lag = results["vps_sync"].tables["sync"]["lag_s"][0]
    assert abs(lag - known["lag_s"]) < 1e-4


def test_the_bars_over_flights_and_the_papers_method_behind() -> None:
    methods: dict[str, dict[str, object]] = {"serial": {}, "paper": dict(PROFILES["paper"])}
    figures = {name: s.figures() for name, s in study(Experiment(), 10, 1000, methods).items()}
    serial, paper = figures["serial"], figures["paper"]
    assert serial["magnetometer"]["median"] <= 0.75
    assert serial["accelerometer"]["median"] <= 0.75
    assert serial["gyroscope, output error"]["median"] <= 1.6
    assert serial["attitude"]["median"] <= 0.32
    for quantity in ("magnetometer", "accelerometer", "gyroscope, output error", "attitude"):
        assert serial[quantity]["median"] < paper[quantity]["median"]


@pytest.mark.parametrize(
    "changes",
    [{"ellipsoid": v} for v in ("robust", "li", "li_full", "two_step", "tls")]
    + [{"attitude": v} for v in ("davenport", "svd", "triad", "euler")]
    + [{"equations": "scalar"}, PROFILES["paper"]],
    ids=lambda c: "-".join(str(v) for v in c.values())[:30],
)
def test_every_choice_runs_to_the_end(flight: SimulatedFlight, changes: dict[str, Any]) -> None:
    results = run(flight, **changes)
    known = truth(flight)["constants"]
    for sensor in SENSORS:
        error = values(results, sensor) / np.array(known[sensor]["scale"]) - 1
        assert np.sqrt(np.mean(error**2)) < 0.05, sensor
    assert results["verify"].tables["fit"].height == 12


def test_the_onboard_profile_stops_at_equation_error(flight: SimulatedFlight) -> None:
    results = run(flight, **PROFILES["onboard"])
    rows = results["gyro_output"].tables["calibration"]
    assert set(rows["method"]) == {"equation_error"}
    assert results["gyro_output"].status == "absent"


def test_the_papers_five_comparisons_have_rows_with_units(flight: SimulatedFlight) -> None:
    fit = run(flight)["verify"].tables["fit"]
    wanted = {
        ("attitude", "quest", "vps", "deg"),
        ("quaternion_rate", "equation_error", "quest", "1/s"),
        ("attitude_propagated", "output_error", "quest", "deg"),
        ("body_rate", "equation_error", "vps", "rad/s"),
        ("body_rate", "output_error", "vps", "rad/s"),
    }
    for signal in ("raw", "smoothed"):
        found = fit.filter(signal=signal).select("quantity", "method", "reference", "rms_unit").rows()
        assert wanted <= set(found)
    parts = fit.select(pl.col("tic_bias") + pl.col("tic_variance") + pl.col("tic_covariance")).to_series()
    assert np.abs(parts.to_numpy() - 1.0).max() < 1e-9


def test_a_turned_sensor_in_ros_frames_gives_the_same_numbers(flight: SimulatedFlight) -> None:
    """The same flight logged in SI, FLU, ENU and specific force by a sensor turned in its mount."""
    e = replace(flight.experiment, dip_rad=1.1, vps_misalignment_rad=0.1)
    recording = simulate(e)
    body_from_sensor = body_from_inertial(from_rotation_vector([0.3, -0.2, 0.9])).T
    field_ut = 45.0

    def logged(sensor: str, sign: float = 1.0) -> np.ndarray:
        si = recording.counts[sensor] * np.array(e.scale[sensor]) + np.array(e.bias[sensor])
        return sign * (si @ FRD_FROM_FLU) @ body_from_sensor

    t_ns = signals(recording)["imu"]["t_ns"]
    imu = np.hstack([logged("gyroscope"), logged("accelerometer", -1.0)])
    pose = multiply(multiply(conjugate(NED_FROM_ENU_QUATERNION), recording.vps_q), conjugate(FRD_FROM_FLU_QUATERNION))
    tables = {
        "imu": pl.DataFrame({"t_ns": t_ns, **columns_of(imu, triad("gyroscope") + triad("accelerometer"))}),
        "magnetometer": pl.DataFrame(
            {"t_ns": t_ns, **columns_of(field_ut * logged("magnetometer"), triad("magnetometer"))}
        ),
        "vps": signals(recording)["vps"].with_columns(**{n: pl.Series(pose[:, i]) for i, n in enumerate(QUATERNION)}),
    }
    north, down = field_ut * np.cos(1.1), field_ut * np.sin(1.1)
    vehicle = parse(
        f'[vehicles.a]\nworld = "enu"\nbody = "flu"\ngravity_sign = "specific_force"\ngravity_mps2 = 9.81\n'
        f'field = {{ north_east_down = [{north}, 0.0, {down}], unit = "uT" }}\n'
        f"rotation_body_from_sensor = {body_from_sensor.tolist()}\n",
        None,
    ).vehicle("a")
    units = {"gyroscope": "rad/s", "accelerometer": "m/s^2", "magnetometer": "uT"}
    results = run_flight(tables, flight_settings(vehicle, units=units))
    assert np.abs(values(results, "gyroscope") - 1.0).max() < 0.03
    assert np.abs(values(results, "accelerometer") - 1.0).max() < 0.03
    attitude = results["attitude_pass2"].tables["attitude"]
    index = np.searchsorted(t_ns.to_numpy(), attitude["t_ns"].to_numpy())
    angle = angle_between(matrix(attitude, QUATERNION), recording.q[index])
    assert np.degrees(np.sqrt(np.mean(angle**2))) < 1.5
    turned = results["vps_sync"].measured
    assert abs(turned["vps_body_rotation_deg"] - np.degrees(0.1)) < 0.5
    assert abs(turned["vps_world_rotation_deg"] - np.degrees(0.1)) < 1.0


def test_the_wrong_gravity_sign_is_told() -> None:
    recording = simulate(seed=5, dip_rad=1.1, vps=False)
    attitude = run(recording, gravity_sign="specific_force")["attitude"]
    assert (attitude.status, attitude.reason_code) == ("refused", "gravity_sign_contradiction")


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("sensor", SENSORS)
def test_a_wrong_polarity_never_gives_a_wrong_gyroscope(flight: SimulatedFlight, sensor: str, axis: int) -> None:
    polarity = settings(flight.experiment).polarity
    polarity = {**polarity, sensor: [-p if i == axis else p for i, p in enumerate(polarity[sensor])]}
    results = run(flight, polarity=polarity)
    found, true = values(results, "gyroscope"), np.array(truth(flight)["constants"]["gyroscope"]["scale"])
    wrong = np.abs(found / true - 1) > 0.05
    assert not wrong[np.isfinite(found)].any()
    assert any(results[stage].reason_code for stage in ("attitude", "attitude_pass2", "gyro_output"))


def changed(recording: SimulatedFlight, **counts: np.ndarray) -> SimulatedFlight:
    return replace(recording, counts={**recording.counts, **counts})


def test_recordings_that_cannot_tell_are_refused_with_numbers(flight: SimulatedFlight) -> None:
    still = simulate(replace(flight.experiment, peak_rad=(1e-4, 2e-4), tremor_rad=1e-5))
    short = simulate(replace(flight.experiment, duration_s=8.0))
    for recording in (still, short):
        results = run(recording)
        assert (results["manoeuvre"].status, results["manoeuvre"].reason_code) == ("refused", "too_little_motion")
        assert results["manoeuvre"].measured["excited_s"] < 10.0
        assert all(np.isnan(values(results, sensor)).all() for sensor in SENSORS)
    small = run(simulate(replace(flight.experiment, peak_rad=(0.15, 0.25))))
    assert small["magnetometer"].status == "refused"
    assert small["magnetometer"].measured
    stuck = run(changed(flight, magnetometer=np.full_like(flight.counts["magnetometer"], 33000.0)))
    assert stuck["magnetometer"].status == "refused"
    assert np.isnan(values(stuck, "gyroscope")).all()
    constant = run(changed(flight, gyroscope=np.full_like(flight.counts["gyroscope"], 32000.0)))
    assert np.isnan(values(constant, "gyroscope")).all()


@pytest.mark.parametrize("missing", SENSORS)
def test_a_missing_sensor_costs_what_needs_it_and_no_more(flight: SimulatedFlight, missing: str) -> None:
    tables = signals(flight)
    if missing == "magnetometer":
        del tables["magnetometer"]
    else:
        empty = {name: pl.lit(None, pl.Float64) for name in triad(missing)}
        tables["imu"] = tables["imu"].with_columns(**empty)
    results = run_flight(tables, settings(flight.experiment))
    assert not any(result.status == "failed" for result in results.values())
    for sensor in ("magnetometer", "accelerometer"):
        assert np.isfinite(values(results, sensor)).all() == (sensor != missing), sensor
    assert np.isnan(values(results, "gyroscope")).all()
    if missing != "gyroscope":
        assert results["vps_sync"].status == "ok"


@pytest.mark.parametrize(
    ("sensor", "factor", "code"),
    [
        ("accelerometer", 1 / 9.80665, "wrong_unit"),
        ("gyroscope", 180 / np.pi, "wrong_unit"),
        ("gyroscope", np.pi / 180, "scale_not_nominal"),
        ("magnetometer", 10.0, "scale_not_nominal"),
    ],
)
def test_a_wrong_unit_is_told_by_its_scale(flight: SimulatedFlight, sensor: str, factor: float, code: str) -> None:
    e = flight.experiment
    si = {n: flight.counts[n] * np.array(e.scale[n]) + np.array(e.bias[n]) for n in SENSORS}
    si[sensor] = si[sensor] * factor
    units = {"gyroscope": "rad/s", "accelerometer": "m/s^2", "magnetometer": "norm"}
    vehicle = parse("[vehicles.a]\ngravity_mps2 = 9.81\n", None).vehicle("a")
    results = run_flight(signals(changed(flight, **si)), flight_settings(vehicle, units=units))
    stage, _ = PLACE[sensor]
    assert results[stage].reason_code == code
    assert np.isnan(values(results, sensor)).all()


def test_every_stage_reads_what_an_earlier_one_writes() -> None:
    known = {f"ingest.{name}" for name in ("imu", "magnetometer", "temperature", "vps", "power", "gnss_velocity")}
    defaults = settings(Experiment())
    for stage in PIPELINE:
        assert set(stage.reads.values()) <= known, stage.name
        assert set(stage.needs) <= set(stage.reads), stage.name
        takes = taken_from(defaults, stage.takes)
        assert from_json(json.loads(json.dumps(as_json(takes))), stage.takes) == takes, stage.name
        known |= {f"{stage.name}.{table}" for table in stage.writes}
