"""The data dictionary as Markdown."""

from __future__ import annotations

from fieldcal.schemas.column import Table
from fieldcal.schemas.tables import TABLES

_TITLES = {
    "signal": "Signals: readings as logged",
    "stage": "Stage tables: what passes between the stages of one flight",
    "history": "History: the tables to ask",
}


def data_dictionary() -> str:
    """All tables by kind: columns with type, unit and meaning; a star marks the columns that identify a row."""
    lines = ["# Data dictionary", ""]
    for kind, title in _TITLES.items():
        lines += [f"## {title}", ""]
        for table in TABLES.values():
            if table.kind == kind:
                lines += _section(table)
    return "\n".join(lines)


def _section(table: Table) -> list[str]:
    lines = [f"### {table.name} (version {table.version})", "", f"{table.meaning[0].upper()}{table.meaning[1:]}.", ""]
    lines += ["| column | type | unit | meaning |", "|---|---|---|---|"]
    for column in table.columns:
        mark = " *" if column.name in table.key else ""
        lines.append(f"| {column.name}{mark} | {column.type} | {column.unit} | {column.meaning} |")
    return [*lines, ""]
