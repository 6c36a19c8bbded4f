"""Warm-up: the slope of the zeros on temperature from one flight."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from fieldcal.errors import UnusableFlight
from fieldcal.estimation import warm_up
from fieldcal.geometry.rotation import Array
from fieldcal.names import Method, Sensor, Status
from fieldcal.reason_codes import ReasonCode
from fieldcal.stages.inputs import Tables, is_sound
from fieldcal.stages.results import ZERO_SLOPE, StageResult, zero_slope_rows
from fieldcal.stages.tables import CalibrationRow, calibration_rows, constants, matrix, seconds, triad

if TYPE_CHECKING:
    from fieldcal.config.stage_settings import WarmUpSettings

METHOD, PARAMETER = Method.WARM_UP, ZERO_SLOPE
CURVE = "zero_over_temperature"
"""Key in `measured`: the zero as a cubic of temperature without its constant term, an axis a row."""


def find_warm_up(tables: Tables, s: WarmUpSettings) -> StageResult:
    """imu, temperature → calibration: slope of the gyroscope's zero, and of the accelerometer's as far as it shows,
    where the IMU rested while it warmed up."""
    imu, temperature = tables["imu"], tables.get("temperature")
    logged = matrix(imu, triad("gyroscope"))
    if temperature is None or (temperature := temperature.drop_nulls()).is_empty() or np.isnan(logged).any():
        return StageResult(
            status=Status.ABSENT, reason_code=ReasonCode.NO_TEMPERATURE, reason="Gyroscope or temperature is missing."
        )
    t = seconds(imu["t_ns"], imu["t_ns"][0])
    warm = np.interp(t, seconds(temperature["t_ns"], imu["t_ns"][0]), temperature["temperature_degc"].to_numpy())
    try:
        found = warm_up.fit_warm_up(t, logged, warm, max_gap_s=s.manoeuvre_max_gap_s)
    except UnusableFlight as error:
        return StageResult(
            status=Status.ABSENT, reason_code=error.reason_code, reason=error.sentence, measured=error.measured
        )
    rows = _rows(Sensor.GYROSCOPE, found, s)
    resting = _resting(tables, s, t, logged, warm)
    if resting is not None:
        rows += _rows(Sensor.ACCELEROMETER, resting, s)
    measured = {"rest_windows": found.n_windows, "span_degc": found.span_degc, "zero": found.zero.tolist()}
    if found.bend is not None and found.bend_covariance is not None:
        measured |= {
            CURVE: {
                "centre_degc": found.temperature_degc,
                "width_degc": found.width_degc,
                "coefficients": found.bend.tolist(),
                "covariance": found.bend_covariance.tolist(),
            }
        }
    return StageResult({"calibration": calibration_rows(rows)}, measured=measured)


def _rows(sensor: Sensor, found: warm_up.WarmUp, s: WarmUpSettings) -> list[CalibrationRow]:
    return zero_slope_rows(
        sensor,
        METHOD,
        found.zero_per_degc,
        found.sd,
        logged_unit=s.units[sensor],
        temperature_degc=found.temperature_degc,
    )


def _resting(tables: Tables, s: WarmUpSettings, t: Array, rate: Array, warm: Array) -> warm_up.WarmUp | None:
    """The accelerometer's warm-up at rest; None without constants or such a rest, and where it is faulty."""
    calibrated = constants(tables["accelerometer"], Sensor.ACCELEROMETER) if "accelerometer" in tables else None
    if calibrated is None or not is_sound(tables, "accelerometer"):
        return None
    scale, bias = calibrated
    logged = matrix(tables["imu"], triad("accelerometer"))
    if np.isnan(logged).any():
        return None
    gravity = logged + np.linalg.solve(scale, bias)
    try:
        return warm_up.fit_resting_accelerometer(t, rate, logged, warm, gravity, max_gap_s=s.manoeuvre_max_gap_s)
    except UnusableFlight:
        return None
