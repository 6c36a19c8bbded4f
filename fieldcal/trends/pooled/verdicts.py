"""What the table `drift` says of constants that are pooled: read from the smoother, so that no two places disagree.

A row of the joint estimate whose constant the table `pooled` knows has the smoother's value, slopes, step, drift and
count of flights instead of those of a regression of the flights' own rows; `bias` and `zero_bias`, which follow from
scale and zero, follow here too. The regression stands where flights kept no information, where the smoother refuses the
constant, and with its numbers where it alone has a bend with temperature; without a step or drift where the smoother
waits for another session.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from datetime import datetime

import numpy as np
import polars as pl
from scipy import special

from fieldcal.geometry.rotation import Array
from fieldcal.names import JOINT_METHODS, DriftStatus, Method, Status
from fieldcal.schemas.rows import PooledRow
from fieldcal.trends.pooled.units import DAY, EPOCH
from fieldcal.trends.regression import Trends
from fieldcal.words.rows import typed

MOVING = (DriftStatus.STEP.value, DriftStatus.DRIFTING.value)
KNOWN = (Status.OK.value, *MOVING)
BOTH, OF_BOTH = ("scale", "zero"), ("bias", "zero_bias")
"""Scale and zero, and what follows: scale · (reading − zero), at no reading and at the reference."""
AXIS = ("unit_id", "sensor", "axis")
COLUMNS = tuple(name for name in Trends.__dataclass_fields__ if name != "kept")
OF_CHANGE = ("n_flights", "n_sessions", "last_z", "change_day", "change_size", "change_size_sd", "drift_p")
"""Columns that are the smoother's wherever it judges."""
CURVE = ("curve_per_degc2", "curve_per_degc2_sd", "curve_per_degc3", "curve_per_degc3_sd")
BY_FLIGHT = ("flights", "shares", "distances")
"""Columns of `pooled` that have an entry a flight: nothing here asks them."""
Columns = dict[str, float]
Pools = Mapping[tuple[str, ...], Mapping[str, PooledRow]]
"""Rows of the table `pooled` by `AXIS` and parameter."""


@dataclass(frozen=True)
class Read:
    """Rows of `drift` and their `trends`; `covered` (g,): rows that the smoother judges; by row its `verdict`, "" where
    it has none, and the sentence `beside` the usual one."""

    rows: pl.DataFrame
    trends: Trends
    borrowed: Array
    covered: np.ndarray
    verdict: np.ndarray
    beside: list[str]

    @property
    def judged(self) -> Trends:
        """Trends for what is decided over the whole fleet, in which the smoother's rows, which are decided, are no
        comparisons more."""
        return replace(self.trends, drift_p=np.where(self.covered, np.nan, self.trends.drift_p))

    @property
    def moving(self) -> np.ndarray:
        """Rows (g,) that step or drift by the smoother."""
        return np.isin(self.verdict, MOVING)

    def statuses(self, alone: np.ndarray) -> np.ndarray:
        """Of `alone`, as regression and siblings have it: with the smoother's verdicts."""
        waits = (self.verdict == DriftStatus.INSUFFICIENT.value) & np.isin(alone, MOVING)
        return np.where(self.moving | waits, self.verdict, alone)

    def with_words(self, reasons: list[str | None]) -> list[str | None]:
        """Sentences with what the smoother adds."""
        both = zip(reasons, self.beside, strict=True)
        return [" ".join(filter(None, (reason, beside))) or None for reason, beside in both]


def read(
    readings: Mapping[tuple[str, ...], float],
    rows: pl.DataFrame,
    trends: Trends,
    borrowed: Array,
    pooled: pl.DataFrame,
) -> Read:
    """Rows and trends of `drift_table.trends_of` with what the table `pooled` knows better.

    `readings`: of the flights that they are of. A scale or zero that no flight tells alone has a row too."""
    known: dict[tuple[str, ...], dict[str, PooledRow]] = {}
    for own in typed(pooled.drop(BY_FLIGHT, strict=False).iter_rows(named=True), PooledRow):
        known.setdefault((own["unit_id"], own["sensor"], own["axis"]), {})[own["parameter"]] = own
    rows, trends, borrowed = _with_unseen(rows, trends, borrowed, known)
    columns = {name: getattr(trends, name).copy() for name in COLUMNS}
    covered, beside = np.zeros(rows.height, dtype=bool), [""] * rows.height
    verdict, borrowed = np.full(rows.height, "", dtype=object), borrowed.copy()
    as_of, curves = rows["as_of"].to_list(), rows.select(CURVE).to_numpy().copy()
    for k, row in enumerate(rows.iter_rows(named=True)):
        if row["method"] not in JOINT_METHODS or (told := _told(row, known, readings)) is None:
            continue
        judge, numbers, curve, complete = told
        if judge["status"] == DriftStatus.INSUFFICIENT:
            verdict[k], beside[k] = judge["status"], str(judge["reason"])
        elif judge["left_out"]:
            beside[k] = f"Left out, for it contradicts the others: {', '.join(judge['left_out'])}."
        if judge["status"] not in KNOWN:
            continue
        covered[k] = True
        verdict[k] = judge["status"] if judge["status"] in MOVING else DriftStatus.STABLE.value
        if judge["status"] == DriftStatus.STEP and judge["change_size"] is None:
            verdict[k] = DriftStatus.STABLE.value  # the sensor was exchanged, which is told of all its rows
        complete = complete and bool(np.isfinite(curve[0]) or np.isnan(curves[k, 0]))
        for name, value in numbers.items():
            if name in OF_CHANGE or complete:
                columns[name][k] = value
        if complete:
            curves[k] = curve
        borrowed[k], as_of[k] = np.nan, judge["started_at"]
    rows = rows.with_columns(
        as_of=pl.Series(as_of, dtype=rows.schema["as_of"]),
        **{name: pl.Series(curves[:, i], nan_to_null=True) for i, name in enumerate(CURVE)},
    )
    return Read(rows, replace(trends, **columns), borrowed, covered, verdict, beside)


def _with_unseen(
    rows: pl.DataFrame, trends: Trends, borrowed: Array, known: Pools
) -> tuple[pl.DataFrame, Trends, Array]:
    """With a row for each scale and zero that all flights tell together and none alone."""
    joint = rows.filter(pl.col("method").is_in(JOINT_METHODS))
    seen = set(joint.select(*AXIS, "parameter").iter_rows())
    unseen = [
        row
        for axis, own in sorted(known.items())
        for parameter, row in sorted(own.items())
        if (*axis, parameter) not in seen and row["status"] in KNOWN and parameter in BOTH
    ]
    if not unseen:
        return rows, trends, borrowed
    more = pl.DataFrame([{**row, "method": Method.JOINT.value} for row in unseen], schema=rows.schema)
    columns = {}
    for name in COLUMNS:
        old = getattr(trends, name)
        columns[name] = np.r_[old, np.full(len(unseen), 0 if old.dtype.kind in "iu" else np.nan, dtype=old.dtype)]
    return pl.concat([rows, more]), replace(trends, **columns), np.r_[borrowed, np.full(len(unseen), np.nan)]


def readings(flights: pl.DataFrame) -> dict[tuple[str, ...], float]:
    """By `AXIS`, method and parameter of `OF_BOTH`: the reading at which scale · (reading − zero) is it, by flights'
    joint estimates alone."""
    at = [*AXIS, "method", "vehicle_id", "flight_id"]
    joint = flights.filter(pl.col("method").is_in(JOINT_METHODS), pl.col("parameter").is_in([*BOTH, *OF_BOTH]))
    scale, zero = (joint.filter(parameter=name).select(*at, pl.col("value").alias(name)) for name in BOTH)
    both = joint.filter(pl.col("parameter").is_in(OF_BOTH)).join(scale, on=at).join(zero, on=at)
    reading = (pl.col("value") / pl.col("scale") + pl.col("zero")).median()
    told = both.group_by(*AXIS, "method", "parameter").agg(reading.alias("reading"))
    return {tuple(row[:-1]): float(row[-1]) for row in told.iter_rows()}


def _told(
    row: Mapping[str, object], known: Pools, readings: Mapping[tuple[str, ...], float]
) -> tuple[PooledRow, Columns, Array, bool] | None:
    """(row of `pooled` that judges a row of `drift`, columns of `Trends` by it, `CURVE` (4,), whether its numbers
    are complete); None where there is none. What follows from scale and zero steps and drifts as the zero does."""
    axis, parameter = tuple(str(row[name]) for name in AXIS), str(row["parameter"])
    own = known.get(axis, {})
    judge = own.get("zero" if parameter in OF_BOTH else parameter)
    if judge is None:
        return None
    if parameter not in OF_BOTH:
        return (judge, _columns(judge), _curve(judge, 1.0), True) if judge["unit"] == row["unit"] else None
    reading = readings.get((*axis, str(row["method"]), parameter))
    if reading is None or (scale := own.get("scale")) is None:
        return None
    complete = scale["status"] in KNOWN and judge["status"] in KNOWN
    if not complete:
        return judge, _columns(judge), _curve(judge, np.nan), False
    return judge, _at_reading(scale, judge, reading), _curve(judge, -_number(scale["value_at_25degc"])), True


def _curve(row: PooledRow, factor: float) -> Array:
    """`CURVE` (4,) of what is so many times a zero, NaN where there is none."""
    square, sd = _number(row["curve_per_degc2"]), _number(row["curve_per_degc2_sd"])
    return np.array([factor * square, abs(factor) * sd, np.nan, np.nan])


def _columns(row: PooledRow) -> Columns:
    slope, slope_sd = _number(row["slope_per_day"]), _number(row["slope_per_day_sd"])
    chance = 2.0 * special.stdtr(row["n_innovations"], -abs(slope / slope_sd)) if slope_sd > 0.0 else np.nan
    return {
        "n_flights": row["n_flights"],
        "n_sessions": row["n_sessions"],
        "value": _number(row["value_at_25degc"]),
        "sd": _number(row["sd"]),
        "slope_per_degc": _number(row["slope_per_degc"]),
        "slope_per_degc_sd": _number(row["slope_per_degc_sd"]),
        "slope_per_day": slope,
        "slope_per_day_sd": slope_sd,
        "best_degc": _number(row["best_known_degc"]),
        "best_day": np.nan,
        "session_sd": _number(row["session_sd"]),
        "flight_sd": 0.0,
        "last_z": _number(row["last_z"]),
        "change_day": np.nan if row["change_at"] is None or row["change_size"] is None else _day(row["change_at"]),
        "change_size": _number(row["change_size"]),
        "change_size_sd": _number(row["change_size_sd"]),
        "drift_p": float(chance),
    }


def _at_reading(scale: PooledRow, zero: PooledRow, reading: float) -> Columns:
    """Columns of scale · (reading − zero); slopes of the two as independent."""
    of_scale, of_zero = _columns(scale), _columns(zero)
    by_scale, by_zero = reading - of_zero["value"], -of_scale["value"]
    out = dict(of_zero)
    out["value"] = of_scale["value"] * by_scale
    for name in ("slope_per_degc", "slope_per_day"):
        out[name] = by_scale * of_scale[name] + by_zero * of_zero[name]
    for name in ("sd", "slope_per_degc_sd", "slope_per_day_sd", "session_sd"):
        out[name] = float(np.hypot(by_scale * of_scale[name], by_zero * of_zero[name]))
    variance = out["sd"] ** 2 + 2.0 * by_scale * by_zero * _covariance(scale, zero)
    out["sd"] = float(np.sqrt(max(variance, 0.0)))
    out["last_z"] *= np.sign(by_zero)
    out["change_size"] *= by_zero
    out["change_size_sd"] *= abs(by_zero)
    return out


def _covariance(scale: PooledRow, zero: PooledRow) -> float:
    if scale["pooled_with"] != zero["pooled_with"]:
        return 0.0
    later, earlier = (zero, scale) if zero["place"] > scale["place"] else (scale, zero)
    return float((later["covariance"] or [])[earlier["place"]]) if later["covariance"] else 0.0


def _day(moment: datetime) -> float:
    return (moment - EPOCH) / DAY


def _number(value: float | None) -> float:
    return np.nan if value is None else float(value)
