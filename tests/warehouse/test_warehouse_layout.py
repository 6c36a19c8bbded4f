"""Ids as names: nothing leaves the root, everything comes back."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from fieldcal.warehouse import layout

HOSTILE = [
    "",
    ".",
    "..",
    "../../x",
    "/etc/passwd",
    "a/b",
    "a\\b",
    "a\0b",
    "%2e%2e",
    "~",
    ".hidden",
    "_hidden",
    "__HIVE_DEFAULT_PARTITION__",
    "vehicle_id=x",
    "C:\\x",
    "con",
    "Ä ö",
    "\u202e\U0001f681",
    "\udcff",
    "new\nline",
    " ",
    "-rf",
    "é" * 25,
    "x" * 150,
]


@pytest.mark.parametrize("text", HOSTILE)
def test_hostile_ids_are_one_component_and_come_back(text: str, tmp_path: Path) -> None:
    name = layout.encode_id(text)
    assert "/" not in name
    assert "\0" not in name
    assert name not in ("", ".", "..")
    assert name[0] != "."
    assert name.isascii()
    assert layout.decode_id(name) == text
    for path in (
        layout.signal_path(tmp_path, "imu", text, text),
        layout.history_path(tmp_path, "flight", text),
        layout.stage_folder(tmp_path, text, text, text),
        layout.lock_path(tmp_path, text),
    ):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
        assert path.resolve().is_relative_to(tmp_path)
    assert layout.vehicle_of(layout.signal_path(tmp_path, "imu", text, "f")) == text


@given(st.text(st.characters(), max_size=300))
@example("\ud800")
def test_any_text_round_trips_or_is_shortened(text: str) -> None:
    name = layout.encode_id(text)
    assert len(name) <= 150
    assert layout.decode_id(name) in (text, None)


@given(st.lists(st.text(max_size=60), unique=True, max_size=20))
def test_different_ids_have_different_names(texts: list[str]) -> None:
    assert len({layout.encode_id(text) for text in texts}) == len(texts)


def test_very_long_ids_are_shortened_and_stay_apart() -> None:
    a, b = "x" * 5000 + "a", "x" * 5000 + "b"
    assert len(layout.encode_id(a)) <= 150
    assert layout.encode_id(a) != layout.encode_id(b)
    assert layout.decode_id(layout.encode_id(a)) is None
    assert "%" not in layout.encode_id("é" * 300).split("~")[0][-2:]


def test_ordinary_ids_stay_readable() -> None:
    assert layout.encode_id("morpheus-1_B.2") == "morpheus-1_B.2"


def test_unknown_tables_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="there is no table 'x' here"):
        layout.history_path(tmp_path, "x", "v")


def test_the_root_ignores_itself_and_keeps_its_cache_private(tmp_path: Path) -> None:
    root = tmp_path / "deep" / "root"
    layout.prepare(root)
    layout.prepare(root)
    assert (root / ".gitignore").read_text() == "*\n"
    assert (root / "stages").stat().st_mode & 0o777 == 0o700
