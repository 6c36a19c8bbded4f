"""What trends need of flights: a few numbers each, without the texts that say whose they are.

A row of the history is a flight of a series, 300 bytes with its ids; of it 40 are kept here until the fleet is judged.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
import polars as pl

from fieldcal.estimation.segments import run_starts
from fieldcal.schemas import table_key
from fieldcal.trends import temperatures
from fieldcal.trends.curves import Bends, Source, warm_up_flights
from fieldcal.trends.one_sensor import Exchanges, of_present_sensor
from fieldcal.trends.pooled.verdicts import readings
from fieldcal.trends.series import Histories

KEY = list(table_key("drift"))
DAY_US = 86_400_000_000
BY_FLIGHT = ("session", "time_day", "temperature_degc", "value", "sd")


@dataclass(frozen=True)
class Reduced:
    """Flights of whole units. `rows`: one a series, with what is the same throughout it, in the order of the key;
    `histories`: its flights. By unit and axis `warm`, what warm-up flights say together; `readings` as
    `verdicts.readings`; by unit `doubts` about its temperatures; by unit and sensor what was `exchanged`."""

    rows: pl.DataFrame
    histories: Histories
    warm: Mapping[tuple[str, str], Source]
    readings: Mapping[tuple[str, ...], float]
    doubts: dict[str, str]
    exchanged: Exchanges


def reduced(flights: pl.DataFrame, bends: Bends) -> Reduced:
    """Rows as those of `fleet.rows.history_in_groups`, without those of sensors that fly no more."""
    flights, doubts = temperatures.judged(flights)
    flights, exchanged = of_present_sensor(flights)
    numbered = flights.with_columns(row=pl.struct(KEY).rle_id())
    histories = Histories(
        row=numbered["row"].to_numpy().astype(np.int32),
        session=flights.select(pl.struct("vehicle_id", "session_id").rank("dense"))
        .to_series()
        .to_numpy()
        .astype(np.int32),
        time_day=flights["started_at"].dt.timestamp("us").cast(pl.Float64).to_numpy() / DAY_US,
        temperature_degc=flights["temperature_degc"].to_numpy(),
        value=flights["value"].to_numpy(),
        sd=flights["sd"].to_numpy(),
    )
    rows = numbered.group_by("row", maintain_order=True).agg(
        *(pl.col(name).last() for name in (*KEY, "vehicle_id", "imu_id", "unit")),
        temperature_min_degc=pl.col("temperature_degc").min(),
        temperature_max_degc=pl.col("temperature_degc").max(),
    )
    warm = warm_up_flights(flights, bends)
    return Reduced(rows.drop("row"), histories, warm, readings(flights), doubts, exchanged)


def together(several: Iterable[Reduced]) -> Reduced | None:
    """All units of several, in the order of their ids; None of nothing. Each has units of its own: of one that somebody
    published meanwhile, and that two have, the later counts until all is read again.

    Of `several` no other reference may be held: what is joined is let go of, column by column."""
    rows: list[pl.DataFrame] = []
    sizes: list[np.ndarray] = []
    held: list[dict[str, np.ndarray]] = []
    warm: dict[tuple[str, str], Source] = {}
    found: dict[tuple[str, ...], float] = {}
    doubts: dict[str, str] = {}
    exchanged: Exchanges = {}
    for one in several:
        rows.append(one.rows)
        sizes.append(np.bincount(one.histories.row))
        held.append({name: getattr(one.histories, name) for name in BY_FLIGHT})
        warm.update(one.warm)
        found.update(one.readings)
        doubts.update(one.doubts)
        exchanged.update(one.exchanged)
        del one
    if not rows:
        return None
    places = {unit: (k, first, end) for k, own in enumerate(rows) for unit, first, end in _units(own)}
    units = [places[unit] for unit in sorted(places)]
    starts = [np.append(0, np.cumsum(own)) for own in sizes]
    columns: dict[str, np.ndarray] = {}
    for name in BY_FLIGHT:
        parts = [own.pop(name) for own in held]
        columns[name] = np.concatenate([parts[k][starts[k][first] : starts[k][end]] for k, first, end in units])
        del parts
    size = np.concatenate([sizes[k][first:end] for k, first, end in units])
    row = np.repeat(np.arange(len(size), dtype=np.int32), size)
    ordered = pl.concat([rows[k][first:end] for k, first, end in units])
    return Reduced(ordered, Histories(row, **columns), warm, found, doubts, exchanged)


def _units(rows: pl.DataFrame) -> Iterator[tuple[str, int, int]]:
    """(unit, its first series, the one after its last)."""
    first = run_starts(rows["unit_id"].rle_id().to_numpy())
    yield from zip(rows["unit_id"].gather(first), first.tolist(), [*first[1:].tolist(), rows.height], strict=True)
