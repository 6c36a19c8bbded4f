"""What the source must not do; which room may import which is import-linter's (pyproject.toml)."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
from pathlib import Path

import pytest

import fieldcal
from fieldcal import schemas

PACKAGE = Path(str(fieldcal.__file__)).parent
FORBIDDEN_ANYWHERE = {"pickle", "marshal", "shelve", "dill", "cloudpickle", "yaml"}
FORBIDDEN_CALLS = {"eval", "exec"}
MOST_MODULES_IN_A_ROOM = 17


def modules() -> list[Path]:
    """Every module, those behind the links to the folders at the root too."""
    found = (Path(folder, name) for folder, _, names in os.walk(PACKAGE, followlinks=True) for name in names)
    return sorted(path.relative_to(PACKAGE) for path in found if path.suffix == ".py")


def imported(path: Path) -> set[str]:
    """Full names of what a module imports."""
    names: set[str] = set()
    for node in ast.walk(ast.parse((PACKAGE / path).read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            names.add(node.module or "")
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return names


@pytest.mark.parametrize("path", modules(), ids=str)
def test_nothing_read_from_disk_is_run(path: Path) -> None:
    assert not {name.split(".")[0] for name in imported(path)} & FORBIDDEN_ANYWHERE
    called = {
        node.func.id
        for node in ast.walk(ast.parse((PACKAGE / path).read_text(encoding="utf-8")))
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)
    }
    assert not called & FORBIDDEN_CALLS


def test_parquet_is_read_and_written_in_one_place() -> None:
    assert [str(path) for path in modules() if "pyarrow.parquet" in imported(path)] == ["warehouse/store.py"]


def test_a_room_is_small_enough_to_look_around_in() -> None:
    rooms = {path.parent for path in modules()}
    sizes = {str(room): sum(path.parent == room for path in modules()) for room in rooms}
    assert {room: size for room, size in sizes.items() if size > MOST_MODULES_IN_A_ROOM} == {}


@pytest.mark.parametrize("name", ["flows", "schemas", "warehouse"])
def test_there_is_one_copy_of_each_package(name: str) -> None:
    """Not even from the root of a checkout, where the folders lie."""
    program = f"import {name}"
    run = subprocess.run([sys.executable, "-c", program], cwd=PACKAGE.parent, capture_output=True, text=True)
    assert run.returncode == 1
    assert "ImportError" in run.stderr or "ModuleNotFoundError" in run.stderr


def test_numeric_columns_have_units() -> None:
    for table in schemas.TABLES.values():
        for column in table.columns:
            assert column.meaning, f"{table.name}.{column.name}"
            assert column.unit or not column.numeric, f"{table.name}.{column.name}"


def test_no_two_files_of_tests_have_one_name() -> None:
    """Their folders are no packages: the second one would not be collected."""
    names = [path.name for path in Path(__file__).parents[1].rglob("test_*.py")]
    assert len(names) == len(set(names))
