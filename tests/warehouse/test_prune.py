"""What is pruned is what was said, and what is left is whole; readings that are needed again are read again."""

from __future__ import annotations

import json
import shutil
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

import fieldcal
from fieldcal.batch.flights import one_flight
from fieldcal.batch.ledgers.room import make_room
from fieldcal.batch.night import plan_night, publishings
from fieldcal.cli.main import run
from fieldcal.errors import FieldcalError
from fieldcal.schemas import FLIGHT_TABLES
from fieldcal.simulation.archive import write_flights
from fieldcal.simulation.experiment import Experiment
from fieldcal.warehouse import Warehouse
from fieldcal.warehouse.content import content_sha256
from fieldcal.warehouse.publish import read_history
from fieldcal.warehouse.upkeep.prune import all_results, former_results, of_vehicle, remove, signals_before
from fieldcal.warehouse.upkeep.verify import verify


def night(folder: Path) -> tuple[int, int]:
    """How many flights were whole, and how many stages ran."""
    plan = plan_night(folder / "archive", folder / "data")
    outcomes = [one_flight(plan.root, job, plan.configuration) for job in plan.missing()]
    everything = [*plan.unchanged(), *outcomes]
    for publishing in publishings(plan, everything):
        publishing.publish()
    plan.remember(everything)
    return len(plan.plan.done) + len(plan.plan.unchanged), sum(len(outcome.ran) for outcome in outcomes)


@pytest.fixture(scope="module")
def grown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("grown")
    flown = Experiment(seed=3, duration_s=20.0, dip_rad=np.radians(60.0))
    write_flights(folder / "archive", flown, sessions=2)
    shutil.copytree(folder / "archive" / "sim-1", folder / "archive" / "other")
    for log in (folder / "archive" / "other").rglob("*.mcap"):  # another log: a copy would be told as one
        log.write_bytes(log.read_bytes() + b"\0")
    night(folder)
    return folder


@pytest.fixture
def fleet(grown: Path, tmp_path: Path) -> Path:
    shutil.copytree(grown, tmp_path / "fleet", copy_function=shutil.copy2)
    return tmp_path / "fleet"


def test_nothing_is_lost_with_results_of_before(fleet: Path) -> None:
    root = fleet / "data"
    assert former_results(root).files == ()
    config = fleet / "archive" / "fieldcal.toml"
    known = config.read_text()
    content = content_sha256(root)
    config.write_text(
        known.replace('[vehicles."sim-1"]\n', '[vehicles."sim-1"]\nparameters = { smoothing_cutoff_hz = 6.0 }\n')
    )
    night(fleet)
    changed = content_sha256(root)
    former = former_results(root)
    assert {path.parent.parent.parent.name for path in former.files} >= {"smoothing", "joint"}
    assert former.size_bytes == sum(path.stat().st_size for path in former.files) > 0
    remove(root, former)
    assert verify(root)["ok"]
    assert content_sha256(root) == changed != content
    assert night(fleet) == (4, 0)


def test_the_cache_may_go_whole(fleet: Path) -> None:
    root, content = fleet / "data", content_sha256(fleet / "data")
    remove(root, all_results(root))
    assert not (root / "stages").exists()
    assert verify(root)["ok"]
    assert night(fleet)[0] == 0
    assert content_sha256(root) == content


def test_readings_of_old_flights_are_read_again_where_they_are_needed(fleet: Path) -> None:
    root = fleet / "data"
    moment = datetime(2026, 1, 15, tzinfo=UTC)  # between the two sessions
    old = signals_before(root, moment)
    assert old.what == "readings of 2 flights before 2026-01-15"
    kept = set((root / "signals").rglob("*.parquet")) - set(old.files)
    remove(root, old)
    assert set((root / "signals").rglob("*.parquet")) == kept
    assert verify(root)["ok"]
    assert night(fleet) == (4, 0)
    content = content_sha256(root)
    (verified,) = [one for one in (root / "stages" / "verify").glob("*") if not _read(root, one.name)][:1]
    shutil.rmtree(verified)
    assert night(fleet)[1] == 1
    assert _read(root, verified.name)
    assert content_sha256(root) == content
    assert night(fleet) == (4, 0)


def _read(root: Path, flight_id: str) -> bool:
    return bool(list((root / "signals" / "imu").glob(f"*/{flight_id}.parquet")))


def test_a_vehicle_goes_whole_and_comes_back_with_its_logs(fleet: Path) -> None:
    root = fleet / "data"
    before = {table: read_history(root, table, "other") for table in FLIGHT_TABLES}
    fieldcal.Warehouse(root).withdraw("other", reason="x")
    remove(root, of_vehicle(root, "other"))
    assert not list(root.rglob("*vehicle_id=other*"))
    assert Warehouse(root).scan("flight").collect()["vehicle_id"].unique().to_list() == ["sim-1"]
    assert verify(root)["ok"]
    assert night(fleet)[0] == 2
    assert all(read_history(root, table, "other").equals(rows) for table, rows in before.items())
    with pytest.raises(FieldcalError, match="Nothing of a vehicle 'nobody'"):
        of_vehicle(root, "nobody")


def test_the_command_says_first_and_removes_when_it_is_told(fleet: Path, capsys: pytest.CaptureFixture[str]) -> None:
    at = ["--warehouse", str(fleet / "data")]
    assert run(["prune", "--stages", *at]) == 0
    told = capsys.readouterr().out
    assert "results of all stages" in told
    assert "Nothing was removed" in told
    assert (fleet / "data" / "stages").exists()
    assert run(["prune", "--stages", "--signals-before", "2026-01-15", "--yes", "--json", *at]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["removed"]
    assert [one["bytes"] > 0 for one in document["what"]] == [True, True]
    assert not (fleet / "data" / "stages").exists()
    assert run(["prune", "--signals-before", "2999-01-01", *at]) == 2
    assert run(["prune", "--vehicle", "nobody", *at]) == 2
    assert run(["prune", "--warehouse", str(fleet / "nowhere")]) != 0


def size_bytes(root: Path) -> int:
    return sum(path.stat().st_size for path in root.rglob("*") if path.is_file())


def test_a_warehouse_is_held_to_its_size_and_no_night_makes_again_what_went(
    fleet: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root, config = fleet / "data", fleet / "archive" / "fieldcal.toml"
    night(fleet)
    content, whole = content_sha256(root), size_bytes(root)
    limit = 0.8 * whole
    config.write_text(config.read_text() + f"\n[warehouse]\nlargest_gb = {limit / 1e9}\n")
    make_room(plan_night(fleet / "archive", root))
    assert size_bytes(root) <= limit
    told = capsys.readouterr().err
    assert "largest_gb" in told
    assert "flew longest ago" in told
    assert content_sha256(root) == content
    assert verify(root)["ok"]
    flights = Warehouse(root).scan("flight").sort("started_at").collect()
    kept = [
        (root / "signals" / "imu" / f"vehicle_id={v}" / f"{f}.parquet").exists()
        for v, f in flights.select("vehicle_id", "flight_id").iter_rows()
    ]
    assert kept == sorted(kept), "the oldest go first"
    assert {True, False} == set(kept)
    assert night(fleet) == (4, 0), "nothing is made again"
    make_room(plan_night(fleet / "archive", root))
    assert capsys.readouterr().err == "", "there is room to spare"


def test_where_nothing_may_go_the_size_alone_is_told(fleet: Path, capsys: pytest.CaptureFixture[str]) -> None:
    root, config = fleet / "data", fleet / "archive" / "fieldcal.toml"
    config.write_text(config.read_text() + "\n[warehouse]\nlargest_gb = 1e-6\n")
    make_room(plan_night(fleet / "archive", root))
    assert "of the 4 flights" in capsys.readouterr().err
    make_room(plan_night(fleet / "archive", root))
    told = capsys.readouterr().err
    assert "give it more" in told
    assert "flights" not in told
