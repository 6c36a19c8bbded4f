"""The fleet's page: a row per vehicle, and before it what needs a look."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import datetime
from pathlib import Path
from typing import Literal

import polars as pl

from fieldcal.names import GRAVEST_FIRST, DriftStatus, Verdict
from fieldcal.report.history import UsableFlight, as_of_sentence, newest, usable_flights
from fieldcal.report.key_parameter import key_parameters
from fieldcal.report.links import Links, flight_name, vehicle_name
from fieldcal.report.page import Column, Notice, Page, Part, Section, Table, Text, badge
from fieldcal.report.trend import TREND_VALUES, change_sentence, worst_status
from fieldcal.report.words import age, day, measured, plain_name
from fieldcal.schemas.columns import FLOWN_ORDER
from fieldcal.schemas.rows import DriftRow, FitRow, FlightRow
from fieldcal.trends.reasons import status_words
from fieldcal.warehouse import Warehouse
from fieldcal.warehouse.questions import existing, units_flown
from fieldcal.words.measures import rows_written
from fieldcal.words.numbers import number
from fieldcal.words.rows import typed

LOOKS = 200
NOT_ANALYSED = "not analysed"
SERIES: tuple[Literal["sensor", "method", "parameter", "axis", "unit"], ...] = (
    "sensor",
    "method",
    "parameter",
    "axis",
    "unit",
)

_COLUMNS = (
    Column("vehicle"),
    Column("IMU", "id"),
    Column("status"),
    Column("latest verdict"),
    Column("last usable flight", "nowrap"),
    Column("age", "n"),
    Column("flights", "n"),
    Column("worst TIC"),
    Column("key parameter"),
    Column("history"),
)


def fleet_page(root: Path, links: Links, as_of: datetime | None) -> Page:
    """The page, from the history below `root`."""
    warehouse = existing(root)
    moment = as_of or newest(warehouse)
    flights = warehouse.scan("flight").collect()
    drift = rows_written(warehouse.scan("drift").collect(), TREND_VALUES)
    usable = usable_flights(warehouse)
    vehicles = sorted(flights["vehicle_id"].unique().to_list())
    last = {row["vehicle_id"]: row for row in typed(usable.iter_rows(named=True), UsableFlight)}
    worst = _worst_tics(warehouse, last)
    flown = units_flown(warehouse)
    on_board = flown.select("vehicle_id", "unit_id").unique().sort("vehicle_id", "unit_id")
    of_vehicles = on_board.join(drift.drop("vehicle_id"), on="unit_id", maintain_order="left_right")
    trends = {str(key[0]): part for key, part in of_vehicles.partition_by("vehicle_id", as_dict=True).items()}
    sparks = key_parameters(warehouse, flown, trends)
    rows, statuses = [], dict.fromkeys((*GRAVEST_FIRST, NOT_ANALYSED), 0)
    for key, part in flights.sort("vehicle_id", *FLOWN_ORDER).partition_by("vehicle_id", as_dict=True).items():
        vehicle = str(key[0])
        status = worst_status(trends.get(vehicle))
        statuses[status or NOT_ANALYSED] += 1
        rows.append(
            _row(vehicle, part, status, last.get(vehicle), worst.get(vehicle), sparks.get(vehicle), links, moment)
        )
    looks = _looks(drift, links)
    verdicts = dict(flights.group_by("verdict").len().iter_rows())
    facts = [
        ("vehicles", str(len(vehicles))),
        ("flights", str(flights.height)),
        *((verdict, str(verdicts[verdict])) for verdict in Verdict if verdict in verdicts),
        *((f"vehicles: {status}", str(n)) for status, n in statuses.items() if n),
    ]
    overview: list[Part] = [
        Table(
            "A row per vehicle (fieldcal report --vehicle V writes its page). Status: the worst of what it flew with"
            " last.",
            _COLUMNS,
            rows,
        ),
        Text(
            "A flight is usable when at least one constant came out of it. Worst TIC: the greatest Theil inequality"
            " coefficient of the last usable flight's comparisons (smoothed readings), with its rms error. Key"
            " parameter: the one furthest from steady, else the gyroscope's."
        ),
    ]
    if not rows:
        overview = [Notice("The warehouse has no flights yet. Run fieldcal nightly ARCHIVE.")]
    return Page(
        "Fleet calibration report",
        [as_of_sentence(moment, as_of is not None)],
        facts,
        [Section("look", "What needs a look", looks), Section("vehicles", "Vehicles", overview)],
        "Written by fieldcal from its history tables; equal tables give an equal page.",
    )


def _row(
    vehicle: str,
    flights: pl.DataFrame,
    status: str | None,
    last: UsableFlight | None,
    tic: FitRow | None,
    spark: tuple[str, str] | None,
    links: Links,
    as_of: datetime | None,
) -> list[str]:
    latest = typed([flights.row(-1, named=True)], FlightRow)[0]
    text, drawn = spark or ("–", "")
    return [
        links.to(vehicle_name(vehicle), vehicle),
        str(latest["imu_id"]),
        badge(status or NOT_ANALYSED),
        badge(latest["verdict"]),
        "none" if last is None else links.to(flight_name(last["flight_id"]), day(last["started_at"])),
        "–" if last is None else age(last["started_at"], as_of),
        str(flights.height),
        "–" if tic is None else f"{number(tic['tic'], 3)} {_quantity(tic)} ({measured(tic['rms'], tic['rms_unit'])})",
        text,
        drawn,
    ]


def _quantity(fit: FitRow) -> str:
    return f"{plain_name(fit['quantity'])} against {plain_name(fit['reference'])}"


def _worst_tics(warehouse: Warehouse, last: Mapping[str, UsableFlight]) -> dict[str, FitRow]:
    wanted = [row["flight_id"] for row in last.values()]
    rows = (
        warehouse.scan("fit")
        .filter(pl.col("flight_id").is_in(wanted) & (pl.col("signal") == "smoothed") & pl.col("tic").is_not_null())
        .filter("is_primary")
        .sort("tic", "quantity", "method", "reference")
        .collect()
    )
    return {row["vehicle_id"]: row for row in typed(rows.iter_rows(named=True), FitRow)}


def _siblings(drift: pl.DataFrame, row: DriftRow) -> list[float]:
    """Values at 25 °C of the same parameter of the fleet's other units."""
    same = (pl.col(name) == row[name] for name in SERIES)
    others = drift.filter(*same, pl.col("unit_id") != row["unit_id"], pl.col("value_at_25degc").is_not_null())
    return others["value_at_25degc"].to_list()


def _unsteady(drift: pl.DataFrame) -> list[DriftRow]:
    """Rows that need a look. `bias` and `zero` follow from `zero_bias`: where that says the same they are left out."""
    found = [
        row
        for row in typed(drift.iter_rows(named=True), DriftRow)
        if row["status"] not in (DriftStatus.STABLE, DriftStatus.INSUFFICIENT)
    ]
    told = {_place(row) for row in found if row["parameter"] == "zero_bias"}
    return [row for row in found if row["parameter"] not in ("bias", "zero") or _place(row) not in told]


def _place(row: DriftRow) -> tuple[str, ...]:
    return row["unit_id"], row["sensor"], row["method"], row["axis"], row["status"]


def _looks(drift: pl.DataFrame, links: Links) -> list[Part]:
    if drift.is_empty():
        return [Notice("The table drift is empty: no trends have been computed yet. Status columns say so.")]
    order = {str(status): i for i, status in enumerate(GRAVEST_FIRST)}
    found = sorted(
        _unsteady(drift),
        key=lambda row: (
            order.get(row["status"], 9),
            row["vehicle_id"],
            row["unit_id"],
            row["sensor"],
            row["parameter"],
            row["method"],
            row["axis"],
        ),
    )
    few = sorted({row["unit_id"] for row in drift.iter_rows(named=True) if row["status"] == DriftStatus.INSUFFICIENT})
    parts: list[Part] = []
    if found:
        columns = (
            Column("vehicle"),
            Column("unit", "id"),
            Column("parameter"),
            Column("status"),
            Column("what", "wide"),
            Column("last flight, σ", "n"),
        )
        rows = [
            [
                links.to(vehicle_name(row["vehicle_id"]), row["vehicle_id"]),
                row["unit_id"],
                f"{plain_name(row['sensor'])} {row['parameter']} {row['axis']} ({plain_name(row['method'])})",
                badge(row["status"], status_words(row)),
                change_sentence(row, _siblings(drift, row) if row["status"] == DriftStatus.OUTLIER else []),
                number(row["last_z"], 2),
            ]
            for row in found[:LOOKS]
        ]
        more = f"{len(found) - LOOKS} more: fieldcal drift." if len(found) > LOOKS else ""
        caption = (
            "Parameters that are not steady, worst first (bias and zero are left out where zero_bias says the same)"
        )
        parts.append(Table(caption, columns, rows, more))
    else:
        parts.append(Text("No parameter with enough flights drifts, stepped, or stands out from its siblings."))
    if few:
        parts.append(Text(f"Too few flights to tell for some parameters of: {', '.join(few)}."))
    return parts
