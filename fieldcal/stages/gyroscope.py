"""Gyroscope: equation error, then output error with the vector triads' uncertainty propagated."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import polars as pl

from fieldcal.errors import EstimationError, UnusableFlight
from fieldcal.estimation.gyroscope import equation_error, output_error
from fieldcal.estimation.gyroscope.equation_error import GyroFit
from fieldcal.estimation.gyroscope.regressor_noise import smoothed_noise_variance
from fieldcal.estimation.statistics import white_noise_sigma
from fieldcal.estimation.uncertainty_propagation import (
    attitude_jacobian,
    constants_to_equation,
    constants_to_gyro,
    thinned,
)
from fieldcal.geometry import sensor_model
from fieldcal.geometry.rotation import Array
from fieldcal.names import VECTOR_SENSORS, Json, Method, Sensor, Status
from fieldcal.reason_codes import ReasonCode
from fieldcal.stages.attitude import body_vectors, known_vectors, logged_constants, sensor_attitude
from fieldcal.stages.inputs import (
    Tables,
    differentiate_by_segment,
    mean_temperature,
    reference_reading,
    refusal,
    spread_of,
)
from fieldcal.stages.results import StageResult, triad_rows
from fieldcal.stages.tables import (
    AXES,
    QUATERNION,
    calibration_rows,
    constants,
    covariance_of,
    covariance_table,
    matrix,
    seconds,
    triad,
)

if TYPE_CHECKING:
    from fieldcal.config.stage_settings import (
        GyroEquationPass2Settings,
        GyroEquationSettings,
        GyroOutputSettings,
        GyroSettings,
        LoggedValues,
        TriadUncertainty,
    )

MAX_MEDIAN_ATTITUDE_ERROR_RAD = 0.35


RUN_IN_STRETCH_S = 15.0


GYRO_REASONS = "Gyroscope axes refused ({axes}): too little rotation about them, or polarity and units that contradict."


def calibrate_gyro_equation(tables: Tables, s: GyroEquationSettings) -> StageResult:
    """samples, attitude → calibration of the gyroscope by equation error (Eq. 10–15).

    The variance of the noise that smoothing leaves in the regressor is subtracted from the normal equations."""
    return _equation_error(tables, s, None)


def calibrate_gyro_equation_pass2(tables: Tables, s: GyroEquationPass2Settings) -> StageResult:
    """The same from the second pass's attitude; the vector triads' covariances, where given, are propagated into the
    sd."""
    return _equation_error(tables, s, s)


def _equation_error(tables: Tables, s: GyroEquationSettings, triads: TriadUncertainty | None) -> StageResult:
    samples, attitude = tables["samples"], tables["attitude"]
    logged = matrix(samples, triad("gyroscope", "smoothed_"))
    if np.isnan(logged).any():
        return StageResult(
            status=Status.REFUSED, reason_code=ReasonCode.NO_GYROSCOPE, reason="The log has no gyroscope readings."
        )
    q = sensor_attitude(matrix(attitude, QUATERNION), s)
    weight = attitude["weight"].to_numpy()
    noise_variance = smoothed_noise_variance(
        seconds(samples["t_ns"], samples["t_ns"][0]),
        matrix(samples, triad("gyroscope")),
        samples["segment"].to_numpy(),
        s.smoothing_cutoff_hz,
        side_s=s.smoothing_side_s,
    )
    try:
        fit = equation_error.fit_equation_error(
            q,
            differentiate_by_segment(samples, q, s.differentiation_window_s),
            logged,
            equations=s.equations,
            weights=weight,
            noise_variance=noise_variance,
        )
    except UnusableFlight as error:
        return refusal(error, "gyroscope")
    pairs = []
    for jacobian, covariance in [] if triads is None else _triad_uncertainty(tables, triads):
        flat = jacobian.reshape(len(q), -1)
        derivative = differentiate_by_segment(samples, flat, s.differentiation_window_s).reshape(jacobian.shape)
        pairs.append((jacobian, derivative, covariance))
    rate = fit.scale * logged + fit.bias
    only_scalar = q if s.equations == "scalar" else None
    covariance = fit.covariance + constants_to_equation(logged, rate, weight, pairs, only_scalar)
    measured: dict[str, Json] = {
        "residual_rms": fit.residual_rms,
        "noise_share_of_regressor": [float(v) for v in noise_variance / logged.var(axis=0)],
    }
    return _gyro_result(Method.EQUATION_ERROR, fit, covariance, tables, s, measured)


def _gyro_result(
    method: Method, fit: GyroFit, covariance: Array, tables: Tables, s: GyroSettings, measured: dict[str, Json]
) -> StageResult:
    """Gyroscope rows with a status by axis: sign against polarity, size against nominal, claimed sd."""
    relative = np.sqrt(np.diagonal(covariance)[:3]) / np.abs(fit.scale)
    sign_wrong = np.sign(fit.scale) != np.sign(np.asarray(s.polarity[Sensor.GYROSCOPE], dtype=float))
    codes: list[ReasonCode | None] = [None] * 3
    nominal = s.nominal_scale[Sensor.GYROSCOPE]
    for i in range(3):
        ratio = 1.0 if nominal is None else abs(fit.scale[i]) / abs(nominal[i])
        if not relative[i] <= s.gyro_max_scale_sd:
            codes[i] = ReasonCode.SCALE_UNCERTAIN
        elif sign_wrong[i]:
            codes[i] = ReasonCode.POLARITY_CONTRADICTION
        elif not 0.5 <= ratio <= 2.0:
            codes[i] = ReasonCode.SCALE_NOT_NOMINAL
    measured = {
        **measured,
        "n_samples": fit.n_samples,
        "iterations": fit.iterations,
        "scale_relative_sd": [float(v) for v in relative],
        "scale_relative_sd_cramer_rao": [
            float(v) for v in np.sqrt(np.diagonal(fit.covariance_white)[:3]) / np.abs(fit.scale)
        ],
    }
    rows = triad_rows(
        Sensor.GYROSCOPE,
        method,
        np.diag(fit.scale),
        fit.bias,
        covariance,
        unit="rad/s",
        logged_unit=s.units[Sensor.GYROSCOPE],
        reference_reading=reference_reading(s, Sensor.GYROSCOPE, matrix(tables["samples"], triad("gyroscope"))),
        temperature_degc=mean_temperature(tables),
        reason_code=codes,
    )
    bad = [f"{axis}: {code}" for axis, code in zip(AXES, codes, strict=True) if code]
    status = Status.REFUSED if len(bad) == 3 else Status.OK
    reason = GYRO_REASONS.format(axes=", ".join(bad)) if bad else None
    first = next((c for c in codes if c), None)
    result = {"calibration": calibration_rows(rows), "covariance": covariance_table(covariance)}
    return StageResult(result, status, first, reason, measured)


def calibrate_gyro_output(tables: Tables, s: GyroOutputSettings) -> StageResult:
    """samples, attitude, equation-error start → calibration by output error, with the triads' uncertainty
    propagated.

    Equation error's rows are handed on; those that output error contradicts are refused."""
    equation = tables["gyroscope"]
    result = _output_error(tables, s)
    if "calibration" not in result.tables:
        return replace(result, tables={"calibration": equation})
    output = result.tables["calibration"]
    wrong = _contradicted(equation, output)
    judged = equation.with_columns(
        status=pl.when(pl.col("axis").is_in(wrong)).then(pl.lit(Status.REFUSED)).otherwise("status"),
        reason_code=pl.when(pl.col("axis").is_in(wrong))
        .then(pl.lit(ReasonCode.CONTRADICTED_BY_OUTPUT_ERROR))
        .otherwise("reason_code"),
    )
    measured = {**result.measured, "equation_error_contradicted": wrong}
    return replace(result, tables={**result.tables, "calibration": pl.concat([judged, output])}, measured=measured)


def _contradicted(equation: pl.DataFrame, output: pl.DataFrame) -> list[str]:
    """Axes whose equation-error scale differs from output error's by more than 3 sd of both and 1 %."""
    pairs = (
        equation.filter(parameter="scale", status=Status.OK)
        .join(output.filter(parameter="scale", status=Status.OK), on="axis", suffix="_oe")
        .filter(
            (pl.col("value") - pl.col("value_oe")).abs()
            > pl.max_horizontal(
                3.0 * (pl.col("sd") ** 2 + pl.col("sd_oe") ** 2).sqrt(), 0.01 * pl.col("value_oe").abs()
            )
        )
    )
    return pairs["axis"].to_list()


def _output_error(tables: Tables, s: GyroOutputSettings) -> StageResult:
    """Rows of output error."""
    if not s.gyro_output:
        return StageResult(
            status=Status.ABSENT, reason_code=ReasonCode.SWITCHED_OFF, reason="Output error is switched off."
        )
    samples, attitude = tables["samples"], tables["attitude"]
    logged = matrix(samples, triad("gyroscope"))
    t = seconds(samples["t_ns"], samples["t_ns"][0])
    segment, weight = samples["segment"].to_numpy(), attitude["weight"].to_numpy()
    q = sensor_attitude(matrix(attitude, QUATERNION), s)
    start = _start(tables["gyroscope"], t, q, logged, segment, weight, s)
    stretch_s = s.shooting_s or _suitable_stretch(start, t, logged, tables)
    fit_from = partial(
        output_error.fit_output_error,
        t,
        q,
        logged,
        segment=segment,
        weights=weight,
        initial_attitude=s.initial_attitude,
        robust=s.initial_attitude == "estimated",
    )
    try:
        if stretch_s > 1.5 * RUN_IN_STRETCH_S and s.initial_attitude == "estimated":
            start = fit_from(start, stretch_s=RUN_IN_STRETCH_S)
        fit = fit_from(start, stretch_s=stretch_s)
    except EstimationError as error:
        return refusal(error, "gyroscope")
    median = output_error.attitude_error_median(t, q, fit.scale * logged + fit.bias, segment, stretch_s, weight)
    measured: dict[str, Json] = {
        "stretch_s": stretch_s,
        "attitude_error_rms_deg": float(np.degrees(fit.residual_rms)),
        "attitude_error_median_deg": float(np.degrees(median)),
    }
    if median > MAX_MEDIAN_ATTITUDE_ERROR_RAD:
        return StageResult(
            status=Status.REFUSED,
            reason_code=ReasonCode.GYRO_CONTRADICTS_ATTITUDE,
            reason=f"The integrated gyroscope misses the attitude by {np.degrees(median):.0f}° (median): wrong"
            " polarity, axes or units of a sensor, or attitudes spoiled by acceleration.",
            measured=measured,
        )
    thin = thinned(len(t))
    pairs = _triad_uncertainty(tables, s, thin)
    propagated = constants_to_gyro(t[thin], q[thin], segment[thin], logged[thin], weight[thin], fit, stretch_s, pairs)
    measured["propagated_share_of_variance"] = [
        float(v) for v in np.diagonal(propagated)[:3] / np.diagonal(fit.covariance + propagated)[:3]
    ]
    return _gyro_result(Method.OUTPUT_ERROR, fit, fit.covariance + propagated, tables, s, measured)


def _start(
    equation: pl.DataFrame, t: Array, q: Array, logged: Array, segment: np.ndarray, weight: Array, s: LoggedValues
) -> GyroFit:
    """The nearer of equation error's constants and, for SI logs, the logged values."""
    values = {(p, a): v for p, a, v in equation.select("parameter", "axis", "value").iter_rows()}
    start = GyroFit(
        scale=np.array([values["scale", a] for a in AXES]),
        bias=np.array([values["bias", a] for a in AXES]),
        covariance=np.zeros((6, 6)),
        covariance_white=np.zeros((6, 6)),
        residual_rms=0.0,
        n_samples=len(t),
    )
    nominal_constants = logged_constants(s, Sensor.GYROSCOPE)
    if nominal_constants is None:
        return start
    nominal = replace(start, scale=np.diagonal(nominal_constants[0]).copy(), bias=nominal_constants[1])
    error = [
        output_error.attitude_error_median(t, q, c.scale * logged + c.bias, segment, RUN_IN_STRETCH_S, weight)
        for c in (start, nominal)
    ]
    return start if error[0] <= error[1] else nominal


def _suitable_stretch(start: GyroFit, t: Array, logged: Array, tables: Tables) -> float:
    """Length of the integrated stretches, s, from the gyroscope's white noise and the attitude's error."""
    noise = white_noise_sigma(logged)
    excess = tables["attitude"]["acceleration_excess_mps2"].to_numpy(), tables["attitude"]["field_excess"].to_numpy()
    error = max(spread_of(excess[0] / 9.81), spread_of(excess[1]))
    return output_error.suitable_stretch_s(
        float(np.max(noise * np.abs(start.scale))), float(np.median(np.diff(t))), error
    )


def _triad_uncertainty(tables: Tables, s: TriadUncertainty, used: slice = slice(None)) -> list[tuple[Array, Array]]:
    """Of each vector triad with a covariance: the Jacobian of the attitude error, sensor axes, to its constants
    (n, 3, 6), at the samples used, and their covariance (6, 6). See `estimation.uncertainty_propagation`."""
    if not any(f"{name}_covariance" in tables for name in VECTOR_SENSORS):
        return []
    samples, attitude = tables["samples"], tables["attitude"]
    axes = sensor_model.frd_from_sensor(s.rotation_body_from_sensor, s.body)
    vectors = body_vectors(samples, known_vectors(tables, s), s, prefix="smoothed_")
    spread = (
        spread_of(attitude["field_excess"].to_numpy()),
        spread_of(attitude["acceleration_excess_mps2"].to_numpy() / s.gravity_mps2),
    )
    sign = {"magnetometer": 1.0, "accelerometer": sensor_model.GRAVITY_SIGNS[s.gravity_sign]}
    pairs = []
    for i, name in enumerate(VECTOR_SENSORS):
        covariance = tables.get(f"{name}_covariance")
        if covariance is None or constants(tables[name], name) is None:
            continue
        logged = matrix(samples, triad(name, "smoothed_"))
        jacobian = attitude_jacobian(vectors[used], np.array(spread), i, logged[used], sign[name] * axes)
        pairs.append((np.einsum("ji,njp->nip", axes, jacobian), covariance_of(covariance)))
    return pairs
