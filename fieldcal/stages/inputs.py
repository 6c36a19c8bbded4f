"""What several stages ask of their inputs: temperature, reference readings, derivatives by segment, refusals."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
import polars as pl

from fieldcal.errors import FieldcalError
from fieldcal.estimation import smoothing
from fieldcal.estimation.segments import run_bounds
from fieldcal.estimation.statistics import robust_sigma
from fieldcal.geometry.rotation import Array
from fieldcal.geometry.sensor_model import default_reference_reading
from fieldcal.names import Json, Sensor, Status
from fieldcal.reason_codes import ReasonCode
from fieldcal.stages.results import StageResult, fatal_fault

if TYPE_CHECKING:
    from fieldcal.config.stage_settings import ReferenceReading

Tables = Mapping[str, pl.DataFrame]


def mean_temperature(tables: Tables) -> float | None:
    """Mean logged temperature, °C, over the flight."""
    table = tables.get("temperature")
    return None if table is None or table.is_empty() else float(table["temperature_degc"].mean())  # type: ignore[arg-type]


def is_sound(tables: Tables, sensor: str) -> bool:
    """Whether neither `sanity` nor the comparison with the motors' current found a fatal fault of a sensor."""
    found = [tables[name] for name in ("faults", "motor_faults") if name in tables]
    return all(fatal_fault(faults, (sensor,)) is None for faults in found)


def in_used_segments(table: pl.DataFrame, segments: pl.DataFrame) -> np.ndarray:
    """Which rows of a signal table lie in used segments, (n,)."""
    t = table["t_ns"].to_numpy()
    inside = np.zeros(len(t), dtype=bool)
    for start, end in segments.filter(pl.col("used")).select("start_ns", "end_ns").iter_rows():
        inside |= (t >= start) & (t <= end)
    return inside


def reference_reading(s: ReferenceReading, name: Sensor, logged: Array) -> Array:
    configured = s.reference_reading[name]
    return default_reference_reading(logged, s.units[name]) if configured is None else np.asarray(configured)


def differentiate_by_segment(samples: pl.DataFrame, x: Array, window_s: float) -> Array:
    """Local smoothed derivative of x (n, m) by segment."""
    t_ns, segment = samples["t_ns"].to_numpy(), samples["segment"].to_numpy()
    out = np.empty_like(x)
    for a, b in run_bounds(segment):
        out[a:b] = smoothing.differentiate_samples((t_ns[a:b] - t_ns[a]) * 1e-9, x[a:b], window_s=window_s)
    return out


def spread_of(excess: Array) -> float:
    """Robust sd of the relative error of a vector's length, taken for the sd of its direction, rad; at least 1e-4."""
    return max(robust_sigma(excess - np.median(excess)), 1e-4)


def refusal(error: Exception, name: str, measured: Mapping[str, Json] | None = None) -> StageResult:
    """A refusal without tables, from an error of the estimation."""
    code = error.reason_code if isinstance(error, FieldcalError) else ReasonCode.UNUSABLE_READINGS
    return StageResult(
        status=Status.REFUSED,
        reason_code=code,
        reason=f"{name.capitalize()}: {error}",
        measured={**(measured or {}), **(error.measured if isinstance(error, FieldcalError) else {})},
    )
