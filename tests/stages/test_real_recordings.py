"""Real recordings with motion capture: clocks, gyroscope constants and refusals against their published references.

Needs `FIELDCAL_EXAMPLE_LOGS` (`example_logs`): the recordings, their fieldcal.toml and expected.json.
"""

from __future__ import annotations

import json
from functools import cache
from typing import Any

import numpy as np
import polars as pl
import pytest
from example_logs import EXAMPLES, needs_examples
from outside_ci import outside_ci

from fieldcal.config.configuration import load
from fieldcal.config.flight_settings import flight_settings
from fieldcal.logs import find_logs, read_log
from fieldcal.stages.pipeline import run_flight
from fieldcal.stages.results import StageResult
from fieldcal.stages.tables import AXES

pytestmark = needs_examples

MILLISECOND = 1e-3
SLOW_SCALE, SLOW_BIAS_DEG_S = 0.015, 0.1
FAST_SCALE, FAST_BIAS_DEG_S = 0.02, 0.2
SESSION = "broad-imu-1/2026-05-11-B"
WITH_VPS = [f"{SESSION}/broad_{n}.mcap" for n in ("02", "07", "11", "28")] + [
    "broad-imu-1-counts/2026-05-04-A1/broad_06"
]


def some_in_ci(log_uris: list[str]) -> list[Any]:
    """One recording in the sensor's units and the one in counts run in CI, the others outside it."""
    return [uri if uri.endswith(("_06", "_07.mcap")) else pytest.param(uri, marks=outside_ci) for uri in log_uris]


@cache
def expected() -> dict[str, Any]:
    return dict(json.loads((EXAMPLES / "expected.json").read_text()))


@cache
def calibrated(log_uri: str) -> dict[str, StageResult]:
    log = next(log for log in find_logs(EXAMPLES) if log.log_uri == log_uri)
    vehicle = load(EXAMPLES / "fieldcal.toml").vehicle(log.vehicle_id)
    signals, summary = read_log(log.path, vehicle)
    signals = {name: frame.unique("t_ns", keep="first").sort("t_ns") for name, frame in signals.items()}
    declared = {"world": summary.world, "body": summary.body, "gravity_sign": summary.gravity_sign}
    return run_flight(signals, flight_settings(vehicle, units=summary.units, **declared))


def gyroscope(log_uri: str) -> tuple[dict[tuple[str, str], float], set[str]]:
    """Output error's values by (parameter, axis), and the axes refused."""
    rows = calibrated(log_uri)["gyro_output"].tables["calibration"].filter(method="output_error")
    values = {(p, a): v for p, a, v in rows.select("parameter", "axis", "value").iter_rows()}
    return values, set(rows.filter(pl.col("status") != "ok")["axis"])


@pytest.mark.parametrize("log_uri", some_in_ci(WITH_VPS))
def test_the_vps_clock_is_found(log_uri: str) -> None:
    row = calibrated(log_uri)["vps_sync"].tables["sync"].row(0, named=True)
    truth = expected()[log_uri]["vps"]
    assert row["status"] == "ok"
    assert abs(row["lag_s"] + truth["apparent_offset_s"]) < MILLISECOND
    assert abs(row["skew_ppm"] - truth["skew_ppm"]) < 5 * row["skew_sd_ppm"]


def test_slow_rotation_gives_the_motion_capture_gyroscope() -> None:
    log_uri = f"{SESSION}/broad_02.mcap"
    values, refused = gyroscope(log_uri)
    truth = expected()[log_uri]["truth"]["gyro"]
    assert not refused
    for i, axis in enumerate(AXES):
        assert abs(values["scale", axis] / truth["scale"][i] - 1) < SLOW_SCALE
        assert abs(np.degrees(values["bias", axis] - truth["bias_rad_s"][i])) < SLOW_BIAS_DEG_S


def test_raw_counts_in_fast_rotation_are_right_or_refused_with_numbers() -> None:
    log_uri = WITH_VPS[-1]
    results = calibrated(log_uri)
    rows = results["gyro_output"].tables.get("calibration")
    if rows is None:
        refusal = results["accelerometer_pass2"]
        assert refusal.status == "refused"
        assert refusal.measured["residual_rms_relative"] > 0.1
        return
    values, refused = gyroscope(log_uri)
    truth = expected()[log_uri]["gyro_lam_b_reference"]
    for i, axis in enumerate(AXES):
        if axis in refused:
            continue
        rate_at_zero = values["scale", axis] * truth["zero_counts"][i] + values["bias", axis]
        assert abs(values["scale", axis] / truth["lam"][i] - 1) < FAST_SCALE
        assert abs(np.degrees(rate_at_zero)) < FAST_BIAS_DEG_S


def test_translation_refuses_the_vectors_and_keeps_the_gyroscope() -> None:
    results = calibrated(f"{SESSION}/broad_11.mcap")
    for stage in ("magnetometer", "accelerometer_pass2"):
        assert results[stage].status == "refused"
        assert results[stage].measured
    attitude = results["attitude_pass2"]
    assert attitude.status == "ok"
    assert attitude.reason_code == "logged_values_used"
    assert set(attitude.measured["logged_values_used"]) == {"magnetometer", "accelerometer"}
    assert results["gyro_output"].status == "ok"
    assert results["vps_sync"].status == "ok"


def test_a_magnet_is_not_called_good() -> None:
    result = calibrated(f"{SESSION}/broad_28.mcap")["magnetometer"]
    assert result.status == "refused"
    assert result.measured["residual_rms_relative"] > 0.1


@pytest.mark.parametrize("log_uri", some_in_ci([uri for uri in WITH_VPS if "counts" not in uri]))
def test_attitude_is_compared_with_the_vps_in_degrees(log_uri: str) -> None:
    fit = calibrated(log_uri)["verify"].tables["fit"]
    row = fit.filter(quantity="attitude_propagated", reference="vps", signal="raw").row(0, named=True)
    assert row["rms_unit"] == "deg"
    assert row["rms"] < 5.0
    assert fit.filter(quantity="attitude", reference="vps")["rms_unit"].unique().to_list() == ["deg"]


def test_static_poses_give_the_accelerometer_without_a_magnetometer() -> None:
    log_uri = "imutk-mti/session-1/multi_position"
    results = calibrated(log_uri)
    rows = results["accelerometer_pass2"].tables["calibration"]
    assert set(rows["status"]) == {"ok"}
    zero = rows.filter(parameter="zero").sort("axis")["value"].to_numpy()
    counts_per_g = expected()[log_uri]["truth"]["accel_counts_per_g"]
    assert np.abs(zero - expected()[log_uri]["truth"]["accel_zero_counts"]).max() < 0.003 * min(counts_per_g)
    assert results["gyro_output"].status == "refused"


def test_a_magnetometer_offset_beyond_its_radius_is_found() -> None:
    log_uri = "ck-magacc/session-1/acc_mag_log.csv"
    rows = calibrated(log_uri)["magnetometer"].tables["calibration"]
    zero = rows.filter(parameter="zero").sort("axis")["value"].to_numpy()
    assert np.abs(zero - expected()[log_uri]["truth"]["mag_offset_gauss"]).max() < 0.005
