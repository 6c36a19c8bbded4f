"""The table `drift`: read the history of all vehicles, regress, compare siblings, publish what changed."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import cast

import numpy as np
import polars as pl

from fieldcal.estimation.segments import run_starts
from fieldcal.names import GRAVEST_FIRST
from fieldcal.provenance.run_key import run_key, source_digest
from fieldcal.schemas import FLIGHT_TABLES, TABLES
from fieldcal.schemas.frames import empty_frame
from fieldcal.schemas.reference import ENOUGH_SESSIONS
from fieldcal.schemas.rows import DriftRow
from fieldcal.trends import few_sessions, regression, siblings, temperatures
from fieldcal.trends.curves import Bends, Bent, bends_of, bent
from fieldcal.trends.evidence import evidence
from fieldcal.trends.evidence_cache import Memory
from fieldcal.trends.fleet.publishing import publish_where_other
from fieldcal.trends.fleet.reduced import DAY_US, KEY, Reduced, reduced, together
from fieldcal.trends.fleet.rows import history_in_groups
from fieldcal.trends.more_sessions import needed
from fieldcal.trends.one_sensor import told
from fieldcal.trends.pooled import verdicts
from fieldcal.trends.pooled.table import pooled_table, update_pooled
from fieldcal.trends.reasons import VPS, reason
from fieldcal.trends.series import Histories
from fieldcal.trends.warm_up_slopes import slopes_of_warm_ups
from fieldcal.warehouse import Warehouse
from fieldcal.warehouse.layout import history_files
from fieldcal.warehouse.questions import existing, those_asked_for

ALIKE = ("sensor", "method", "parameter", "unit")
SIBLINGS = (*ALIKE, "axis")
SIGNED = ("scale", "bias", "zero_bias")
"""Parameters whose sign follows the polarity of the axis: siblings may be mounted the other way round."""
NO_BENDS: Bends = {}
ATTEMPTS = 10


def update_drift(root: Path) -> tuple[str, ...]:
    """Publish the trends of every unit under the vehicle that carries it now, tables `pooled` and `drift`; the vehicles
    whose tables changed.

    A function of the history alone: the same history gives the same bytes, and then nothing is written. Units whose
    history did not change are not regressed again (`evidence_cache`); the fleet is judged anew from all. When another
    process publishes flights meanwhile, it is done again, so that whoever ends last leaves the trends of all.

    Raises
    ------
    WarehouseError
        As `fieldcal.warehouse.publish.publish`.
    """
    changed: set[str] = set()
    for _ in range(ATTEMPTS):
        before = _state(root)
        changed |= set(update_pooled(root))
        changed |= publish_drift(root)
        if _state(root) == before:
            break
    return tuple(sorted(changed))


def publish_drift(root: Path) -> set[str]:
    """The same of the table `drift` alone, with the table `pooled` as it lies there."""
    memory = Memory(root, run_key("evidence", source_digest(evidence), {}, {}))
    pooled = Warehouse(root).scan("pooled").drop(verdicts.BY_FLIGHT).collect()
    table = table_of(history_in_groups(root, remember=True), bends_of(root), memory, pooled)
    memory.save()
    return publish_where_other(root, "drift", table)


def drift_table(root: Path, memory: Memory | None = None, pooled: pl.DataFrame | None = None) -> pl.DataFrame:
    """The table `drift` as the history has it now; nothing is written. `pooled`: that table, else it is made."""
    pooled = pooled_table(root) if pooled is None else pooled
    return table_of(history_in_groups(root), bends_of(root), memory, pooled)


def table_of(
    flights: Iterable[pl.DataFrame],
    bends: Bends = NO_BENDS,
    memory: Memory | None = None,
    pooled: pl.DataFrame | None = None,
) -> pl.DataFrame:
    """The table `drift` of `history_in_groups`' rows, of `bends_of`'s curves and of the table `pooled`."""
    pooled = empty_frame("pooled") if pooled is None else pooled
    fleet = together(reduced(own, bends) for own in flights if not own.is_empty())
    if fleet is None:
        return empty_frame("drift")
    known = verdicts.read(fleet.readings, *trends_of(fleet, memory or Memory()), pooled)
    rows, trends = known.rows, known.trends
    group, kind, value, sd = _siblings(rows, trends)
    stepped, drifting = regression.moving(known.judged)
    doubtful = stepped | drifting | known.moving
    fleet_z, fleet_p = siblings.sibling_distance(group, value, sd, doubtful=doubtful, kind=kind)
    result = rows.with_columns(
        **{
            name: pl.Series(np.asarray(column, dtype=float), nan_to_null=True)
            for name, column in {
                "value_at_25degc": trends.value,
                "sd": trends.sd,
                "slope_per_degc": trends.slope_per_degc,
                "slope_per_degc_sd": trends.slope_per_degc_sd,
                "slope_per_day": trends.slope_per_day,
                "slope_per_day_sd": trends.slope_per_day_sd,
                "last_z": trends.last_z,
                "best_known_degc": trends.best_degc,
                "session_sd": trends.session_sd,
                "change_size": trends.change_size,
                "change_size_sd": trends.change_size_sd,
                "fleet_z": fleet_z,
            }.items()
        },
        borrowed_from=pl.Series(known.borrowed, nan_to_null=True).cast(pl.Int64),
        n_flights=pl.Series(trends.n_flights).cast(pl.Int64),
        n_sessions=pl.Series(trends.n_sessions).cast(pl.Int64),
        change_at=_moments(trends.change_day),
        best_known_at=_moments(trends.best_day),
        status=pl.Series(known.statuses(regression.statuses(known.judged, fleet_p)).tolist(), dtype=pl.String),
    )
    more = needed(trends)
    rows_made = cast(Iterator[DriftRow], result.iter_rows(named=True))
    reasons = [reason(row, int(n)) for row, n in zip(rows_made, more, strict=True)]
    explained = told(result.with_columns(reason=pl.Series(known.with_words(reasons), dtype=pl.String)), fleet.exchanged)
    explained = temperatures.with_notes(explained, fleet.doubts)
    return explained.select(TABLES["drift"].column_names).sort(KEY)


def trends_of(fleet: Reduced, memory: Memory) -> tuple[pl.DataFrame, regression.Trends, np.ndarray]:
    """(one row a series with what is the same throughout it, its trends, how many siblings lent to it)."""
    rows, kept = fleet.rows, fleet.histories
    kept = replace(kept, kind=_labels(rows, ALIKE))
    of_unit = rows["unit_id"].rle_id().to_numpy()
    trends = regression.judge(memory.of(kept, of_unit), kept.kind)
    curves = bent(kept, rows, trends, fleet.warm)
    if (slopes := slopes_of_warm_ups(kept, rows, trends)) is not None:
        slope, slope_sd = slopes
        if curves is not None:
            is_bent = np.isfinite(curves.bend).all(axis=1)
            kept = curves.histories
            slope, slope_sd = np.where(is_bent, curves.slope, slope), np.where(is_bent, curves.slope_sd, slope_sd)
        with_slopes = replace(kept, slope_per_degc=slope, slope_per_degc_sd=slope_sd)
        trends = regression.judge(memory.of(with_slopes, of_unit), kept.kind)
        trends = trends if curves is None else curves.widened(trends)
    rows = _with_curves(rows, curves)
    rows = rows.with_columns(as_of=_moments(_last(kept, trends.kept)))
    stepped, drifting = regression.moving(trends)
    steady = (trends.n_sessions >= ENOUGH_SESSIONS) & ~stepped & ~drifting
    return rows, *few_sessions.borrow(kept, trends, _labels(rows, SIBLINGS), _sign(rows, trends), steady)


def _last(h: Histories, kept: np.ndarray) -> np.ndarray:
    """Day (g,) of the last flight that counts: one set aside is not what the line is as of. NaN where none does."""
    return np.asarray(np.fmax.reduceat(np.where(kept, h.time_day, np.nan), run_starts(h.row)))


def _with_curves(rows: pl.DataFrame, curves: Bent | None) -> pl.DataFrame:
    nothing = np.full((len(rows), 2), np.nan)
    bend, sd = (nothing, nothing) if curves is None else (curves.bend, curves.bend_sd)
    columns = {f"curve_per_degc{i + 2}{s}": a[:, i] for i in (0, 1) for s, a in (("", bend), ("_sd", sd))}
    return rows.with_columns(**{name: pl.Series(column, nan_to_null=True) for name, column in columns.items()})


def _sign(rows: pl.DataFrame, trends: regression.Trends) -> np.ndarray:
    """−1 (g,) where a row's sign follows its scale's and that is negative, else 1."""
    axis = ["unit_id", "sensor", "method", "axis"]
    table = rows.select(*axis, "parameter", value=pl.Series(trends.value))
    scale = table.filter(pl.col("parameter") == "scale").select(*axis, sign=pl.col("value").sign())
    sign = table.join(scale, on=axis, how="left", maintain_order="left")["sign"].fill_null(1.0).to_numpy()
    return np.where(rows["parameter"].is_in(SIGNED).to_numpy(), sign, 1.0)


def _siblings(rows: pl.DataFrame, trends: regression.Trends) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """(group (g,), kind, value, sd) that siblings are compared by. Each too short history is a group by itself; groups
    that differ in the axis alone are of a kind.

    A VPS clock's lag is arbitrary, its scatter from session to session is not: there the logarithm of the scatter."""
    value, sd = _sign(rows, trends) * trends.value, trends.sd
    clock = (rows["sensor"] == VPS).to_numpy()
    with np.errstate(divide="ignore", invalid="ignore"):
        scatter = np.log(trends.session_sd + trends.flight_sd + trends.sd)
        scatter_sd = 1.0 / np.sqrt(2.0 * np.maximum(trends.n_sessions - 1, 1))
    value, sd = np.where(clock, scatter, value), np.where(clock, scatter_sd, sd)
    group, kind = (_labels(rows, columns).astype(np.int64) for columns in (SIBLINGS, ALIKE))
    alone = (trends.n_sessions < ENOUGH_SESSIONS) | ~np.isfinite(value) | ~np.isfinite(sd)
    for label in (group, kind):
        label[alone] = label.max() + 1 + np.arange(alone.sum())
    return group, kind, np.where(alone, 0.0, value), np.where(alone, 1.0, sd)


def _labels(rows: pl.DataFrame, columns: tuple[str, ...]) -> np.ndarray:
    """A number (g,) for each row, the same where `columns` are."""
    return rows.select(pl.struct(*columns).rank("dense")).to_series().to_numpy()


def _moments(day: np.ndarray) -> pl.Series:
    """Days since 1970 as moments, to the microsecond; NaN becomes null."""
    exact = [None if np.isnan(d) else round(float(d) * DAY_US) for d in day]
    return pl.Series(exact, dtype=pl.Int64).cast(pl.Datetime("us", "UTC"))


def _state(root: Path) -> list[tuple[str, int, int, int]]:
    """What the files of the history are; they are replaced whole, so another content is another file."""
    files = [path for table in (*FLIGHT_TABLES, "decision") for path in history_files(root, table)]
    return [(str(path), (s := path.stat()).st_ino, s.st_size, s.st_mtime_ns) for path in files]


def drift_rows(root: Path, vehicle: str | None, sensor: str | None, parameter: str | None) -> pl.DataFrame:
    """Rows of the table as it was published, what is not stable first.

    Raises
    ------
    FieldcalError
        `not_found`: the history has no such vehicle, the table no such sensor or parameter.
    """
    rows = those_asked_for(existing(root), "drift", vehicle, sensor, parameter)
    rank = pl.col("status").replace_strict(
        {str(status): place for place, status in enumerate(GRAVEST_FIRST)}, default=5, return_dtype=pl.Int8
    )
    return rows.sort([rank, *KEY]).collect()
