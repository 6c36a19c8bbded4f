"""Killed nights and several writers: a few rounds of what the scripts in `benchmarks/` do at length."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import pytest
from crash_rounds import AFTER, BEFORE, killed_at
from outside_ci import outside_ci
from two_writers import at_once

from fieldcal.batch.steps import STEPS
from fieldcal.flows.run import run_night
from fieldcal.simulation.archive import write_flights
from fieldcal.simulation.experiment import Experiment
from fieldcal.warehouse.content import content_sha256
from fieldcal.warehouse.upkeep.verify import verify

STAGE_RECORDS = 2 * len(STEPS)


class Whole(NamedTuple):
    archive: Path
    content: str


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory, prefect_server: str) -> Whole:
    """An archive, and what an undisturbed night makes of it."""
    folder = tmp_path_factory.mktemp("whole")
    write_flights(folder / "archive", Experiment(seed=4, duration_s=20.0), vehicles=2)
    run_night(folder / "archive", folder / "warehouse")
    return Whole(folder / "archive", content_sha256(folder / "warehouse"))


@pytest.mark.parametrize(
    ("side", "number"),
    [
        (BEFORE, 1),
        pytest.param(AFTER, 14, marks=outside_ci),
        pytest.param(BEFORE, STAGE_RECORDS + 2, marks=outside_ci),
        pytest.param(AFTER, STAGE_RECORDS + 9, marks=outside_ci),
    ],
)
def test_a_night_killed_at_a_file_ends_like_an_undisturbed_one(
    whole: Whole, tmp_path: Path, side: str, number: int
) -> None:
    assert killed_at(whole.archive, tmp_path / "w", side, number)
    run_night(whole.archive, tmp_path / "w")
    assert content_sha256(tmp_path / "w") == whole.content
    assert verify(tmp_path / "w")["ok"]


@outside_ci
def test_the_night_and_a_session_at_once_give_the_union(whole: Whole, tmp_path: Path) -> None:
    (session,) = (whole.archive / "sim-2").iterdir()
    assert at_once(whole.archive, session, tmp_path / "w") == [0, 0]
    assert content_sha256(tmp_path / "w") == whole.content
    assert verify(tmp_path / "w")["ok"]
