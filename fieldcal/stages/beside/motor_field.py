"""Correlation of the calibrated magnetometer with the motors' current, where a log has one."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING

import numpy as np
import polars as pl

from fieldcal.errors import EstimationError, UnusableFlight
from fieldcal.estimation import ellipsoid, motor_field
from fieldcal.estimation.faults import Fault
from fieldcal.geometry import sensor_model
from fieldcal.geometry.intervals import interval_of
from fieldcal.geometry.rotation import Array
from fieldcal.names import Json, Sensor
from fieldcal.reason_codes import ReasonCode
from fieldcal.stages.inputs import Tables, in_used_segments
from fieldcal.stages.results import fatal_fault
from fieldcal.stages.tables import constants, matrix, triad

if TYPE_CHECKING:
    from fieldcal.config.stage_settings import VectorsSettings

PAUSE_S = 1.0
PAUSE = 5.0
"""The current is interpolated over so many of its intervals, and over PAUSE_S, at the most."""

MOST_SAMPLES = 50_000
"""A longer flight's magnetometer is thinned to fewer: the current is slow."""

DRIVES = {"current_a": ("current", "A"), "throttle": ("throttle", "")}
"""Measures of the motors' current, the better one first: column → word and unit."""


def check_motor_field(tables: Tables, s: VectorsSettings) -> tuple[dict[str, Json], list[Fault]]:
    """power, readings and constants of the magnetometer → measured numbers and faults; both empty without a current
    and where `sanity` found the magnetometer faulty."""
    if not {"power", "readings", "segments"} <= tables.keys():
        return {}, []
    if "sanity" in tables and fatal_fault(tables["sanity"], ("magnetometer",)) is not None:
        return {}, []
    readings = tables["readings"].filter(pl.Series(in_used_segments(tables["readings"], tables["segments"])))
    values = matrix(readings, triad("magnetometer"))
    whole = np.isfinite(values).all(axis=1)
    if np.count_nonzero(whole) < motor_field.FEWEST_SAMPLES:
        return {}, []
    calibration = _approximate(tables, s, values[whole])
    if calibration is None:
        return {}, []
    for column, (word, unit) in DRIVES.items():
        power = tables["power"].filter(pl.col(column).is_finite())
        if len(power) < 2:
            continue
        if column == "throttle" and (outside := _outside(power[column].to_numpy())) is not None:
            return {}, [outside]
        drive = _drive_at(readings["t_ns"].to_numpy(), power["t_ns"].to_numpy(), power[column].to_numpy())
        rows = np.flatnonzero(whole & np.isfinite(drive))
        rows = rows[:: 1 + len(rows) // MOST_SAMPLES]
        field = sensor_model.calibrate(values[rows], *calibration)
        found = motor_field.motor_field(field, drive[rows], float(np.linalg.norm(s.field_ned)))
        if found is None:
            continue
        fault = motor_field.motor_fault(found, word, unit, s.field_unit)
        numbers = {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in asdict(found).items()}
        return {"motor_field": {"drive": column, **numbers}}, [fault] if fault else []
    return {}, []


def allow_for_motor_field(rows: pl.DataFrame, share: float, strength: float) -> pl.DataFrame:
    """Magnetometer rows whose sd allows for a field of `share` times the local one that follows the motors' current: a
    fit with constant parameters may absorb all of it in scale or bias without a larger residual."""
    of_axis = rows.filter(pl.col("parameter") == "scale").select("method", "axis", scale=pl.col("value").abs())
    could_err = (
        pl.when(pl.col("parameter") == "scale")
        .then(share * pl.col("scale"))
        .when(pl.col("parameter") == "zero")
        .then(share * strength / pl.col("scale"))
        .when(pl.col("parameter").is_in(["bias", "zero_bias"]))
        .then(share * strength)
        .otherwise(0.0)
    )
    joined = rows.join(of_axis, on=["method", "axis"], how="left", maintain_order="left")
    return joined.with_columns(sd=(pl.col("sd") ** 2 + could_err**2).sqrt()).select(rows.columns)


def _approximate(tables: Tables, s: VectorsSettings, values: Array) -> tuple[Array, Array] | None:
    """Scale and bias to start from: the magnetometer's, of a refused fit too (the current may be why it was refused),
    else the algebraic fit's; what is wrong with them is fitted together with the current's field."""
    fitted = (
        constants(tables["magnetometer"], Sensor.MAGNETOMETER, refused_too=True) if "magnetometer" in tables else None
    )
    if fitted is not None and all(np.isfinite(c).all() for c in fitted):
        return fitted
    strength, polarity = float(np.linalg.norm(s.field_ned)), s.polarity[Sensor.MAGNETOMETER]
    try:
        fit = ellipsoid.fit_ellipsoid(values, strength, method="li", polarity=polarity)
    except (UnusableFlight, EstimationError, ValueError):
        return None
    return fit.scale, fit.bias


def _drive_at(t_ns: np.ndarray, own_ns: np.ndarray, values: Array) -> Array:
    """Current or throttle at the stamps, (n,), linear between its readings; NaN outside them and in their gaps."""
    at, stamps_s = (t_ns - own_ns[0]) * 1e-9, (own_ns - own_ns[0]) * 1e-9
    result = np.interp(at, stamps_s, values, left=np.nan, right=np.nan)
    longest = max(PAUSE_S, PAUSE * float(np.median(np.diff(stamps_s))))
    i = interval_of(stamps_s, at, on_stamp="ends")
    result[stamps_s[i + 1] - stamps_s[i] > longest] = np.nan
    return result


def _outside(throttle: Array) -> Fault | None:
    """The fault of a throttle that leaves 0 to 1, whose unit is unknown; else None."""
    low, high = float(throttle.min()), float(throttle.max())
    if low >= 0.0 and high <= 1.0:
        return None
    sentence = (
        f"The throttle runs from {low:.4g} to {high:.4g} where 0 to 1 is its range: it was not compared with the"
        " magnetometer. Convert the column, or name the current's as csv.imu.current."
    )
    worst = high if high > 1.0 else low
    return Fault("throttle", "", ReasonCode.THROTTLE_RANGE, worst, 1.0 if high > 1.0 else 0.0, False, sentence)
