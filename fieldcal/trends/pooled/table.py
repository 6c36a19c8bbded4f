"""The table `pooled`: what all flights of a unit say of it together, published where it changed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl

from fieldcal.estimation.pooled.unit import Kinds, Pooled, Unit, pool, strengths
from fieldcal.flight.threads import one_thread
from fieldcal.schemas import TABLES, table_key
from fieldcal.trends.pooled.rows import rows_of_unit
from fieldcal.trends.pooled.units import HistoryUnit, units_of_history
from fieldcal.warehouse import Warehouse
from fieldcal.warehouse.decisions.withdrawn import counting
from fieldcal.warehouse.layout import history_files
from fieldcal.warehouse.publish import publish
from fieldcal.warehouse.store import empty_frame, read_table

KEY = list(table_key("pooled"))
MOST_UNITS = 40
"""Whose flights tell how much constants move: more hardly tell it better."""
FAR = 0.1
"""Relative distance of the gain at which a flight was linearised from the pooled one: beyond it the flight's equations
are not those of this unit, and it is left out."""
INFORMED = 1e-6
"""Share of the pooled information on a gain from which on a flight's own reference matters."""


def update_pooled(root: Path) -> tuple[str, ...]:
    """Publish what is pooled under the vehicle that each unit flew on last; the vehicles whose table changed.

    A function of the history alone; no log is read. Raises as `fieldcal.warehouse.publish.publish`."""
    table = pooled_table(root)
    there: set[str] = set()
    for path in history_files(root, "pooled"):
        there |= set(read_table(path, "pooled")["vehicle_id"].to_list())
    return tuple(
        vehicle_id
        for vehicle_id in sorted(set(table["vehicle_id"].to_list()) | there)
        if publish(root, vehicle_id, {"pooled": table.filter(pl.col("vehicle_id") == vehicle_id)}, ())
    )


def pooled_table(root: Path) -> pl.DataFrame:
    """The table `pooled` as the history has it now; nothing is written."""
    return table_of(list(units_of_history(information_that_counts(root))))


def information_that_counts(root: Path) -> pl.DataFrame:
    """Rows of `information` of flights that nobody withdrew."""
    return Warehouse(root).scan("information").filter(counting(root)).collect()


def table_of(units: Sequence[HistoryUnit]) -> pl.DataFrame:
    """The table `pooled` of these units, which are the fleet."""
    if not units:
        return empty_frame("pooled")
    with one_thread():
        kinds = kinds_of([one.unit for one in units])
        rows = [row for one in units for row in rows_of_unit(one, near(one, kinds), kinds)]
    if not rows:
        return empty_frame("pooled")
    table = pl.DataFrame(rows, schema=empty_frame("pooled").schema)
    # A magnetometer that flew with two IMUs is what its last flight's says.
    return (
        table.sort("started_at", "flight_id", nulls_last=False)
        .unique(KEY, keep="last")
        .sort(KEY)
        .select(TABLES["pooled"].column_names)
    )


def kinds_of(units: Sequence[Unit]) -> Kinds:
    """How much each kind of constant moves, by the units with most sessions."""
    return strengths(sorted(units, key=lambda unit: -len(unit.day))[:MOST_UNITS])


def near(one: HistoryUnit, kinds: Kinds) -> Pooled:
    """The unit pooled, without flights that were linearised too far from what it is."""
    found = pool(one.unit, kinds)
    now = found.at().state
    far = set()
    for k, flight in enumerate(one.unit.flights):
        own = flight.equations
        for i, name in enumerate(own.names):
            if name[1] != "gain":
                continue
            gain = now[found.names.index(name)]
            heard = own.information[i, i] > INFORMED * found.chain.at(float(one.unit.day[-1])).information[i, i]
            if np.isfinite(gain) and heard and abs(own.reference[i] - gain) > FAR * abs(gain):
                far.add(k)
    if not far or len(far) == len(one.unit.flights):
        return found
    silent = [
        replace(flight, equations=flight.equations.of(())) if k in far else flight
        for k, flight in enumerate(one.unit.flights)
    ]
    return pool(Unit(tuple(silent), one.unit.day), kinds)
