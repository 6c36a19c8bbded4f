"""What the last night found whole is not looked at again; whatever changed is."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

import fieldcal
from fieldcal.batch.flights import one_flight
from fieldcal.batch.ledgers import flights as seen
from fieldcal.batch.night import Night, plan_night, publishings
from fieldcal.batch.outcome import Outcome
from fieldcal.simulation.archive import write_flights
from fieldcal.simulation.experiment import Experiment

VEHICLES = 2


class Fleet:
    """Two vehicles, a short flight each: refused by its stages, which is a result as any other."""

    def __init__(self, folder: Path) -> None:
        self.archive, self.root = folder / "archive", folder / "data"

    def night(self) -> Night:
        night = plan_night(self.archive, self.root)
        outcomes = [*night.unchanged(), *(one_flight(self.root, job, night.configuration) for job in night.missing())]
        for publishing in publishings(night, outcomes):
            publishing.publish()
        night.remember(outcomes)
        return night

    def plan(self) -> tuple[int, int, int]:
        """How many flights are done, looked at and found whole, to be run."""
        plan = plan_night(self.archive, self.root).plan
        return len(plan.done), len(plan.unchanged), len(plan.missing)


@pytest.fixture(scope="module")
def grown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("fleet")
    fleet = Fleet(folder)
    write_flights(fleet.archive, Experiment(seed=2, duration_s=6.0), vehicles=VEHICLES)
    fleet.night()
    return folder


@pytest.fixture
def fleet(grown: Path, tmp_path: Path) -> Fleet:
    """A copy, seen by one night: its files have other inodes."""
    shutil.copytree(grown, tmp_path / "fleet", copy_function=shutil.copy2)
    fleet = Fleet(tmp_path / "fleet")
    fleet.night()
    return fleet


def test_a_vehicle_is_published_as_soon_as_its_flights_are_through(grown: Path, tmp_path: Path) -> None:
    archive, root = grown / "archive", tmp_path / "data"
    night = plan_night(archive, root)
    made = [one_flight(root, job, night.configuration) for job in night.missing()]
    come: list[str] = []

    def coming() -> Iterator[Outcome]:
        for outcome in made:
            come.append(outcome.job.vehicle_id)
            yield outcome

    published = [(one.vehicle_id, len(one.outcomes), len(come)) for one in publishings(night, coming())]
    assert published == [("sim-1", 1, 1), ("sim-2", 1, 2)]
    assert [(one.vehicle_id, len(one.outcomes)) for one in publishings(night, made[1:])] == [("sim-2", 1)]


def test_nothing_is_looked_at_twice_and_the_same_is_said(fleet: Fleet) -> None:
    assert fleet.plan() == (VEHICLES, 0, 0)
    said = {entry["log_uri"]: entry for entry in fleet.night().plan.done.values()}
    shutil.rmtree(fleet.root / "night" / "seen")
    night = plan_night(fleet.archive, fleet.root)
    looked_at = {outcome.job.log_uri: outcome.entry() for outcome in night.unchanged()}
    assert said == looked_at
    assert len(said) == VEHICLES


def of_first(root: Path, pattern: str) -> Path:
    return min(root.rglob(pattern))


def touched(path: Path) -> None:
    """Another byte at the same size, as a fault of a disk that went through the file system."""
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)


@pytest.mark.parametrize(
    ("change", "left"),
    [
        (lambda f: touched(of_first(f.root / "signals", "*.parquet")), (1, 0, 1)),
        (lambda f: of_first(f.root / "signals", "*.parquet").unlink(), (1, 0, 1)),
        (lambda f: touched(of_first(f.root / "stages" / "manoeuvre", "run.json")), (1, 0, 1)),
        (lambda f: shutil.rmtree(f.root / "stages"), (0, 0, VEHICLES)),
        (lambda f: os.utime(of_first(f.root / "stages" / "manoeuvre", "run.json")), (1, 1, 0)),
        (lambda f: os.utime(of_first(f.archive, "*.mcap")), (1, 1, 0)),
        (lambda f: os.utime(of_first(f.root / "tables" / "flight", "*.parquet")), (1, 1, 0)),
        (lambda f: shutil.rmtree(f.root / "tables"), (0, VEHICLES, 0)),
        (lambda f: of_first(f.root / "night" / "seen", "*.json").write_text("{"), (1, 1, 0)),
        (lambda f: of_first(f.archive, "*.mcap").unlink(), (1, 0, 0)),
    ],
)
def test_what_changed_is_looked_at(fleet: Fleet, change: Callable[[Fleet], object], left: tuple[int, int, int]) -> None:
    change(fleet)
    assert fleet.plan() == left
    fleet.night()
    assert fleet.plan() == (sum(left), 0, 0)


def test_another_configuration_is_another_flight(fleet: Fleet) -> None:
    path = fleet.archive / "fieldcal.toml"
    known = path.read_text()
    path.write_text(f"{known}\n[limits]\nseconds = 999\n")
    assert fleet.plan() == (0, VEHICLES, 0)
    (header,) = [line for line in known.splitlines() if line.startswith("[vehicles") and line.endswith('1"]')]
    path.write_text(known.replace(header, f"{header}\nparameters = {{ smoothing_cutoff_hz = 5.0 }}"))
    assert fleet.plan() == (1, 0, 1)


def test_other_code_looks_at_everything(fleet: Fleet, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(seen, "versions", lambda: {"numpy": "another"})
    assert fleet.plan() == (0, VEHICLES, 0)


def test_a_decision_has_its_vehicle_looked_at(fleet: Fleet) -> None:
    fieldcal.Warehouse(fleet.root).withdraw("sim-1", reason="x")
    assert fleet.plan() in {(1, 1, 0), (2, 0, 0)}  # a short flight has no constant that could count less


def test_another_archive_is_not_forgotten(fleet: Fleet, tmp_path: Path) -> None:
    other = Fleet(tmp_path / "other")
    other.root = fleet.root
    write_flights(other.archive, Experiment(seed=9, duration_s=6.0))
    (other.archive / "sim-1").rename(other.archive / "sim-9")
    other.night()
    assert other.plan() == (1, 0, 0)
    assert fleet.plan() == (VEHICLES, 0, 0)
