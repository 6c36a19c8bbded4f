"""Pages of the whole fleet: who is fine to fly and who is not, every flight, and two beside each other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import datetime

import polars as pl
from markupsafe import Markup

from fieldcal.names import Json, Standing, Status, Verdict, exactness
from fieldcal.report.fitness import Fitness, ranked
from fieldcal.report.history import UsableFlight, newest, usable_flights
from fieldcal.report.key_parameter import key_parameters
from fieldcal.report.links import Links, flight_name, vehicle_name
from fieldcal.report.page import STATUS_KIND, Column, Notice, Page, Part, Plot, Section, Table, Text, badge, link
from fieldcal.report.words import count, day, scientific
from fieldcal.schemas.columns import FLOWN_ORDER
from fieldcal.schemas.rows import CalibrationRow, FlightRow
from fieldcal.site.script_data import shown
from fieldcal.warehouse import Warehouse
from fieldcal.warehouse.questions import units_flown
from fieldcal.words.measures import rows_written
from fieldcal.words.rows import typed

SHOWN_REASONS = 2
FOOTER = "Written by fieldcal after each night, from its history tables; equal tables give equal pages."


def fleet_page(warehouse: Warehouse, fitness: Mapping[str, Fitness], links: Links) -> Page:
    """The first page: a row a vehicle, what is not fine to fly first."""
    flights = warehouse.scan("flight").sort("vehicle_id", *FLOWN_ORDER, nulls_last=False).collect()
    flown = units_flown(warehouse)
    drift = warehouse.scan("drift").collect()
    on_board = flown.select("vehicle_id", "unit_id").unique().sort("vehicle_id", "unit_id")
    of_vehicles = on_board.join(drift.drop("vehicle_id"), on="unit_id", maintain_order="left_right")
    trends = {str(key[0]): part for key, part in of_vehicles.partition_by("vehicle_id", as_dict=True).items()}
    sparks = key_parameters(warehouse, flown, trends)
    last = {row["vehicle_id"]: row for row in typed(usable_flights(warehouse).iter_rows(named=True), UsableFlight)}
    of = {str(key[0]): part for key, part in flights.partition_by("vehicle_id", as_dict=True).items()}
    rows = [
        _row(one, of[one.vehicle_id], last.get(one.vehicle_id), sparks.get(one.vehicle_id), links)
        for one in ranked(fitness)
    ]
    counts = {standing: sum(one.standing == standing for one in fitness.values()) for standing in Standing}
    verdicts = dict(flights.group_by("verdict").len().iter_rows())
    moment = newest(warehouse)
    facts = [
        *((badge(standing), str(n)) for standing, n in counts.items() if n),
        ("flights", str(flights.height)),
        *((verdict, str(verdicts[verdict])) for verdict in Verdict if verdict in verdicts and verdict != Verdict.OK),
        ("newest flight (UTC)", day(moment)),
    ]
    columns = (
        Column("vehicle"),
        Column("standing"),
        Column("why", "wide"),
        Column("last usable flight (UTC)", "nowrap"),
        Column("flights", "n"),
        Column("IMU", "id"),
        Column("key parameter"),
        Column("history"),
    )
    parts: list[Part] = [Table("Every vehicle, what needs a look first", columns, rows)]
    parts.append(
        Text(
            "Standing: of the units that it flew with last: trends that drift or stepped, units unlike the fleet, the"
            " latest log, and the age of the constants. Key parameter: the one furthest from steady, else the"
            " gyroscope's."
        )
    )
    if not rows:
        parts = [Notice("The warehouse has no flights yet. Run fieldcal nightly ARCHIVE.")]
    fine = f"{counts[Standing.FINE]} of {count(len(rows), 'vehicle')} fine to fly"
    return Page(f"Fleet: {fine}" if rows else "Fleet", [], facts, [Section("vehicles", "Vehicles", parts)], FOOTER)


def _row(
    one: Fitness, flights: pl.DataFrame, last: UsableFlight | None, spark: tuple[str, str] | None, links: Links
) -> Sequence[str]:
    latest = typed([flights.row(-1, named=True)], FlightRow)[0]
    text, drawn = spark or ("–", "")
    return [
        links.to(vehicle_name(one.vehicle_id), one.vehicle_id),
        badge(one.standing),
        one.why(SHOWN_REASONS) or "–",
        "none" if last is None else Markup("{}{}").format(_linked(last, links), _ago(last["started_at"])),
        str(flights.height),
        str(latest["imu_id"]),
        text,
        drawn,
    ]


def _linked(flight: UsableFlight, links: Links) -> str | Markup:
    return links.to(flight_name(flight["flight_id"]), day(flight["started_at"]))


def _ago(moment: datetime | None) -> Markup:
    """Where a script says how long ago that was, by the reader's clock: a page is as old as its night."""
    return Markup(' <time class="note" datetime="{}"></time>').format(moment.isoformat()) if moment else Markup("")


def flights_page(links: Links) -> Page:
    """Every flight, which a script lists out of the fleet's data."""
    place = Markup('<div class="all-flights"></div>')
    listed = Plot("all-flights", place, "Each vehicle's page lists its own flights, also where scripts do not run.")
    return Page("Flights", [], [], [Section("flights", "Every flight", [listed])], FOOTER, links.up())


def compare_page(links: Links) -> Page:
    """Two vehicles or two flights beside each other, which a script makes out of their data."""
    lead = ["Constants and curves of two vehicles, or of two flights. The address names what is compared: send it."]
    place = Plot(
        "compare", Markup('<div class="compare"></div>'), "Differences are those of the first less the second."
    )
    return Page("Compare", lead, [], [Section("beside", "Beside each other", [place])], FOOTER, links.up())


def fleet_data(warehouse: Warehouse, fitness: Mapping[str, Fitness]) -> Json:
    """Vehicles with their standing, and flights, the latest first, for the pages that a script fills."""
    flights = warehouse.scan("flight").sort(FLOWN_ORDER, nulls_last=False).collect().reverse()
    good = set(usable_flights(warehouse)["flight_id"].to_list())
    number = {vehicle: i for i, vehicle in enumerate(fitness)}
    verdicts = sorted(set(flights["verdict"].to_list()))
    return {
        "vehicles": [
            {
                "id": shown(one.vehicle_id),
                "page": vehicle_name(one.vehicle_id).removesuffix(".html"),
                "standing": str(one.standing),
            }
            for one in fitness.values()
        ],
        "verdicts": [{"name": verdict, "kind": STATUS_KIND.get(verdict, "none")} for verdict in verdicts],
        "columns": ["page", "id", "vehicle", "started", "session", "verdict", "usable", "log", "why"],
        "flights": [
            [
                flight_name(row["flight_id"]).removesuffix(".html"),
                shown(row["flight_id"]),
                number[row["vehicle_id"]],
                day(row["started_at"]),
                shown(str(row["session_id"])),
                verdicts.index(row["verdict"]),
                int(row["flight_id"] in good),
                shown(row["log_uri"]),
                shown(row["reason"]),
            ]
            for row in typed(flights.iter_rows(named=True), FlightRow)
        ],
    }


def constants_data(rows: pl.DataFrame, value: str) -> list[Json]:
    """Constants for comparing, in words and numbers, of several methods the most exact. `value`: its column in `rows`,
    beside sensor, method, parameter, axis, unit and sd."""
    valued = rows if value == "value" else rows.with_columns(value=pl.col(value))
    named = typed(rows_written(valued, ("value", "sd")).iter_rows(named=True), CalibrationRow)
    # Off-diagonal terms are on the pages themselves.
    told = [row for row in named if row.get("status", Status.OK) == Status.OK and len(row["axis"]) <= 1]
    best: dict[tuple[str, str, str], CalibrationRow] = {}
    for row in sorted(told, key=lambda own: exactness(own["method"])):
        best.setdefault((row["sensor"], row["parameter"], row["axis"]), row)
    return [
        {
            "place": f"{row['sensor']} {shown(row['parameter'])} {shown(row['axis'])}",
            "method": row["method"],
            "unit": shown(row["unit"]),
            "value": row["value"],
            "sd": row["sd"],
            "text": scientific(row["value"], row["sd"]),
        }
        for _, row in sorted(best.items())
        if row["value"] is not None and row["value"] == row["value"]
    ]


def with_standing(page: Page, one: Fitness, compare: str) -> Page:
    """A vehicle's page that begins with what is said of it before it flies."""
    facts = [("standing", badge(one.standing)), *((name, value) for name, value in page.facts if name != "age")]
    facts.append(("beside others", link(compare, "compare")))
    lead = list(one.reasons) or ["Every trend with enough sessions is steady, and no constant has expired."]
    lead += [sentence for sentence in (one.next, *(note.sentence for note in one.notes)) if sentence not in lead]
    lead = [sentence for sentence in lead if sentence]
    return Page(page.title, lead, facts, page.sections, FOOTER, page.up)
