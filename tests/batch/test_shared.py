"""Nights on several machines that share a store and nothing else: each does what no other has done."""

from __future__ import annotations

import uuid
from collections.abc import Iterator
from pathlib import Path

import obstore
import pytest
from object_store import keys, machine, running_store, upload
from obstore.store import from_url

from fieldcal.batch.closing import close_night
from fieldcal.batch.flights import one_flight
from fieldcal.batch.night import Night, plan_night, publishings
from fieldcal.remote.objects import Objects
from fieldcal.remote.places import archive_at, session_at
from fieldcal.report.fitness import Criteria
from fieldcal.simulation.archive import write_flights
from fieldcal.simulation.experiment import Experiment
from fieldcal.warehouse.content import content_sha256
from fieldcal.warehouse.publish import publish
from fieldcal.warehouse.query import Warehouse
from fieldcal.warehouse.upkeep.verify import verify


@pytest.fixture(scope="module")
def archive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two vehicles, two short flights each: refused by their stages, which is a result as any other."""
    folder = tmp_path_factory.mktemp("archive")
    write_flights(folder, Experiment(seed=2, duration_s=6.0), vehicles=2, sessions=2)
    return folder


@pytest.fixture(scope="module")
def content(archive: Path, tmp_path_factory: pytest.TempPathFactory) -> str:
    """What a night on one machine makes of it."""
    root = tmp_path_factory.mktemp("here") / "data"
    night(archive, root)
    return content_sha256(root)


@pytest.fixture(scope="module")
def logs(archive: Path) -> Iterator[str]:
    with running_store():
        upload(archive, "s3://logs/fleet")
        yield "s3://logs/fleet"


@pytest.fixture
def url(logs: str) -> str:
    return f"s3://warehouse/{uuid.uuid4().hex}"


@pytest.fixture
def fetched(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Keys of logs whose content was fetched."""
    found: list[str] = []
    real = Objects.fetch

    def fetch(self: Objects, key: str, path: Path) -> object:
        if not key.endswith(".toml"):
            found.append(key)
        return real(self, key, path)

    monkeypatch.setattr(Objects, "fetch", fetch)
    return found


def night(archive: Path, root: Path, session: Path | None = None) -> Night:
    """A night without Prefect."""
    planned = plan_night(archive, root, None, session)
    finish(planned)
    return planned


def finish(planned: Night) -> None:
    outcomes = [
        *planned.unchanged(),
        *(one_flight(planned.root, job, planned.configuration) for job in planned.missing()),
    ]
    for publishing in publishings(planned, outcomes):
        publishing.publish()
    planned.remember(outcomes)
    close_night(planned.root, Criteria())


def is_whole(url: str, content: str) -> None:
    """What whoever asks now finds at the URL."""
    found = verify(Warehouse(url).root)
    assert found["damaged"] == []
    assert found["content_sha256"] == content


def test_nights_by_url_end_as_one_on_this_machine(
    content: str, logs: str, url: str, tmp_path: Path, fetched: list[str]
) -> None:
    with machine(tmp_path / "1"):
        assert len(night(archive_at(logs), Warehouse(url).root).missing()) == 4
        assert sorted(fetched) == sorted(key for key in keys(logs) if key.endswith(".mcap"))
        before = keys(url)
        assert len(night(archive_at(logs), Warehouse(url).root).plan.done) == 4
        assert keys(url) == before
    with machine(tmp_path / "2"):
        assert len(night(archive_at(logs), Warehouse(url).root).plan.done) == 4
        is_whole(url, content)
    assert len(fetched) == 4
    page = obstore.get(from_url(url), "site/index.html")
    assert page.attributes["Content-Type"] == "text/html"
    assert {key.split("/")[0] for key in before} == {"heads", "objects", "tables", "night", "site", "reports"}


def test_a_night_and_a_session_at_once_give_the_union(
    archive: Path, content: str, logs: str, url: str, tmp_path: Path
) -> None:
    with machine(tmp_path / "1"):
        planned = plan_night(archive_at(logs), Warehouse(url).root)
    with machine(tmp_path / "2"):
        first = min(path.name for path in (archive / "sim-2").iterdir())
        folder, session = session_at(f"{logs}/sim-2/{first}")
        assert len(night(folder, Warehouse(url).root, session).missing()) == 1
    with machine(tmp_path / "1"):
        assert len(planned.missing()) == 4
        finish(planned)
    with machine(tmp_path / "3"):
        is_whole(url, content)


def test_a_night_that_dies_before_all_is_published_is_ended_by_another_machine(
    content: str, logs: str, url: str, tmp_path: Path
) -> None:
    with machine(tmp_path / "1"):
        planned = plan_night(archive_at(logs), Warehouse(url).root)
        outcomes = [one_flight(planned.root, job, planned.configuration) for job in planned.missing()]
        next(publishings(planned, outcomes)).publish()
    with machine(tmp_path / "2"):
        assert len(night(archive_at(logs), Warehouse(url).root).missing()) == 4  # nobody told what the rows are of
        is_whole(url, content)


def test_what_is_told_holds_only_for_the_results_it_was_told_of(logs: str, url: str, tmp_path: Path) -> None:
    with machine(tmp_path / "1"):
        first = night(archive_at(logs), Warehouse(url).root)
        gone = first.plan.jobs[0]
        publish(first.root, gone.vehicle_id, {}, [gone.flight_id])
    with machine(tmp_path / "2"):
        again = plan_night(archive_at(logs), Warehouse(url).root)
        assert [job.flight_id for job in again.missing()] == [gone.flight_id]
