"""What ARCHITECTURE.md and the README point to exists."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
DOCUMENTS = ("README.md", "ARCHITECTURE.md", "CONTRIBUTING.md")
FILE = re.compile(r"`([\w./-]+\.(?:py|sql|toml))`")
FOLDER = re.compile(r"`((?:fieldcal|flows|schemas|warehouse|tests|benchmarks|docs)/[\w/]*/)`")
LINK = re.compile(r"\]\(([\w./-]+)\)")
NOT_HERE = {"fieldcal.toml"}
"""Files of the reader's own."""


@pytest.mark.parametrize("document", DOCUMENTS)
def test_files_that_a_document_names_are_there(document: str) -> None:
    text = (ROOT / document).read_text(encoding="utf-8")
    rooms = [ROOT / room for room in ("fieldcal", "flows", "schemas", "warehouse", "tests", "benchmarks")]
    there = {path.relative_to(ROOT).as_posix() for room in rooms for path in room.rglob("*") if path.is_file()}
    there |= {path.name for path in ROOT.iterdir()}
    named = set(FILE.findall(text)) - NOT_HERE
    assert not {name for name in named if not any(f"/{path}".endswith(f"/{name}") for path in there)}
    assert not {name for name in FOLDER.findall(text) if not (ROOT / name).is_dir()}
    assert not {name for name in LINK.findall(text) if not (ROOT / name).exists()}


def test_architecture_is_one_page() -> None:
    assert len((ROOT / "ARCHITECTURE.md").read_text(encoding="utf-8").splitlines()) <= 70
