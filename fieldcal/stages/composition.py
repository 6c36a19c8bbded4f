"""From constants of readings that an autopilot had corrected to those of the raw sensor, whose history is kept."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, cast

import numpy as np
import polars as pl

from fieldcal.geometry.earth_field import UNIT_IN_TESLA, dip_rad
from fieldcal.geometry.rotation import Array
from fieldcal.geometry.sensor_model import through
from fieldcal.names import FIELD_ASSUMED, RESIDUAL, SENSORS, Json, Status
from fieldcal.reason_codes import ReasonCode
from fieldcal.stages.inputs import Tables
from fieldcal.stages.joint.beside import DIP
from fieldcal.stages.joint.information import equations_of, kept, of_raw, rewritten
from fieldcal.stages.results import ZERO_SLOPE, StageResult
from fieldcal.stages.tables import AXES, CalibrationRow, calibration_rows

if TYPE_CHECKING:
    from fieldcal.config.stage_settings import CompositionSettings

COMPOSED = ("scale", "bias", "zero", "zero_bias")
ORIGIN = "origin"
"""Among what the stage measured: where its readings come from."""
PUBLISHED_ROWS = "published_rows"
"""And how many constants were not refused, or are told something of in table `information`."""
SQUARE = 1e-9
"""Off-diagonal share of a matrix that is rounding."""


def compose(tables: Tables, s: CompositionSettings) -> StageResult:
    """Calibration of the logged readings → calibration of the raw ones, in the axes of the logged; those of the logged
    beside, as `residual_`, where the two differ. Only of the unit's own sensors.

    z = Λ logged + b and logged = P raw + o make z = (Λ P) raw + (Λ o + b): the zero is P⁻¹ (zero − o)."""
    parts = [tables[name] for name in ("calibration", "warm_up") if name in tables]
    if not parts:
        return StageResult(
            status=Status.REFUSED, reason_code=ReasonCode.NOTHING_CALIBRATED, reason="No method gave constants."
        )
    rows = pl.concat(parts).filter(pl.col("sensor").is_in(s.own_sensors))
    of_matrix, of_offset, is_known = s.applied_matrix, s.applied_offset, s.applied_known
    matrix_sd, offset_sd, per_degc = s.applied_matrix_sd, s.applied_offset_sd, s.applied_offset_per_degc
    out = [rows.filter(~pl.col("sensor").is_in([name for name in SENSORS if of_matrix[name] is not None]))]
    composed: list[str] = []
    for sensor in SENSORS:
        own, matrix, offset = rows.filter(sensor=sensor), of_matrix[sensor], of_offset[sensor]
        if matrix is None or offset is None or own.is_empty():
            continue
        if is_known[sensor] and np.allclose(matrix, np.eye(3), atol=SQUARE) and not np.any(offset):
            out.append(own)  # by nothing but its mounting
            continue
        composed.append(str(sensor))
        slope = np.array(per_degc[sensor] or (0.0, 0.0, 0.0))
        uncertain = matrix_sd[sensor] or 0.0, np.array(offset_sd[sensor] or (0.0, 0.0, 0.0))
        for _, of_method in own.group_by("method", maintain_order=True):
            of_raw = _of_raw(of_method, np.array(matrix), np.array(offset), slope, *uncertain)
            out.append(of_raw if is_known[sensor] else _not_known(of_raw))
            residual = of_method.filter(pl.col("parameter").is_in([*COMPOSED, ZERO_SLOPE]))
            out.append(residual.with_columns(parameter=pl.lit(RESIDUAL) + pl.col("parameter")))
    rows = pl.concat(out)
    published = rows.filter((pl.col("status") == Status.OK) & pl.col("value").is_not_null()).height
    made = {"calibration": rows}
    if "information" in tables:
        made["information"] = _information(tables["information"], s)
        published += made["information"].height
    measured: dict[str, Json] = {
        ORIGIN: _origin(s, rows),
        PUBLISHED_ROWS: published,
        **({"composed": composed} if composed else {}),
    }
    return StageResult(made, measured=measured)


def _information(rows: pl.DataFrame, s: CompositionSettings) -> pl.DataFrame:
    """The same of what the flight says of all constants together; nothing of a sensor whose correction is not known."""
    own = [
        name
        for name in s.own_sensors
        if s.applied_matrix[name] is None or s.applied_offset[name] is None or s.applied_known[name]
    ]
    names = rows.filter(pl.col("sensor").is_in(own)).select("sensor", "parameter", "axis")
    rows = kept(rows, set(names.iter_rows()))
    if rows.is_empty():
        return rows
    found = equations_of(rows)
    for sensor in own:
        matrix, offset = s.applied_matrix[sensor], s.applied_offset[sensor]
        if matrix is None or offset is None or (str(sensor), "zero", "x") not in found.names:
            continue
        slope, offset_sd = (np.array(x[sensor] or (0.0,) * 3) for x in (s.applied_offset_per_degc, s.applied_offset_sd))
        uncertain = s.applied_matrix_sd[sensor] or 0.0, offset_sd
        found = of_raw(found, sensor, np.array(matrix), np.array(offset), slope, *uncertain)
    return rewritten(rows, found)


def _origin(s: CompositionSettings, rows: pl.DataFrame) -> dict[str, Json]:
    """What an export has to know of the readings: their axes and signs, and what an autopilot had loaded for them."""
    loaded = {str(sensor): asdict(own) for sensor in s.own_sensors if (own := s.loaded[sensor]) is not None}
    return {
        "body": s.body,
        "gravity_sign": s.gravity_sign,
        "rotation_body_from_sensor": s.rotation_body_from_sensor,
        "horizontal_field_g": _horizontal_field_g(s),
        "horizontal_share": _horizontal_share(s, rows),
        "loaded": loaded,
    }


def _horizontal_field_g(s: CompositionSettings) -> float | None:
    """By what a compass points; None where the field's strength is not known."""
    tesla = UNIT_IN_TESLA.get(s.field_unit)
    return None if tesla is None else float(np.hypot(*s.field_ned[:2])) * tesla / UNIT_IN_TESLA["G"]


def _horizontal_share(s: CompositionSettings, rows: pl.DataFrame) -> float | None:
    """Of the local field: by the configured or modelled one, else by the dip that the flight showed; None without."""
    if s.field_source != FIELD_ASSUMED:
        return float(np.cos(dip_rad(np.array(s.field_ned))))
    found = rows.filter(pl.col("parameter") == DIP, pl.col("status") == Status.OK).sort("sd")
    return None if found.is_empty() else float(np.cos(found["value"][0]))


def _not_known(rows: pl.DataFrame) -> pl.DataFrame:
    """Rows refused: what the autopilot had done to the readings is not in the log, and so nothing of the raw sensor."""
    which = pl.col("parameter").is_in(COMPOSED) & (pl.col("status") == Status.OK)
    return rows.with_columns(
        status=pl.when(which).then(pl.lit(str(Status.REFUSED))).otherwise("status"),
        reason_code=pl.when(which).then(pl.lit(str(ReasonCode.ALREADY_CORRECTED))).otherwise("reason_code"),
    )


def in_log(rows: pl.DataFrame) -> pl.DataFrame:
    """Rows of `calibration` that hold for the readings as they were logged."""
    residual = pl.col("parameter").str.starts_with(RESIDUAL)
    if rows.filter(residual).is_empty():
        return rows
    corrected = rows.filter(residual)["sensor"].unique().to_list()
    of_raw = pl.col("sensor").is_in(corrected) & pl.col("parameter").is_in([*COMPOSED, ZERO_SLOPE])
    return rows.filter(~of_raw).with_columns(parameter=pl.col("parameter").str.strip_prefix(RESIDUAL))


def _of_raw(rows: pl.DataFrame, p: Array, o: Array, o_per_degc: Array, p_sd: float, o_sd: Array) -> pl.DataFrame:
    """One sensor's rows of one method. Scale and zero hardly depend on each other, and stand for the rest."""
    found = {(row["parameter"], row["axis"]): row for row in cast(list[CalibrationRow], rows.to_dicts())}
    inverse = np.linalg.inv(p)
    others = [row for (parameter, _), row in found.items() if parameter not in (*COMPOSED, ZERO_SLOPE)]
    if ZERO_SLOPE in {parameter for parameter, _ in found}:
        own = [found[ZERO_SLOPE, axis] for axis in AXES]
        slope, slope_sd = _numbers(own)
        others += _with(own, through(inverse, slope - o_per_degc), np.sqrt(through(inverse**2, slope_sd**2)))
    if ("scale", "x") not in found or ("zero", "x") not in found:
        return calibration_rows(others)
    full = ("scale", "xy") in found or np.any(np.abs(p - np.diag(np.diagonal(p))) > SQUARE)
    scale, scale_sd = np.zeros((3, 3)), np.zeros((3, 3))
    for i, row_axis in enumerate(AXES):
        for j, column_axis in enumerate(AXES):
            row = found.get(("scale", row_axis + column_axis)) or (found["scale", row_axis] if i == j else None)
            if row is not None:
                (scale[i, j],), (scale_sd[i, j],) = _numbers([row])
    zero, zero_sd = _numbers([found["zero", axis] for axis in AXES])
    raw_scale = scale @ p
    raw_scale_sd = np.sqrt(scale_sd**2 @ p**2 + p_sd**2 * np.sum(scale**2, axis=1, keepdims=True))
    raw_zero = through(inverse, zero - o)
    raw_zero_sd = np.sqrt(through(inverse**2, zero_sd**2 + o_sd**2))
    bias = -through(raw_scale, raw_zero)
    bias_sd = np.sqrt(through(raw_scale_sd**2, raw_zero**2) + through(raw_scale**2, raw_zero_sd**2))
    scales = [found["scale", axis] for axis in AXES]
    out = _with(scales, np.diagonal(raw_scale), np.diagonal(raw_scale_sd))
    out += _with([found["bias", axis] for axis in AXES], bias, bias_sd)
    out += _with([found["zero", axis] for axis in AXES], raw_zero, raw_zero_sd)
    out += [found["zero_bias", axis] for axis in AXES if ("zero_bias", axis) in found]
    if full:
        for i, axis in enumerate(AXES):
            names = [_copied(scales[i], axis + other) for other in AXES]
            out += _with(names, raw_scale[i], raw_scale_sd[i])
    return calibration_rows(out + others)


def _numbers(rows: list[CalibrationRow]) -> tuple[Array, Array]:
    values = np.array([np.nan if row["value"] is None else row["value"] for row in rows])
    return values, np.array([np.nan if row["sd"] is None else row["sd"] for row in rows])


def _with(rows: list[CalibrationRow], value: Array, sd: Array) -> list[CalibrationRow]:
    """The same rows with other numbers; what is not finite is None."""
    out = []
    for row, own, own_sd in zip(rows, value, sd, strict=True):
        new = row.copy()
        new["value"] = float(own) if np.isfinite(own) else None
        new["sd"] = float(own_sd) if np.isfinite(own_sd) else None
        out.append(new)
    return out


def _copied(row: CalibrationRow, axis: str) -> CalibrationRow:
    new = row.copy()
    new["axis"] = axis
    return new
