"""The history on the terminal: a table a unit, a constant and flight a line, and each series drawn."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from fieldcal.cli.present.constants import constant, counting
from fieldcal.cli.present.screen import Screen, table
from fieldcal.cli.present.sparkline import sparkline
from fieldcal.names import Status
from fieldcal.schemas.rows import CalibrationRow, DriftRow, PooledRow
from fieldcal.words.measures import measure, with_unit, written
from fieldcal.words.numbers import number
from fieldcal.words.rows import standing, typed

if TYPE_CHECKING:
    import polars as pl

DRAWN_FROM, MOST_DRAWN = 3, 12
"""Flights of a series that is drawn, and how many series are."""


def print_history(screen: Screen, frame: pl.DataFrame) -> None:
    """Rows of `calibration`, those that count; how many others there are is said."""
    rows = typed(frame.iter_rows(named=True), CalibrationRow)
    shown = counting(rows)
    units: dict[tuple[str, str], list[CalibrationRow]] = {}
    for row in shown:
        units.setdefault((row["vehicle_id"], row["unit_id"]), []).append(row)
    for (vehicle, unit), own in units.items():
        lines = [_line(row) for row in own]
        whole = any(row["status"] != Status.OK for row in own)
        columns = ["flight (UTC)", "constant", "value", "status"][: 4 if whole else 3]
        screen.print(table(columns, [line[: len(columns)] for line in lines], name_of(vehicle, unit)))
    _draw(screen, shown)
    if hidden := len(rows) - len(shown):
        screen.print(f"Not shown: {hidden} rows of methods that were not chosen (--wide).")


def print_constants(screen: Screen, frame: pl.DataFrame) -> None:
    """Rows of `calibration` that belong to no one flight, each a line."""
    wanted = frame.select("unit_id", "sensor", "axis", "parameter", "value", "sd", "unit", "status", "reason_code")
    for (unit,), own in wanted.group_by("unit_id", maintain_order=True):
        lines = [
            [constant(sensor, axis, parameter), measure(value, sd, of), standing(status, code)]
            for _, sensor, axis, parameter, value, sd, of, status, code in own.iter_rows()
        ]
        screen.print(table(["constant", "value", "status"], lines, str(unit)))


def as_written(frame: pl.DataFrame, value: str = "value") -> pl.DataFrame:
    """The same with a column of values ± sd as people write them."""
    import polars as pl

    told = [measure(own, sd, unit) for own, sd, unit in frame.select(value, "sd", "unit").iter_rows()]
    return frame.with_columns(written=pl.Series(told, dtype=pl.String))


def name_of(vehicle: str, unit: str) -> str:
    """A unit of a vehicle."""
    return vehicle if unit == vehicle else f"{vehicle}, unit {unit}"


def titled(vehicle: str, unit: str, rows: Sequence[DriftRow] | Sequence[PooledRow]) -> str:
    """A unit and the sessions that its rows are made of."""
    counts = sorted({row["n_sessions"] or 0 for row in rows})
    of = str(counts[0]) if counts[0] == counts[-1] else f"{counts[0]} to {counts[-1]}"
    return f"{name_of(vehicle, unit)}: {of} session{'' if of == '1' else 's'}"


def _line(row: CalibrationRow) -> list[str]:
    started = row["started_at"]
    moment = row["session_id"] if started is None else f"{started:%Y-%m-%d %H:%M}"
    value = measure(row["value"], row["sd"], row["unit"])
    name = constant(row["sensor"], row["axis"], row["parameter"])
    return [str(moment), name, value, standing(row["status"], row["reason_code"])]


def _draw(screen: Screen, rows: Sequence[CalibrationRow]) -> None:
    series: dict[tuple[str, ...], list[CalibrationRow]] = {}
    for row in rows:
        if row["status"] == Status.OK:
            place = row["vehicle_id"], row["unit_id"], row["sensor"], row["axis"], row["parameter"], row["unit"]
            series.setdefault(place, []).append(row)
    drawn = {place: own for place, own in series.items() if len(own) >= DRAWN_FROM}
    several = len({place[:2] for place in drawn}) > 1
    lines = []
    for (vehicle, unit, sensor, axis, parameter, of), own in list(drawn.items())[:MOST_DRAWN]:
        factor, name = written(of)
        values = [None if row["value"] is None else row["value"] * factor for row in own]
        known = [value for value in values if value is not None]
        if known:
            span = with_unit(f"{number(min(known), 4)} to {number(max(known), 4)}", name)
            line = [constant(sensor, axis, parameter), sparkline(values), span, str(len(own))]
            lines.append([name_of(vehicle, unit), *line] if several else line)
    if lines:
        columns = ["constant", "flight by flight", "from the least to the greatest", "flights"]
        screen.print(table(["unit", *columns] if several else columns, lines))
    if len(drawn) > MOST_DRAWN:
        screen.print(f"{len(drawn) - MOST_DRAWN} more series: --vehicle, --sensor, --parameter choose.")
