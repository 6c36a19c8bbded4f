"""From the table `information` to units whose flights can be pooled: in coordinates that siblings share, in order of
time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

import numpy as np
import polars as pl

from fieldcal.estimation.normal_equations import Name, NormalEquations
from fieldcal.estimation.pooled.unit import Flight, Unit
from fieldcal.geometry.rotation import Array
from fieldcal.names import Status
from fieldcal.schemas.columns import FLOWN_ORDER
from fieldcal.schemas.reference import PLAUSIBLE_DEGC, REFERENCE_DEGC
from fieldcal.schemas.rows import InformationRow
from fieldcal.words.rows import typed

EPOCH, DAY = datetime(1970, 1, 1, tzinfo=UTC), timedelta(days=1)
FEWEST_FLIGHTS, MANY_SESSIONS = 2, 32
LEAST_OFTEN = 0.5
"""Share of its flights that a parameter beside gain and zero has to be in: what only some have is eliminated."""
BY_GAIN = ("gain", "zero", "zero_per_degc", "g_sensitivity")
"""Parameters in logged units: over the axis' usual gain they are what siblings of any unit share."""
USUAL = ("gain", "zero", "zero_per_degc")


@dataclass(frozen=True)
class HistoryUnit:
    """A unit of the history: `unit` as it is pooled, `flight_ids` in its order, `last` the lead of its last flight and
    `sensor_unit_ids` of its sensors; `per` of each constant: its value in the history over that in the unit; `units` of
    each constant in the history; `temperatures_degc` flown, (lowest, highest) or None."""

    unit: Unit
    flight_ids: tuple[str, ...]
    pooled_with: str
    last: Mapping[str, object]
    sensor_unit_ids: Mapping[str, str]
    per: Mapping[Name, float]
    units: Mapping[Name, str]
    temperatures_degc: tuple[float, float] | None


def by_unit(rows: pl.DataFrame) -> list[pl.DataFrame]:
    """`information`'s rows of each unit with flights enough, in the order of their ids; flights in the order of time,
    only those whose time is known where there are any."""
    ordered = rows.sort("unit_id", *FLOWN_ORDER, "place", nulls_last=False).filter(_counts_in_time())
    units = ordered.partition_by("unit_id", maintain_order=True)
    return [own for own in units if own["flight_id"].n_unique() >= FEWEST_FLIGHTS]


def units_that_tell(rows: pl.DataFrame, most: int) -> list[str]:
    """Units that flew in most sessions, of those of `by_unit`, at most so many. By powers of two, so that the next
    flight of one does not make others tell. `rows`: of `information`, any one of each flight."""
    flown = (
        rows.filter(_counts_in_time())
        .group_by("unit_id")
        .agg(flights=pl.col("flight_id").n_unique(), sessions=pl.struct("vehicle_id", "session_id").n_unique())
        .filter(pl.col("flights") >= FEWEST_FLIGHTS)
        .sort("unit_id")
    )
    several = flown.select("unit_id", "sessions").rows()
    return [unit for unit, _ in sorted(several, key=lambda one: -one[1].bit_length())[:most]]


def _counts_in_time() -> pl.Expr:
    dated = pl.col("started_at").is_not_null()
    return dated | ~dated.any().over("unit_id")


def sessions_flown(rows: pl.DataFrame) -> int:
    """In how many sessions a unit flew."""
    return rows.select("vehicle_id", "session_id").n_unique()


def first_that_tell(rows: pl.DataFrame) -> pl.DataFrame:
    """Of a frame of `by_unit` the first sessions that say how much constants move: all where there are few, else a
    power of two, so that the next flight leaves what they say as it is."""
    enough = 1 << (sessions_flown(rows).bit_length() - 1)
    if enough < MANY_SESSIONS:
        return rows
    first = rows.select("vehicle_id", "session_id").unique(maintain_order=True).head(enough)
    return rows.join(first, on=["vehicle_id", "session_id"], how="semi", maintain_order="left")


def unit_of(rows: pl.DataFrame) -> HistoryUnit:
    """A unit as it is pooled, of one of the frames of `by_unit`."""
    grouped: dict[str, list[InformationRow]] = {}
    for row in typed(rows.iter_rows(named=True), InformationRow):
        grouped.setdefault(row["flight_id"], []).append(row)
    flights = list(grouped.values())
    # A sensor is that of the last flight: one of another id, or logged in another unit, is eliminated.
    ids = {row["sensor"]: row["sensor_unit_id"] for own in flights for row in own}
    zero_units = {row["sensor"]: row["unit"] for own in flights for row in own if row["parameter"] == "zero"}
    usable = [_usable(own, ids, zero_units) for own in flights]
    often = _often(usable)
    usable = [one.of([name for name in one.names if name in often]) for one in usable]
    gains = _usual_gains(usable)
    sessions, day = _sessions(flights)
    made = []
    for one, own, session in zip(usable, flights, sessions, strict=True):
        factor = np.array([1.0 / gains[name[0], name[2][:1]] if name[1] in BY_GAIN else 1.0 for name in one.names])
        made.append(
            Flight(
                one.as_function(one.names, one.reference * factor, np.diag(factor)) if len(one.names) else one,
                session,
                _warmth(own),
            )
        )
    unit = Unit(tuple(made), day)
    units = {(row["sensor"], row["parameter"], row["axis"]): row["unit"] for own in flights for row in own}
    warm = [f.warmth_degc + REFERENCE_DEGC for f in made if f.warmth_degc is not None]
    return HistoryUnit(
        unit=unit,
        flight_ids=tuple(grouped),
        pooled_with=flights[-1][0]["unit_id"],
        last=flights[-1][0],
        sensor_unit_ids=ids,
        per={name: gains[name[0], name[2][:1]] if name[1] in BY_GAIN else 1.0 for name in unit.names},
        units=units,
        temperatures_degc=(min(warm), max(warm)) if warm else None,
    )


def _usable(rows: list[InformationRow], ids: Mapping[str, str], zero_units: Mapping[str, str]) -> NormalEquations:
    """A flight's equations of what counts: neither refused nor withdrawn, of the sensors that there are now."""
    names = [(row["sensor"], row["parameter"], row["axis"]) for row in rows]
    reference, right = (np.array([row[column] for row in rows]) for column in ("linearised_at", "right_side"))
    triangle = np.concatenate([row["information"] for row in rows])
    found = NormalEquations.of_triangle(names, reference, right, triangle)
    of_zero = {row["sensor"]: row["unit"] for row in rows if row["parameter"] == "zero"}
    counts = [
        name
        for name, row in zip(names, rows, strict=True)
        if row["status"] == Status.OK
        and row["sensor_unit_id"] == ids[name[0]]
        and of_zero.get(name[0]) == zero_units.get(name[0])
    ]
    return found if len(counts) == len(rows) else found.of(counts)


def _often(flights: list[NormalEquations]) -> set[Name]:
    count: dict[Name, int] = {}
    for one in flights:
        for name in one.names:
            count[name] = count.get(name, 0) + 1
    return {
        name for name, n in count.items() if name[1] in USUAL or n >= max(FEWEST_FLIGHTS, LEAST_OFTEN * len(flights))
    }


def _usual_gains(flights: list[NormalEquations]) -> dict[tuple[str, str], float]:
    """By sensor and axis, > 0."""
    gains: dict[tuple[str, str], list[float]] = {}
    for one in flights:
        for name, value in zip(one.names, one.reference, strict=True):
            if name[1] == "gain":
                gains.setdefault((name[0], name[2]), []).append(abs(float(value)))
    usual = {key: float(np.median(values)) for key, values in gains.items()}
    # A zero may be known where its gain was refused in every flight.
    others = {(name[0], name[2][:1]) for one in flights for name in one.names if name[1] in BY_GAIN} - usual.keys()
    return usual | {key: _gain_beside(key, usual) for key in others}


def _gain_beside(key: tuple[str, str], usual: Mapping[tuple[str, str], float]) -> float:
    of_sensor = [value for (sensor, _), value in usual.items() if sensor == key[0]]
    return float(np.median(of_sensor)) if of_sensor else 1.0


def _sessions(flights: list[list[InformationRow]]) -> tuple[list[int], Array]:
    """(session of each flight, day of each session): numbered in order of time; a day apart where nobody knows when."""
    labels = [(one[0]["vehicle_id"], one[0]["session_id"]) for one in flights]
    times = [None if (at := one[0]["started_at"]) is None else (at - EPOCH) / DAY for one in flights]
    order = {label: k for k, label in enumerate(dict.fromkeys(labels))}
    if times[0] is None:
        return [order[label] for label in labels], np.arange(float(len(order)))
    known = [time for time in times if time is not None]
    mean = {label: np.mean([t for t, own in zip(known, labels, strict=True) if own == label]) for label in order}
    ascending = sorted(order, key=lambda label: (mean[label], order[label]))
    place = {label: k for k, label in enumerate(ascending)}
    return [place[label] for label in labels], np.array([float(mean[label]) for label in ascending])


def _warmth(rows: list[InformationRow]) -> float | None:
    degc = rows[0]["temperature_degc"]
    low, high = PLAUSIBLE_DEGC
    return float(degc) - REFERENCE_DEGC if degc is not None and low <= degc <= high else None
