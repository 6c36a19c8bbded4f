"""A vehicle's page: what to fly with, the trends, every parameter's history, agreement, clock, flights and refusals."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import polars as pl

from fieldcal.errors import FieldcalError
from fieldcal.exports.autopilots.comparison import COLUMNS, compared, lines
from fieldcal.exports.calibration_at import what_flies
from fieldcal.exports.handed_out import handed_out
from fieldcal.names import GRAVEST_FIRST, SENSORS, DriftStatus, Status
from fieldcal.report.history import (
    LatestCalibration,
    RefusedRow,
    as_of_sentence,
    newest,
    reason_of,
    refusals_of,
    usable_flights,
)
from fieldcal.report.links import Links, flight_name
from fieldcal.report.page import Column, Folded, Heading, Notice, Page, Part, Plot, Section, Simple, Table, Text, badge
from fieldcal.report.trend import TREND_VALUES, change_sentence, fly_with_sentence, worst_status
from fieldcal.report.vehicle_figures import MOST_POINTS, agreement_plot, lag_plot, parameter_plot
from fieldcal.report.words import PARAMETERS, age, count, day, plain_name, preferred, scientific
from fieldcal.schemas.columns import FLOWN_ORDER
from fieldcal.schemas.reference import REFERENCE_DEGC
from fieldcal.schemas.rows import DecisionRow, DriftRow, UnfoldedFlight
from fieldcal.stages.beside.warm_up import METHOD as WARM_UP
from fieldcal.stages.beside.warm_up import PARAMETER as WARM_UP_SLOPE
from fieldcal.trends.reasons import status_words
from fieldcal.warehouse import Warehouse
from fieldcal.warehouse.decisions.withdrawn import decisions
from fieldcal.warehouse.questions import existing, known_vehicle, units_flown
from fieldcal.words.flights import decision_sentence
from fieldcal.words.measures import rows_written
from fieldcal.words.numbers import number
from fieldcal.words.rows import typed, unfolded

FLIGHTS, REFUSALS, FEWEST_POINTS = 200, 100, 30
OPEN = ("scale", "zero_bias", WARM_UP_SLOPE)
"""Parameters whose plots are open; the others say the same in other words."""


@dataclass(frozen=True)
class Drawing:
    """How a vehicle's figures are drawn; `most`: flights in a table of them."""

    parameter: Callable[[pl.DataFrame, Mapping[str, DriftRow], str, str, str, int], Plot] = parameter_plot
    agreement: Callable[[pl.DataFrame, str], Plot | None] = agreement_plot
    lag: Callable[[pl.DataFrame, str], Plot | None] = lag_plot
    most: int = FLIGHTS


ON_PAPER = Drawing()


def vehicle_page(
    root: Path,
    vehicle_id: str,
    links: Links,
    as_of: datetime | None,
    warehouse: Warehouse | None = None,
    drawing: Drawing = ON_PAPER,
) -> Page:
    """The page, from the history below `root`, or from what of it is at hand."""
    warehouse = warehouse or existing(root)
    flights = warehouse.scan("flight", vehicle_id=vehicle_id).sort(FLOWN_ORDER, nulls_last=False).collect()
    if flights.is_empty():
        known_vehicle(warehouse, vehicle_id)
    moment = as_of or newest(warehouse)
    imus = list(dict.fromkeys(reversed(flights["imu_id"].to_list())))
    flown = units_flown(warehouse, vehicle_id)
    units = _units(warehouse, vehicle_id, flown)
    drift = rows_written(warehouse.scan("drift").filter(pl.col("unit_id").is_in(units)).collect(), TREND_VALUES)
    current = drift.filter(pl.col("unit_id").is_in(flown["unit_id"].to_list()))
    usable = usable_flights(warehouse, vehicle_id)
    status = worst_status(current)
    last = usable["started_at"][-1] if usable.height else None
    facts = [
        ("status", badge(status or "not analysed")),
        ("latest verdict", badge(flights["verdict"][-1])),
        ("last usable flight", "none" if usable.is_empty() else day(last)),
        ("age", "–" if usable.is_empty() else age(last, moment)),
        ("flights", f"{flights.height}, {usable.height} usable"),
        ("IMU", imus[0] if len(imus) == 1 else f"{imus[0]}; before: {', '.join(imus[1:])}"),
    ]
    sections = [
        Section("fly", "What to fly with", [*_fly_with(warehouse, flown), *_before_and_after(warehouse, vehicle_id)]),
        Section("trend", "Trends", _trends(current, usable.height)),
        *_parameters(warehouse, vehicle_id, units, drift, drawing),
        Section("agreement", "Agreement", _agreement(warehouse, vehicle_id, drawing)),
        Section("clock", "VPS clock", _clock(warehouse, vehicle_id, drawing)),
        Section("flights", "Flights", [_flights(flights, usable, links, drawing.most)]),
        *_decisions(flights, root, links),
        Section("refusals", "Refusals", _refusals(warehouse, vehicle_id, flown, links)),
    ]
    return Page(
        f"Vehicle {vehicle_id}",
        [as_of_sentence(moment, as_of is not None)],
        facts,
        sections,
        "Written by fieldcal from its history tables; equal tables give an equal page.",
        links.up(),
    )


def _units(warehouse: Warehouse, vehicle_id: str, flown: pl.DataFrame) -> list[str]:
    """Units that the vehicle has carried: those it flew with last, then the others, the latest first."""
    rows = warehouse.scan("calibration", vehicle_id=vehicle_id).select("unit_id", *FLOWN_ORDER)
    others = rows.sort(*FLOWN_ORDER, "unit_id", nulls_last=False).collect()["unit_id"].reverse()
    primary = flown.sort("sensor", descending=True)["unit_id"].to_list()
    return list(dict.fromkeys([*primary, *others.to_list()]))


def _fly_with(warehouse: Warehouse, flown: pl.DataFrame) -> list[Part]:
    rows = warehouse.sql("SELECT * FROM latest_calibration").join(flown, on=["unit_id", "sensor"], how="semi")
    rows = rows_written(rows, ("value_at_25degc", "sd"))
    if rows.is_empty():
        return [Notice("No flight gave a constant: there is nothing to fly with.")]
    caption = f"Latest constants at {REFERENCE_DEGC:g} °C, ± one standard deviation (view latest_calibration)"
    alone = pl.col("axis").str.len_chars() == 1
    own, terms = rows.filter(alone), rows.filter(~alone)
    parts: list[Part] = [
        Text("z = scale · logged + bias, sensor axes. A constant of one flight holds at its temperature."),
        _constants_table(caption, own),
    ]
    if terms.height:
        parts.append(
            Folded("Whole matrices, and what has no axis", [_constants_table(f"{caption}, by row and column", terms)])
        )
    return parts


def _constants_table(caption: str, rows: pl.DataFrame) -> Table:
    axes = sorted(rows["axis"].unique().to_list())
    by_place: dict[tuple[str, str], dict[str, LatestCalibration]] = {}
    for r in typed(rows.iter_rows(named=True), LatestCalibration):
        by_place.setdefault((r["sensor"], r["parameter"]), {})[r["axis"]] = r
    lines = []
    for sensor, parameter in sorted(by_place, key=lambda p: (_place(SENSORS, p[0]), _place(PARAMETERS, p[1]), p)):
        own = by_place[sensor, parameter]
        values = [scientific(own[a]["value_at_25degc"], own[a]["sd"]) if a in own else "–" for a in axes]
        any_axis = next(iter(own.values()))
        methods = sorted({plain_name(r["method"]) for r in own.values()})
        lines.append([f"{sensor} {parameter}", *values, any_axis["unit"], ", ".join(methods), _sources(own)])
    columns = [
        Column("parameter"),
        *(Column(axis or "–", "n") for axis in axes),
        Column("unit"),
        Column("method"),
        Column("from", "wide"),
    ]
    return Table(caption, columns, lines)


def _sources(by_axis: Mapping[str, LatestCalibration]) -> str:
    """Where the constants of a parameter come from, axes of one source together."""
    axes: dict[str, list[str]] = {}
    for axis in sorted(by_axis):
        axes.setdefault(fly_with_sentence(by_axis[axis]), []).append(axis)
    if len(axes) == 1:
        return next(iter(axes))
    return " ".join(f"{', '.join(names)}: {source}" for source, names in axes.items())


def _before_and_after(warehouse: Warehouse, vehicle_id: str) -> list[Part]:
    """What its autopilot flies with, where the logs tell."""
    try:
        rows, _ = compared(what_flies(warehouse.root, vehicle_id, warehouse=warehouse))
    except FieldcalError:
        return []
    numeric = ("flies with", "estimate", "difference", "which is")
    return [
        *(Text(one.sentence) for one in handed_out(warehouse.root, vehicle_id)),
        Table(
            "What the autopilot flew with beside what is estimated (fieldcal compare)",
            tuple(Column(name, "n") if name in numeric else Column(name) for name in COLUMNS),
            lines(rows),
        ),
    ]


def _trends(drift: pl.DataFrame, usable: int) -> list[Part]:
    if drift.is_empty():
        return [
            Notice(
                f"Table drift has no row of its units ({count(usable, 'usable flight')}): trends are not analysed yet."
            )
        ]
    parts: list[Part] = []
    rows = typed(drift.iter_rows(named=True), DriftRow)
    if set(drift["status"].to_list()) == {DriftStatus.INSUFFICIENT}:
        told = f"Too few flights for a trend ({count(usable, 'usable flight')}): every status is insufficient."
        why = {str(r["reason"]) for r in rows if r["reason"]}
        parts.append(Notice(" ".join([told, *sorted(why)])))
    ordered = sorted(
        rows,
        key=lambda r: (
            _place(SENSORS, r["sensor"]),
            r["sensor"],
            _place(PARAMETERS, r["parameter"]),
            r["method"],
            r["axis"],
        ),
    )
    moving = [r for r in ordered if r["status"] not in (DriftStatus.STABLE, DriftStatus.INSUFFICIENT)]
    moving.sort(key=lambda r: _place(GRAVEST_FIRST, r["status"]))
    counts = [f"{n} {status}" for status in GRAVEST_FIRST if (n := drift.filter(pl.col("status") == status).height)]
    if moving:
        columns = (
            Column("parameter"),
            Column("axis"),
            Column("status"),
            Column("why", "wide"),
            Column("last flight, σ", "n"),
        )
        lines = [
            [_name(r), r["axis"], badge(r["status"], status_words(r)), change_sentence(r, []), number(r["last_z"], 2)]
            for r in moving
        ]
        parts.append(Table("Parameters that are not steady, worst first", columns, lines))
    elif not parts:
        parts.append(Text("Every parameter with enough flights is steady."))
    every = _trend_table("Regression over temperature and time", ordered)
    return [*parts, Folded(f"All {len(ordered)} regressions: {', '.join(counts)}", [every])]


def _name(row: DriftRow) -> str:
    return f"{plain_name(row['sensor'])} {row['parameter']} ({plain_name(row['method'])})"


def _trend_table(caption: str, rows: Sequence[DriftRow]) -> Table:
    columns = (
        Column("parameter"),
        Column("axis"),
        Column("status"),
        Column("flights", "n"),
        Column(f"at {REFERENCE_DEGC:g} °C", "n"),
        Column("per °C", "n"),
        Column("per day", "n"),
        Column("unit"),
        Column("last flight, σ", "n"),
        Column("step at", "nowrap"),
    )
    lines = [
        [
            _name(r),
            r["axis"],
            badge(r["status"], status_words(r)),
            str(r["n_flights"]),
            scientific(r["value_at_25degc"], r["sd"]),
            scientific(r["slope_per_degc"], r["slope_per_degc_sd"]),
            scientific(r["slope_per_day"], r["slope_per_day_sd"]),
            r["unit"],
            number(r["last_z"], 2),
            "–" if r["change_at"] is None else day(r["change_at"]),
        ]
        for r in rows
    ]
    return Table(caption, columns, lines)


def _parameters(
    warehouse: Warehouse, vehicle_id: str, units: list[str], drift: pl.DataFrame, drawing: Drawing
) -> list[Section]:
    """A section per sensor: the plots of its most exact method, the unit that it flew with last first."""
    rows = (
        warehouse.scan("calibration")
        .filter(pl.col("unit_id").is_in(units) & pl.col("value").is_not_null())
        .sort(FLOWN_ORDER, nulls_last=False)
        .collect()
    )
    rows = rows_written(rows, ("value", "sd"))
    panels = max(3 * len(units), 1, rows.select("unit_id", "axis").unique().height)
    most = max(FEWEST_POINTS, 3 * MOST_POINTS // panels)
    sections: list[Section] = []
    for sensor in sorted(rows["sensor"].unique().to_list(), key=lambda name: _place(SENSORS, name)):
        parts: list[Part] = []
        own_units = rows.filter(pl.col("sensor") == sensor)["unit_id"].unique().to_list()
        for unit_id in (one for one in units if one in own_units):
            here = pl.col("sensor") == sensor, pl.col("unit_id") == unit_id
            if len(own_units) > 1:
                parts.append(Heading(f"Unit {unit_id}"))
            parts += _sensor(rows.filter(*here), drift.filter(*here), vehicle_id, most, drawing)
        sections.append(Section(f"sensor-{len(sections) + 1}", sensor.capitalize(), parts))
    return sections


def _sensor(rows: pl.DataFrame, drift: pl.DataFrame, vehicle_id: str, most: int, drawing: Drawing) -> list[Part]:
    methods = set(rows["method"].to_list())
    shown = dict.fromkeys((preferred(methods), *(methods & {WARM_UP})))
    return [part for method in shown for part in _method(rows, drift, method, vehicle_id, most, drawing)]


def _method(
    rows: pl.DataFrame, drift: pl.DataFrame, method: str, vehicle_id: str, most: int, drawing: Drawing
) -> list[Part]:
    rows = rows.filter(pl.col("method") == method)
    sensor, unit_id = rows["sensor"][0], rows["unit_id"][0]
    there = sorted(rows["parameter"].unique().to_list(), key=lambda name: (_place(PARAMETERS, name), name))
    parts: list[Part] = [Text(f"Method: {plain_name(method)}.")]
    folded: list[Simple] = []
    for parameter in there:
        own = rows.filter(pl.col("parameter") == parameter)
        trend = drift.filter(pl.col("method") == method, pl.col("parameter") == parameter)
        of_axes = typed(trend.iter_rows(named=True), DriftRow)
        by_axis = {r["axis"]: r for r in of_axes if r["status"] != DriftStatus.INSUFFICIENT}
        anchor = f"plot-{_slug(sensor, parameter, unit_id)}"
        plot = drawing.parameter(own, by_axis, vehicle_id, f"{sensor} {parameter}", anchor, most)
        (parts if parameter in OPEN else folded).append(plot)
    if folded:
        parts.append(Folded(f"The same as {' and '.join(p for p in there if p not in OPEN)}", folded))
    return parts


def _slug(*names: str) -> str:
    """An id of the page's own from names that may be anything."""
    import hashlib

    return hashlib.sha256("\0".join(names).encode("utf-8", "surrogatepass")).hexdigest()[:10]


def _agreement(warehouse: Warehouse, vehicle_id: str, drawing: Drawing) -> list[Part]:
    plot = drawing.agreement(
        warehouse.scan("fit", vehicle_id=vehicle_id).filter("is_primary").collect(), "plot-agreement"
    )
    return [Text("No flight has anything to compare with.")] if plot is None else [plot]


def _clock(warehouse: Warehouse, vehicle_id: str, drawing: Drawing) -> list[Part]:
    sync = warehouse.scan("sync", vehicle_id=vehicle_id).filter("is_primary").collect()
    plot = drawing.lag(sync, "plot-clock")
    refused = sync.filter(pl.col("status") != Status.OK).height
    parts: list[Part] = [Text("No flight was synchronised with a VPS.")] if plot is None else [plot]
    return [*parts, Text(f"Synchronisation was refused in {count(refused, 'flight')}.")] if refused else parts


def _flights(flights: pl.DataFrame, usable: pl.DataFrame, links: Links, most: int) -> Table:
    columns = (
        Column("flight"),
        Column("started (UTC)", "nowrap"),
        Column("session"),
        Column("verdict"),
        Column("usable"),
        Column("duration, s", "n"),
        Column("°C", "n"),
        Column("log"),
        Column("why", "wide"),
    )
    good = set(usable["flight_id"].to_list())
    lines = [
        [
            links.to(flight_name(r["flight_id"]), r["flight_id"]),
            day(r["started_at"]),
            str(r["session_id"]),
            badge(r["verdict"]),
            "yes" if r["flight_id"] in good else "no",
            "–" if r["duration_s"] is None else f"{r['duration_s']:.1f}",
            "–" if r["temperature_mean_degc"] is None else f"{r['temperature_mean_degc']:.1f}",
            str(r["log_uri"]),
            r["reason"] or "; ".join(str(f["sentence"]) for f in r["findings"] or [])[:300],
        ]
        for r in typed(map(unfolded, flights.reverse().head(most).iter_rows(named=True)), UnfoldedFlight)
    ]
    more = f"{flights.height - most} earlier flights are not shown: fieldcal history." if flights.height > most else ""
    return Table("Flights, the latest first (fieldcal report --flight ID writes a flight's page)", columns, lines, more)


def _decisions(flights: pl.DataFrame, root: Path, links: Links) -> list[Section]:
    """What people decided about its flights, the last first; nothing where nobody did."""
    decided = decisions(root).filter(pl.col("flight_id").is_in(flights["flight_id"].to_list())).reverse()
    if decided.is_empty():
        return []
    lines = [
        [links.to(flight_name(r["flight_id"]), r["flight_id"]), day(r["decided_at"]), decision_sentence(r)]
        for r in typed(decided.head(REFUSALS).iter_rows(named=True), DecisionRow)
    ]
    columns = (Column("flight"), Column("decided (UTC)", "nowrap"), Column("what and why", "wide"))
    more = f'{decided.height - REFUSALS} more: fieldcal sql "FROM decision".' if decided.height > REFUSALS else ""
    table = Table("What people decided (fieldcal withdraw, fieldcal accept), the last first", columns, lines, more)
    return [Section("decisions", "Decisions", [table])]


def _refusals(warehouse: Warehouse, vehicle_id: str, flown: pl.DataFrame, links: Links) -> list[Part]:
    rows = refusals_of(warehouse, vehicle_id)
    if rows.is_empty():
        return [Text("Nothing was refused.")]
    primary = {None, *flown["unit_id"]}
    columns = (
        Column("flight"),
        Column("started (UTC)", "nowrap"),
        Column("what"),
        Column("status"),
        Column("code"),
        Column("why", "wide"),
    )
    lines = [
        [
            links.to(flight_name(r["flight_id"]), r["flight_id"]),
            day(r["started_at"]),
            f"{r['level']} {r['what']}" + ("" if r["unit_id"] in primary else f" of {r['unit_id']}"),
            badge(r["status"]),
            r["reason_code"] or "",
            reason_of(r),
        ]
        for r in typed(rows.head(REFUSALS).iter_rows(named=True), RefusedRow)
    ]
    more = f'{rows.height - REFUSALS} more: fieldcal sql "SELECT * FROM refusals".' if rows.height > REFUSALS else ""
    return [Table(f"{count(rows.height, 'refusal')}, the latest first", columns, lines, more)]


def _place(order: tuple[str, ...], name: str) -> int:
    return order.index(name) if name in order else len(order)
