"""Dependencies point one way (DESIGN.md), read from the source of every module."""

from __future__ import annotations

import ast
import sys
from pathlib import Path

import pytest

from fieldcal import schemas

ROOT = Path(__file__).resolve().parents[2]
NUMERICS = {"fieldcal", "numpy", "scipy", "pygeomag"}
TABLES = NUMERICS | {"schemas", "polars", "pyarrow"}
LOGS = TABLES | {"mcap", "google", "lz4", "zstandard"}

TABLE_LAYER = ("frames", "results", "pipeline", "simulate_logs", "ingest", "tidy")
"""Modules of fieldcal that turn columns into arrays and back; all others are numerics and know no table."""

ALLOWED = {
    "schemas/": {"schemas", "pyarrow"},
    "fieldcal/": NUMERICS,
    **{f"fieldcal/{name}.py": TABLES for name in TABLE_LAYER},
    "fieldcal/stages/": TABLES,
    "fieldcal/logs/": LOGS,
    "warehouse/": {"warehouse", "schemas", "fieldcal", "numpy", "polars", "pyarrow", "duckdb"},
}
FORBIDDEN_ANYWHERE = {"pickle", "marshal", "shelve", "dill", "cloudpickle", "yaml"}
FORBIDDEN_CALLS = {"eval", "exec"}


def modules() -> list[Path]:
    return [
        path
        for package in ("schemas", "fieldcal", "warehouse", "flows")
        for path in sorted((ROOT / package).rglob("*.py"))
    ]


def imported(path: Path) -> set[str]:
    """Full names of what a module imports from outside the standard library."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            names.add(node.module or "")
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return names


def top(name: str) -> str:
    return name.split(".")[0]


def allowed_for(path: Path) -> set[str] | None:
    relative = path.relative_to(ROOT).as_posix()
    matching = [place for place in ALLOWED if relative.startswith(place)]
    return ALLOWED[max(matching, key=len)] if matching else None


@pytest.mark.parametrize("path", modules(), ids=lambda path: path.relative_to(ROOT).as_posix())
def test_a_module_imports_only_what_its_layer_may(path: Path) -> None:
    names = imported(path)
    allowed = allowed_for(path)
    outside = {top(name) for name in names} - set(sys.stdlib_module_names)
    if allowed is not None:
        assert outside <= allowed, f"{path.name} imports {sorted(outside - allowed)}"
    assert not {top(name) for name in names} & FORBIDDEN_ANYWHERE
    if allowed is NUMERICS:
        upper = {f"fieldcal.{name}" for name in (*TABLE_LAYER, "logs")}
        assert not {name for name in names if name in upper or name.startswith("fieldcal.logs.")}
    if path.is_relative_to(ROOT / "warehouse"):
        assert all(name.startswith("fieldcal.errors") for name in names if top(name) == "fieldcal")
    if not path.is_relative_to(ROOT / "flows"):
        assert not outside & {"prefect", "flows"}
    called = {
        node.func.id
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)
    }
    assert not called & FORBIDDEN_CALLS


def test_parquet_is_read_and_written_in_one_place() -> None:
    users = {path.relative_to(ROOT).as_posix() for path in modules() if "pyarrow.parquet" in imported(path)}
    assert users == {"warehouse/store.py"}


def test_numeric_columns_have_units() -> None:
    for table in schemas.TABLES.values():
        for column in table.columns:
            assert column.meaning, f"{table.name}.{column.name}"
            assert column.unit or not column.numeric, f"{table.name}.{column.name}"
