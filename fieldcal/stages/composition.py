"""From constants of readings that an autopilot had corrected to those of the raw sensor, whose history is kept."""

from __future__ import annotations

from typing import TYPE_CHECKING, cast

import numpy as np
import polars as pl

from fieldcal.geometry.rotation import Array
from fieldcal.names import SENSORS, Json, Status
from fieldcal.reason_codes import ReasonCode
from fieldcal.stages.inputs import Tables
from fieldcal.stages.results import ZERO_SLOPE, StageResult
from fieldcal.stages.tables import AXES, CalibrationRow, calibration_rows

if TYPE_CHECKING:
    from fieldcal.config.stage_settings import CompositionSettings

RESIDUAL = "residual_"
"""Before the parameters that hold for the readings as they are logged."""

COMPOSED = ("scale", "bias", "zero", "zero_bias")


def compose(tables: Tables, s: CompositionSettings) -> StageResult:
    """Calibration of the logged readings → calibration of the raw ones, in the axes of the logged; those of the logged
    beside, as `residual_`, where the two differ.

    z = Λ logged + b and logged = P raw + o make z = (Λ P) raw + (Λ o + b): the zero is P⁻¹ (zero − o)."""
    parts = [tables[name] for name in ("calibration", "warm_up") if name in tables]
    if not parts:
        return StageResult(
            status=Status.REFUSED, reason_code=ReasonCode.NOTHING_CALIBRATED, reason="No method gave constants."
        )
    rows = pl.concat(parts)
    out = [rows.filter(~pl.col("sensor").is_in([name for name in SENSORS if s.applied_matrix[name] is not None]))]
    composed: list[str] = []
    for sensor in SENSORS:
        own, matrix, offset = rows.filter(sensor=sensor), s.applied_matrix[sensor], s.applied_offset[sensor]
        if matrix is None or offset is None or own.is_empty():
            continue
        composed.append(str(sensor))
        uncertain = s.applied_matrix_sd[sensor] or 0.0, np.array(s.applied_offset_sd[sensor] or (0.0, 0.0, 0.0))
        for _, of_method in own.group_by("method", maintain_order=True):
            out.append(_of_raw(of_method, np.array(matrix), np.array(offset), *uncertain))
            residual = of_method.filter(pl.col("parameter").is_in([*COMPOSED, ZERO_SLOPE]))
            out.append(residual.with_columns(parameter=pl.lit(RESIDUAL) + pl.col("parameter")))
    measured: dict[str, Json] = {"composed": composed} if composed else {}
    return StageResult({"calibration": pl.concat(out)}, measured=measured)


def in_log(rows: pl.DataFrame) -> pl.DataFrame:
    """Rows of `calibration` that hold for the readings as they were logged."""
    residual = pl.col("parameter").str.starts_with(RESIDUAL)
    if rows.filter(residual).is_empty():
        return rows
    corrected = rows.filter(residual)["sensor"].unique().to_list()
    of_raw = pl.col("sensor").is_in(corrected) & pl.col("parameter").is_in([*COMPOSED, ZERO_SLOPE])
    return rows.filter(~of_raw).with_columns(parameter=pl.col("parameter").str.strip_prefix(RESIDUAL))


def _of_raw(rows: pl.DataFrame, p: Array, o: Array, p_sd: float, o_sd: Array) -> pl.DataFrame:
    """One sensor's rows of one method. Scale and zero hardly depend on each other, and stand for the rest."""
    found = {(row["parameter"], row["axis"]): row for row in cast(list[CalibrationRow], rows.to_dicts())}
    inverse = np.linalg.inv(p)
    others = [row for (parameter, _), row in found.items() if parameter not in (*COMPOSED, ZERO_SLOPE)]
    if ZERO_SLOPE in {parameter for parameter, _ in found}:
        own = [found[ZERO_SLOPE, axis] for axis in AXES]
        slope, slope_sd = _numbers(own)
        others += _with(own, inverse @ slope, np.sqrt(inverse**2 @ slope_sd**2))
    if ("scale", "x") not in found or ("zero", "x") not in found:
        return calibration_rows(others)
    full = ("scale", "xy") in found or np.any(np.abs(p - np.diag(np.diagonal(p))) > SQUARE)
    scale, scale_sd = np.zeros((3, 3)), np.zeros((3, 3))
    for i, row_axis in enumerate(AXES):
        for j, column_axis in enumerate(AXES):
            row = found.get(("scale", row_axis + column_axis)) or (found["scale", row_axis] if i == j else None)
            if row is not None:
                scale[i, j], scale_sd[i, j] = row["value"] or np.nan, row["sd"] or np.nan
    zero, zero_sd = _numbers([found["zero", axis] for axis in AXES])
    raw_scale = scale @ p
    raw_scale_sd = np.sqrt(scale_sd**2 @ p**2 + p_sd**2 * np.sum(scale**2, axis=1, keepdims=True))
    raw_zero = inverse @ (zero - o)
    raw_zero_sd = np.sqrt(inverse**2 @ (zero_sd**2 + o_sd**2))
    bias = -raw_scale @ raw_zero
    bias_sd = np.sqrt(raw_scale_sd**2 @ raw_zero**2 + raw_scale**2 @ raw_zero_sd**2)
    scales = [found["scale", axis] for axis in AXES]
    out = _with(scales, np.diagonal(raw_scale), np.diagonal(raw_scale_sd))
    out += _with([found["bias", axis] for axis in AXES], bias, bias_sd)
    out += _with([found["zero", axis] for axis in AXES], raw_zero, raw_zero_sd)
    out += [found["zero_bias", axis] for axis in AXES if ("zero_bias", axis) in found]
    if full:
        for i, axis in enumerate(AXES):
            names = [{**scales[i], "axis": axis + other} for other in AXES]
            out += _with(names, raw_scale[i], raw_scale_sd[i])
    return calibration_rows(out + others)


SQUARE = 1e-9
"""Off-diagonal share of a matrix that is rounding."""


def _numbers(rows: list[CalibrationRow]) -> tuple[Array, Array]:
    values = np.array([np.nan if row["value"] is None else row["value"] for row in rows])
    return values, np.array([np.nan if row["sd"] is None else row["sd"] for row in rows])


def _with(rows: list[CalibrationRow], value: Array, sd: Array) -> list[CalibrationRow]:
    """The same rows with other numbers; what is not finite is None."""
    finite = [[float(x) if np.isfinite(x) else None for x in numbers] for numbers in (value, sd)]
    return [{**row, "value": v, "sd": u} for row, v, u in zip(rows, *finite, strict=True)]
