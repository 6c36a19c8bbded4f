"""What can be asked: every table and view with its columns, for people, Markdown and programs."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass

from fieldcal.names import Json
from fieldcal.schemas.column import Table
from fieldcal.schemas.tables import TABLES
from fieldcal.warehouse.sql import empty_table
from fieldcal.warehouse.views import AT, VIEWS, view_text

MEANINGS = {
    "source": "where the value comes from: drift (the unit's trend), flight (the latest that was not refused), pooled "
    "(all of the unit's flights together)",
    "why": "why this value, as a sentence",
    "drift_status": "status of the trend in table drift",
    "temperature_from_degc": "lower end of the 5 °C interval",
    "spread": "standard deviation among the flights of the interval",
    "first_at": "start of the first flight of the interval",
    "last_at": "start of the last flight of the interval",
    "level": "what was refused: log, stage, parameter, sync",
    "what": "name of the log, stage or parameter",
    "detail": "numbers that decided it; of a stage JSON",
    "autopilot": "px4 or ardupilot",
    "device_id": "the autopilot's id of the sensor",
}
"""Of columns that only views have."""
EXAMPLES = {
    "flight": "SELECT verdict, count(*) AS logs FROM flight GROUP BY verdict",
    "calibration": "SELECT started_at, axis, value, sd FROM calibration WHERE vehicle_id = 'sim-1'"
    " AND sensor = 'gyroscope' AND parameter = 'zero' AND status = 'ok' ORDER BY started_at, axis",
    "fit": "SELECT quantity, method, median(tic) AS tic FROM fit WHERE signal = 'smoothed' GROUP BY ALL ORDER BY tic",
    "sync": "SELECT vehicle_id, lag_mid_s, lag_sd_s, skew_ppm FROM sync WHERE status = 'ok'",
    "run": "SELECT stage, reason_code, count(*) AS flights FROM run WHERE status = 'refused' GROUP BY ALL ORDER BY 3",
    "drift": "SELECT vehicle_id, sensor, parameter, axis, status, reason FROM drift"
    " WHERE status NOT IN ('stable', 'insufficient')",
    "moments": "SELECT vehicle_id, sensor, sum(n_samples) AS samples FROM moments GROUP BY ALL",
    "information": "SELECT sensor, parameter, axis, 1 / sqrt(information[place + 1]) AS least_sd FROM information"
    " WHERE flight_id = (SELECT max(flight_id) FROM information) AND information[place + 1] > 0",
    "pooled": "SELECT sensor, parameter, axis, value_at_25degc, sd, status FROM pooled WHERE vehicle_id = 'sim-1'",
    "decision": "SELECT decided_at, author, decision, flight_id, reason FROM decision ORDER BY decided_at",
    "export": "SELECT exported_at, vehicle_id, sensor, name, set_to FROM export ORDER BY exported_at DESC",
    "latest_calibration": "SELECT sensor, parameter, axis, value_at_25degc, sd, why FROM latest_calibration"
    " WHERE vehicle_id = 'sim-1'",
    "history": "SELECT * FROM history WHERE sensor = 'accelerometer' AND parameter = 'scale'",
    "drift_by_temperature": "FROM drift_by_temperature WHERE sensor = 'gyroscope' AND parameter = 'zero'",
    "worst_tic": "FROM worst_tic LIMIT 20",
    "refusals": "SELECT what, reason_code, count(*) AS times FROM refusals GROUP BY ALL ORDER BY times DESC",
    "active": "SELECT vehicle_id, name, set_to, exported_at FROM active WHERE sensor = 'gyroscope'",
    "calibration_at": "SELECT sensor, parameter, axis, value, sd FROM calibration_at(12.5) WHERE vehicle_id = 'sim-1'",
}


@dataclass(frozen=True)
class ColumnReference:
    """A column: its type as the tables' files have it or SQL answers it, unit ("" where there is none), meaning."""

    name: str
    type: str
    unit: str
    meaning: str
    key: bool


@dataclass(frozen=True)
class Relation:
    """A table or view. `kind`: "history", "signal", "stage" or "view"; `example`: a question in SQL, "" of tables that
    SQL does not answer; `version`: of the table, None of a view."""

    name: str
    kind: str
    meaning: str
    version: int | None
    columns: tuple[ColumnReference, ...]
    example: str

    def as_json(self) -> dict[str, Json]:
        """Plain JSON."""
        return {**asdict(self), "columns": [asdict(column) for column in self.columns]}


def relations() -> dict[str, Relation]:
    """Every table and view, by name: history, views, signals, stage tables."""
    kinds = ("history", "signal", "stage")
    tables = [_of_table(table) for kind in kinds for table in TABLES.values() if table.kind == kind]
    views = _of_views()
    history = [table for table in tables if table.kind == "history"]
    return {one.name: one for one in [*history, *views, *(table for table in tables if table.kind != "history")]}


def markdown(found: Iterable[Relation]) -> str:
    """Sections with a table of columns each; a star marks the columns that identify a row."""
    lines: list[str] = []
    for one in found:
        version = f", version {one.version}" if one.version is not None else ""
        lines += [f"### {one.name} ({one.kind}{version})", "", one.meaning, ""]
        if one.example:
            lines += ["```sql", one.example, "```", ""]
        lines += ["| column | type | unit | meaning |", "|---|---|---|---|"]
        lines += [
            f"| {c.name}{' *' if c.key else ''} | {c.type} | {c.unit} | {_cell(c.meaning)} |" for c in one.columns
        ]
        lines.append("")
    return "\n".join(lines)


def _cell(text: str) -> str:
    return text.replace("|", "\\|")


def _of_table(table: Table) -> Relation:
    columns = [ColumnReference(c.name, str(c.type), c.unit, c.meaning, c.name in table.key) for c in table.columns]
    example = EXAMPLES.get(table.name, f"FROM {table.name} LIMIT 10") if table.kind == "history" else ""
    meaning = f"{table.meaning[0].upper()}{table.meaning[1:]}."
    return Relation(table.name, table.kind, meaning, table.version, tuple(columns), example)


def _of_views() -> list[Relation]:
    import duckdb

    known = {c.name: c for table in TABLES.values() if table.kind != "history" for c in table.columns}
    known |= {c.name: c for table in TABLES.values() if table.kind == "history" for c in table.columns}
    found: list[Relation] = []
    with duckdb.connect() as engine:
        for table in TABLES.values():
            if table.kind == "history":
                engine.execute(empty_table(table.name))
        for view in VIEWS:
            text = view_text(view)
            engine.execute(text)
            described = engine.execute(f"DESCRIBE SELECT * FROM {AT.get(view, view)}").fetchall()
            columns = [
                ColumnReference(
                    name,
                    str(kind).lower(),
                    known[name].unit if name in known else "",
                    MEANINGS[name] if name in MEANINGS else known[name].meaning,
                    False,
                )
                for name, kind, *_ in described
            ]
            example = EXAMPLES.get(view, f"FROM {AT.get(view, view)} LIMIT 10")
            found.append(Relation(view, "view", _heading(text), None, tuple(columns), example))
    return found


def _heading(text: str) -> str:
    """The comment above a view's statement."""
    lines = []
    for line in text.splitlines():
        if not line.startswith("--"):
            break
        lines.append(line.removeprefix("--").strip())
    return " ".join(lines)
