"""The table `pooled`: what all flights of a unit say of it together, published where it changed."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from functools import lru_cache, partial
from pathlib import Path

import numpy as np
import polars as pl

from fieldcal.estimation.pooled.changes import pool
from fieldcal.estimation.pooled.movement import strengths
from fieldcal.estimation.pooled.unit import Kinds, Pooled, Unit
from fieldcal.flight.threads import one_thread
from fieldcal.geometry.rotation import Array
from fieldcal.names import Status
from fieldcal.provenance.run_key import run_key, source_digest
from fieldcal.schemas import TABLES, table_key
from fieldcal.schemas.frames import empty_frame
from fieldcal.trends.fleet.groups import groups
from fieldcal.trends.fleet.publishing import publish_where_other
from fieldcal.trends.one_sensor import Exchanges, told
from fieldcal.trends.pooled.memory import Memory
from fieldcal.trends.pooled.present import information_that_counts
from fieldcal.trends.pooled.rows import rows_of_unit, strengths_told
from fieldcal.trends.pooled.units import DAY, EPOCH, HistoryUnit, by_unit, first_that_tell, unit_of, units_that_tell
from fieldcal.warehouse import Warehouse
from fieldcal.warehouse.decisions.withdrawn import counting

KEY = list(table_key("pooled"))
MOST_UNITS = 40
"""Whose flights tell how much constants move: more hardly tell it better."""
AT_ONCE = 100_000
"""Rows of `information` at hand, about (`fleet.groups`)."""
FLOWN = ("unit_id", "vehicle_id", "session_id", "flight_id", "started_at")
FAR = 0.1
"""Relative distance of the gain at which a flight was linearised from the pooled one up to which its equations hold: a
flight beyond it is left out and told, until its log is calibrated again."""
INFORMED = 1e-6
"""Share of the pooled information on a gain from which on a flight's own reference matters."""


def update_pooled(root: Path) -> tuple[str, ...]:
    """Publish what is pooled under the vehicle that each unit flew on last; the vehicles whose table changed.

    A function of the history alone; no log is read, and units of which nothing changed are not pooled again (`memory`).
    Raises as `fieldcal.warehouse.publish.publish`."""
    memory = Memory(root, run_key("pooled", source_digest(kinds_of, rows_of), {}, {}))
    table = pooled_table(root, memory)
    memory.save()
    return tuple(sorted(publish_where_other(root, "pooled", table)))


def pooled_table(root: Path, memory: Memory | None = None) -> pl.DataFrame:
    """The table `pooled` as the history has it now; nothing is written."""
    exchanged: Exchanges = {}

    @lru_cache(maxsize=1)  # a fleet of one group is read once
    def units_of(vehicles: tuple[str, ...]) -> list[pl.DataFrame]:
        information, found = information_that_counts(root, vehicles)
        exchanged.update(found)
        return by_unit(information)

    flown = Warehouse(root).scan("information").filter(counting(root)).select(FLOWN).unique().collect()
    telling = units_that_tell(flown, MOST_UNITS)
    where = set(flown.filter(pl.col("unit_id").is_in(telling))["vehicle_id"])
    several = [tuple(group) for group in groups(root, ("information",), AT_ONCE)]
    asked = (unit for group in several if where & set(group) for unit in units_of(group))
    known = {_id(unit): unit for unit in asked if _id(unit) in telling}
    units = (unit for group in several for unit in units_of(group))
    return told(_table([known[unit_id] for unit_id in telling], units, memory), exchanged, (Status.OK,))


def table_of(information: pl.DataFrame, memory: Memory | None = None) -> pl.DataFrame:
    """The table `pooled` of the fleet whose rows of `information` these are."""
    units = {_id(unit): unit for unit in by_unit(information)}
    telling = units_that_tell(information, MOST_UNITS)
    return _table([units[unit_id] for unit_id in telling], units.values(), memory)


def _table(telling: Sequence[pl.DataFrame], units: Iterable[pl.DataFrame], memory: Memory | None) -> pl.DataFrame:
    if not telling:
        return empty_frame("pooled")
    memory, first = memory or Memory(), [first_that_tell(unit) for unit in telling]
    with one_thread():
        kinds = memory.kinds(first, lambda: kinds_of(first))
        rows = {_id(unit): memory.rows(unit, kinds, partial(rows_of, unit, kinds)) for unit in units}
    # A magnetometer that flew with two IMUs is what its last flight's says.
    return (
        pl.concat([rows[unit_id] for unit_id in sorted(rows)])
        .sort("started_at", "flight_id", nulls_last=False)
        .unique(KEY, keep="last")
        .sort(KEY)
        .select(TABLES["pooled"].column_names)
    )


def _id(unit: pl.DataFrame) -> str:
    return str(unit["unit_id"][0])


def table_then(root: Path, table: pl.DataFrame, moment: datetime) -> pl.DataFrame:
    """What rows of the table `pooled` were at another moment, by all flights before and after it; nothing is written.

    Rows of units that no flight of which has a date are left out: nobody knows what they were when."""
    day = ((moment if moment.tzinfo else moment.replace(tzinfo=UTC)) - EPOCH) / DAY
    information, exchanged = information_that_counts(root)
    out = [empty_frame("pooled")]
    for (unit_id,), own in table.group_by("pooled_with", maintain_order=True):
        one = unit_of(by_unit(information.filter(pl.col("unit_id") == unit_id))[0])
        if one.last["started_at"] is None:
            continue
        kinds = strengths_told(own, one)
        with one_thread():
            rows = pl.DataFrame(rows_of_unit(one, *near(one, kinds), kinds, day), schema=out[0].schema)
        out.append(rows.join(own.select(KEY), on=KEY, how="semi"))
    return told(pl.concat(out), exchanged, (Status.OK,)).sort(KEY)


def kinds_of(units: Sequence[pl.DataFrame]) -> Kinds:
    """How much each kind of constant moves, by the units of these rows of `information`."""
    return strengths([unit_of(rows).unit for rows in units])


def rows_of(unit: pl.DataFrame, kinds: Kinds) -> pl.DataFrame:
    """Rows of the table `pooled`, of the unit of these rows of `information`."""
    one = unit_of(unit)
    return pl.DataFrame(rows_of_unit(one, *near(one, kinds), kinds), schema=empty_frame("pooled").schema)


def near(one: HistoryUnit, kinds: Kinds) -> tuple[Pooled, Array]:
    """(the unit pooled without flights whose equations were made too far from what it is, how far each flight's (n,)
    were: the largest distance of a gain over that up to which they hold, 0 where they tell no gain)."""
    found = pool(one.unit, kinds)
    far = distances(one, found)
    if not (far > 1.0).any() or (far > 1.0).all():
        return found, far
    silent = [
        replace(flight, equations=flight.equations.of(())) if far[k] > 1.0 else flight
        for k, flight in enumerate(one.unit.flights)
    ]
    return pool(Unit(tuple(silent), one.unit.day), kinds), far


def distances(one: HistoryUnit, found: Pooled) -> Array:
    """Of each flight (n,): the largest relative distance of a gain that it tells from the pooled one, over `FAR`."""
    known = found.chain.at(float(one.unit.day[-1]))
    now, information = known.estimate().state, np.diagonal(known.information)
    out = np.zeros(len(one.unit.flights))
    for k, flight in enumerate(one.unit.flights):
        own = flight.equations
        for i, name in enumerate(own.names):
            if name[1] != "gain":
                continue
            place = found.names.index(name)
            if np.isfinite(now[place]) and own.information[i, i] > INFORMED * information[place]:
                out[k] = max(out[k], abs(own.reference[i] - now[place]) / (FAR * abs(now[place])))
    return out
