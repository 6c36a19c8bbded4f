"""Names that come from files steer no terminal, hide nothing on a page, and are no formula in a spreadsheet."""

from __future__ import annotations

import csv
import io
import json

import polars as pl
import pytest

from fieldcal.cli.main import _told
from fieldcal.cli.present.screen import console
from fieldcal.cli.show import print_csv, print_frame, print_json
from fieldcal.report.page import Column, Page, Section, Table, Text, html
from fieldcal.words.printable import csv_cell, printable
from fieldcal.words.talk import say

NAME = "v\x1b[31m\x9b2J\u202egnp.\u2028\r\n[1/1] ok\u200b\x00"
SHOWN = r"v\x1b[31m\x9b2J\u202egnp.\u2028\r\n[1/1] ok\u200b\x00"


def test_control_characters_are_written_out() -> None:
    assert printable(NAME) == SHOWN
    assert printable("flight ü 飛行 – ±1.5 °C") == "flight ü 飛行 – ±1.5 °C"
    assert printable("a\ud800\nb", keep="\n") == "a\\ud800\nb"


def test_a_terminal_shows_them_written_out(capsys: pytest.CaptureFixture[str]) -> None:
    say(NAME)
    _told(NAME, 1)
    console(wide=True).print(f"log {NAME}", markup=False)
    print_frame(pl.DataFrame({"log\x1b": [NAME]}), as_json=False, as_csv=False)
    captured = capsys.readouterr()
    assert captured.out.count(SHOWN) == 2
    assert captured.err.splitlines()[0] == SHOWN
    for text in (captured.out, captured.err):
        assert not [letter for letter in text if not letter.isprintable() and letter != "\n"]


def test_json_holds_them_as_escapes_and_gives_them_back(capsys: pytest.CaptureFixture[str]) -> None:
    print_json({"log": NAME + "\ud800"})
    told = capsys.readouterr().out
    assert not [letter for letter in told if not letter.isprintable() and letter != "\n"]
    assert json.loads(told) == {"log": NAME + "\ud800"}


def test_a_page_shows_them_written_out() -> None:
    table = Table(NAME, [Column(NAME)], [[NAME]], NAME)
    page = html(Page(NAME, [NAME], [(NAME, NAME)], [Section("s", NAME, [Text(NAME), table])], NAME))
    assert not [letter for letter in page if letter in NAME and not letter.isprintable() and letter not in "\r\n"]
    assert r"v\x1b[31m" in page


FORMULAS = ["=1+1", "+cmd|' /C calc'!A0", "-2+3", "@SUM(1)", "=\x1b"]
NUMBERS = ["-1.5", "+2", "-", "1e-3", "-.5E+3"]


def test_no_cell_of_csv_is_a_formula_and_numbers_stay(capsys: pytest.CaptureFixture[str]) -> None:
    print_csv(pl.DataFrame({"=name": [*FORMULAS, NAME], "value": [-1.5, 1.0, 2.0, -3e-9, 0.0, 1.0]}))
    rows = list(csv.reader(io.StringIO(capsys.readouterr().out)))
    assert rows[0] == ["'=name", "value"]
    assert [row[0] for row in rows[1:]] == [*("'" + printable(text) for text in FORMULAS), SHOWN]
    assert [float(row[1]) for row in rows[1:]] == [-1.5, 1.0, 2.0, -3e-9, 0.0, 1.0]
    assert [csv_cell(text) for text in NUMBERS] == NUMBERS
