"""Every generated damaged or hostile log ends in one verdict, keeps what is sound, and stays small and quick."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from corpus import Truth, read_mcap
from damaged_csv import Table, written_files
from damaged_mcap import damaged_files, flip
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from logs_support import vehicle
from outside_ci import outside_ci

from fieldcal.logs.ingest import read_flight

MOST_MB = 512
MOST_SECONDS = 10.0
FLIPS = 300 if os.environ.get("CI") else 2000
VERDICTS = ("ok", "partial", "quarantined", "rejected")
SUPPORT = Path(__file__).parents[1]


def outcomes(kind: str, folder: Path) -> tuple[list[dict[str, Any]], float]:
    """What became of every log of a corpus, and the peak of memory in MB of the process that read them."""
    command = [sys.executable, str(SUPPORT / "corpus.py"), kind, str(folder)]
    run = subprocess.run(command, capture_output=True, text=True, cwd=SUPPORT, env=environment(), check=False)
    assert run.returncode == 0, run.stderr[-2000:]
    lines = [json.loads(line) for line in run.stdout.splitlines()]
    return lines[:-1], lines[-1]["peak_mb"]


def environment() -> dict[str, str]:
    return {**os.environ, "POLARS_MAX_THREADS": "2"}


@pytest.fixture(scope="module")
def truth(tmp_path_factory: pytest.TempPathFactory) -> Truth:
    return Truth(tmp_path_factory.mktemp("truth"))


@outside_ci
def test_mcap_corpus(tmp_path: Path, truth: Truth) -> None:
    found, peak_mb = outcomes("mcap", tmp_path)
    assert [outcome["name"] for outcome in found] == [kind.name for kind in damaged_files(truth.sound)]
    assert len({outcome["name"] for outcome in found}) == len(found) >= 200
    assert peak_mb <= MOST_MB
    for outcome in found:
        name = outcome["name"]
        assert outcome["bytes"] <= 10_000_000, name
        assert outcome["verdict"] in outcome["verdicts"], outcome
        assert (outcome["reason"] is None) == (outcome["verdict"] == "ok"), name
        assert outcome["seconds"] <= MOST_SECONDS, outcome
        assert outcome["verifiable"] <= outcome["checked"], name
        if outcome["verdict"] in ("quarantined", "rejected") or not outcome["checked"]:
            continue
        assert outcome["not_recovered"] == 0, outcome
        assert outcome["altered"] == 0, outcome
        if outcome["missing"]:
            assert outcome["verdict"] == "partial", outcome


def test_csv_corpus(tmp_path: Path) -> None:
    found, peak_mb = outcomes("csv", tmp_path)
    assert len({outcome["name"] for outcome in found}) == len(found) == len(list(written_files(Table()))) >= 100
    assert peak_mb <= MOST_MB
    for outcome in found:
        name = outcome["name"]
        assert outcome["verdict"] in outcome["verdicts"], outcome
        assert outcome["must_say"] in outcome["said"], outcome
        assert outcome["seconds"] <= MOST_SECONDS, outcome
        if outcome["rows_wanted"] and outcome["verdict"] in ("ok", "partial"):
            assert outcome["rows"] == outcome["rows_wanted"], name
            assert outcome["altered"] == 0, name


def test_flips_of_a_file_with_crcs_alter_nothing_and_lose_nothing_silently(tmp_path: Path) -> None:
    truth = Truth(tmp_path, samples=60, chunk_bytes=6000)
    rng = np.random.default_rng(20)
    verdicts = dict.fromkeys(VERDICTS, 0)
    for bit in rng.integers(0, len(truth.sound) * 8, FLIPS).tolist():
        content = flip(truth.sound, bit // 8, bit % 8)
        outcome = read_mcap(tmp_path / "log.mcap", truth, content, whole=False)
        verdicts[outcome["verdict"]] += 1
        assert outcome["not_recovered"] == 0, (bit, outcome)
        assert outcome["altered"] == 0, (bit, outcome)
        assert not outcome["missing"] or outcome["verdict"] == "partial", (bit, outcome)
    assert sum(verdicts.values()) == FLIPS
    assert verdicts["quarantined"] == verdicts["rejected"] == 0


EDIT = st.tuples(
    st.floats(0.0, 1.0), st.sampled_from(("flip", "cut", "insert", "remove", "copy")), st.integers(0, 4000)
)


def edited(content: bytes, edits: list[tuple[float, str, int]]) -> bytes:
    """Content after some damage: place as a share of its length, kind, size."""
    for share, kind, size in edits:
        at = int(share * max(len(content) - 1, 0))
        if kind == "flip" and content:
            content = flip(content, at, size % 8)
        elif kind == "cut":
            content = content[:at]
        elif kind == "insert":
            content = content[:at] + bytes(i * size % 256 for i in range(size)) + content[at:]
        elif kind == "remove":
            content = content[:at] + content[at + size :]
        elif kind == "copy":
            content = content[:at] + content[max(0, at - size) : at] + content[at:]
    return content


@settings(
    max_examples=200, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(st.lists(EDIT, min_size=1, max_size=4))
def test_any_damage_to_an_mcap_is_told(tmp_path: Path, truth: Truth, edits: list[tuple[float, str, int]]) -> None:
    outcome = read_mcap(tmp_path / "log.mcap", truth, edited(truth.sound, edits), whole=False)
    assert outcome["verdict"] in VERDICTS
    if outcome["verdict"] in ("ok", "partial"):
        assert outcome["altered"] == 0
        assert not outcome["missing"] or outcome["verdict"] == "partial"


@settings(
    max_examples=200, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(st.lists(EDIT, min_size=1, max_size=4))
def test_any_damage_to_a_csv_ends_in_a_verdict(tmp_path: Path, edits: list[tuple[float, str, int]]) -> None:
    table = Table()
    path = tmp_path / "log.csv"
    path.write_bytes(edited("\n".join([*table.lines(), ""]).encode(), edits))
    tables, facts = read_flight(path, vehicle())
    assert facts["verdict"] in VERDICTS
    assert (facts["reason"] is None) == (facts["verdict"] == "ok")
    for frame in tables.values():
        t = frame["t_ns"].to_numpy()
        assert (np.diff(t) > 0).all()
