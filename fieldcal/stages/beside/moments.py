"""What a flight adds to a fit of many: moments of its vector triads, and the gyroscope's normal equations, as on board.

Beside the flight's own estimates, refused ones too: short flights that tell nothing alone tell something together.
"""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import numpy as np
import polars as pl

from fieldcal.estimation import wahba
from fieldcal.estimation.segments import run_bounds
from fieldcal.geometry.rotation import Array
from fieldcal.names import VECTOR_SENSORS, Sensor
from fieldcal.onboard.board import block_samples_at, undisturbed
from fieldcal.onboard.noise import readings_in_mean
from fieldcal.onboard.streams import Moments, RateEquations
from fieldcal.stages.attitude import body_vectors, known_vectors, reference_vectors, sensor_attitude
from fieldcal.stages.inputs import Tables, in_used_segments, is_sound, mean_temperature
from fieldcal.stages.results import StageResult
from fieldcal.stages.tables import matrix, triad

if TYPE_CHECKING:
    from fieldcal.config.stage_settings import MomentsSettings

EQUAL_TRUST = (0.01, 0.01)
"""Rad, of field and gravity, as `BoardSettings` has it."""
GAP = 5.0
"""Intervals without a reading after which the next does not follow on."""
SCHEMA = {
    "sensor": pl.String,
    "magnitude": pl.Float64,
    "unit": pl.String,
    "logged_unit": pl.String,
    "temperature_degc": pl.Float64,
    "reading_rate_hz": pl.Float64,
    "block_samples": pl.Int64,
    "n_samples": pl.Int64,
    "n_differences": pl.Int64,
    "sums": pl.String,
}


def collect_moments(tables: Tables, s: MomentsSettings) -> StageResult:
    """Unsmoothed readings of the used segments, and attitudes → moments, a row a sensor that is sound."""
    strength = float(np.linalg.norm(s.field_ned))
    wanted = {Sensor.MAGNETOMETER: (strength, s.field_unit), Sensor.ACCELEROMETER: (s.gravity_mps2, "m/s^2")}
    rows = []
    for sensor in VECTOR_SENSORS:
        found = _vector_moments(tables, sensor) if is_sound(tables, sensor) else None
        if found is not None:
            rows.append(_row(tables, s, sensor, *wanted[sensor], 0, *found))
    equations = _rate_equations(tables, s) if is_sound(tables, Sensor.GYROSCOPE) else None
    if equations is not None:
        rows.append(_row(tables, s, Sensor.GYROSCOPE, None, "rad/s", equations[0].block_samples, *equations))
    return StageResult({"moments": pl.DataFrame(rows, schema=SCHEMA, orient="row")})


def _row(
    tables: Tables,
    s: MomentsSettings,
    sensor: Sensor,
    magnitude: float | None,
    unit: str,
    block_samples: int,
    state: Moments | RateEquations,
    rate_hz: float,
) -> tuple[object, ...]:
    sums = state.values[1:] if isinstance(state, Moments) else state.values
    centre = np.zeros(3) if state.centre is None else state.centre
    collected = {
        "polarity": [float(sign) for sign in s.polarity[sensor]],
        "centre": centre.tolist(),
        "noise": state.noise.squares.tolist(),
        "sums": sums.tolist(),
    }
    told = (magnitude, unit, s.units[sensor], mean_temperature(tables), rate_hz, block_samples)
    return (str(sensor), *told, state.n_samples, state.noise.n_differences, json.dumps(collected))


def _vector_moments(tables: Tables, sensor: Sensor) -> tuple[Moments, float] | None:
    """Moments of a vector triad and the rate of its readings; None where the log has none."""
    if sensor == Sensor.MAGNETOMETER:
        table = tables.get("magnetometer_log")
        if table is None or table.is_empty():
            return None
        table = table.filter(in_used_segments(table, tables["segments"]))
    else:
        table = tables["samples"]
    t_ns, values = table["t_ns"].to_numpy(), matrix(table, triad(sensor))
    new = np.asarray(np.isfinite(values).all(axis=1))
    if sensor == Sensor.MAGNETOMETER and len(values):
        # Logged faster than it measures, a magnetometer repeats itself.
        new[1:] &= (values[1:] != values[:-1]).any(axis=1)
    t_ns, values = t_ns[new], values[new]
    if len(values) < 2:
        return None
    interval_ns, rate_hz = _rate(t_ns)
    moments = Moments(in_mean=readings_in_mean(rate_hz))
    late = np.flatnonzero(np.diff(t_ns) > GAP * interval_ns) + 1
    for a, b in zip([0, *late], [*late, len(values)], strict=True):
        moments.feed(values[a:b])
        moments.gap()
    return moments, rate_hz


def _rate(t_ns: np.ndarray) -> tuple[float, float]:
    """Median interval of stamps (n,), ns, and the rate, Hz; 0 where they stand."""
    interval_ns = float(np.median(np.diff(t_ns)))
    return interval_ns, 1e9 / interval_ns if interval_ns > 0 else 0.0


def _rate_equations(tables: Tables, s: MomentsSettings) -> tuple[RateEquations, float] | None:
    """The gyroscope's equations and the rate of its readings; None where the vector triads gave no attitude.

    As on board attitudes are those of unsmoothed vectors of equal weight: a block's slope is filter enough."""
    if "attitude" not in tables:
        return None
    samples = tables["samples"]
    values: Array = matrix(samples, triad("gyroscope"))
    t_ns, segment = samples["t_ns"].to_numpy(), samples["segment"].to_numpy()
    if len(values) < 2 or np.isnan(values).all():
        return None
    interval_ns, rate_hz = _rate(t_ns)
    equations = RateEquations(
        block_samples_at(rate_hz), in_mean=readings_in_mean(rate_hz), max_gap_us=GAP * interval_ns * 1e-3
    )
    vectors = body_vectors(samples, known_vectors(tables, s), s, prefix="")
    q = sensor_attitude(wahba.attitudes(vectors, reference_vectors(vectors, s)[0], EQUAL_TRUST).q, s)
    q[~undisturbed(vectors, (float(np.linalg.norm(s.field_ned)), s.gravity_mps2))] = np.nan
    for a, b in run_bounds(segment):
        equations.feed((t_ns[a:b] - t_ns[0]) * 1e-3, q[a:b], values[a:b])
        equations.gap()
    return equations, rate_hz
