"""What people's decisions make of the history's rows: which of them count."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import polars as pl

from fieldcal.names import Decision, Status
from fieldcal.schemas.frames import empty_frame
from fieldcal.warehouse import checksums
from fieldcal.warehouse.layout import history_files
from fieldcal.warehouse.store import read_table

DECIDED = ("calibration", "sync", "information")
"""Tables of flights whose rows have a status that says whether they count."""
PARTS = ("unit_id", "sensor", "parameter", "axis")
"""Columns by which a decision may mean a part of a flight."""


def decisions(root: Path) -> pl.DataFrame:
    """The table `decision` of all vehicles in order of time: a flight that moved to another vehicle keeps its own."""
    files = history_files(root, "decision")
    checksums.assure(root, files)
    found = [read_table(path, "decision") for path in files]
    return pl.concat([empty_frame("decision"), *found]).sort("decided_at", "flight_id")


def withdrawn_flights(decided: pl.DataFrame) -> list[str]:
    """flight_id of each flight that counts nowhere, by `decisions`."""
    whole = decided.filter(pl.all_horizontal(pl.col(PARTS).is_null()))
    last = whole.group_by("flight_id", maintain_order=True).agg(pl.col("decision").last())
    return last.filter(pl.col("decision") == Decision.WITHDRAW)["flight_id"].to_list()


def counting(root: Path) -> pl.Expr:
    """Of rows with a flight_id those whose flight was not withdrawn."""
    return ~pl.col("flight_id").is_in(withdrawn_flights(decisions(root)))


def as_decided(table: str, rows: pl.DataFrame, decided: pl.DataFrame) -> pl.DataFrame:
    """Rows of a table among `DECIDED` with the status that the last decision about each gives it: `ok` becomes
    `withdrawn` and `withdrawn` `ok`; what was refused stays so. A VPS's clock goes with its flight or unit, information
    on a gain with its scale."""
    of_flights = decided.filter(pl.col("flight_id").is_in(rows["flight_id"].unique().to_list()))
    if of_flights.is_empty():
        return rows
    state = rows["status"].to_numpy().astype(object)
    columns = {name: rows[name].to_numpy() for name in ("flight_id", *PARTS) if name in rows.columns}
    if table == "information":
        columns["parameter"] = np.where(columns["parameter"] == "gain", "scale", columns["parameter"])
    counts = np.full(rows.height, None, dtype=object)
    for decision in of_flights.iter_rows(named=True):
        meant = columns["flight_id"] == decision["flight_id"]
        for name in PARTS:
            if decision[name] is not None:
                meant = meant & (columns[name] == decision[name] if name in columns else False)
        counts[meant] = decision["decision"]
    state[(counts == Decision.WITHDRAW) & (state == Status.OK)] = str(Status.WITHDRAWN)
    state[(counts == Decision.ACCEPT) & (state == Status.WITHDRAWN)] = str(Status.OK)
    return rows.with_columns(status=pl.Series(state, dtype=pl.String))
