"""`fieldcal upgrade` on warehouses that earlier nights made, and on every change of a table since: nothing is lost."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import tarfile
from pathlib import Path

import polars as pl
import polars.testing
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from history_rows import flight, lead, rows
from older_history import age, rewrite
from outside_ci import outside_ci
from questions import QUESTIONS, answered

from fieldcal.batch.closing import close_night
from fieldcal.batch.flights import flights
from fieldcal.batch.night import plan_night, publishings
from fieldcal.batch.outcome import Outcome
from fieldcal.cli.main import run
from fieldcal.provenance.run_key import code_digest
from fieldcal.report.fitness import Criteria
from fieldcal.schemas import HISTORY_TABLES, SIGNAL_TABLES, TABLES, migrations
from fieldcal.schemas.arrow import VERSION_KEY
from fieldcal.schemas.frames import empty_frame
from fieldcal.schemas.migrations import CHANGES, Change, fillings
from fieldcal.simulation.archive import write_flights
from fieldcal.simulation.experiment import Experiment
from fieldcal.warehouse import Warehouse, WarehouseError
from fieldcal.warehouse.layout import history_files, history_path, vehicle_of
from fieldcal.warehouse.publish import publish, read_history
from fieldcal.warehouse.upkeep.upgrade import upgrade
from fieldcal.warehouse.upkeep.verify import verify

OLDER = Path(__file__).parent / "older"
"""`tables/` and their checksums, of two simulated flights of sim-1, named by the commit whose night made them: the
first that had a night, the last before there was one package, and the last before rows told how they were dated."""
MADE_BY = ("185f901", "b07b24e", "5af0435")


def older(commit: str, folder: Path) -> Path:
    """A warehouse as that commit left it."""
    with tarfile.open(OLDER / f"{commit}.tar.xz") as packed:
        packed.extractall(folder, filter="data")
    return folder


def files(root: Path) -> dict[str, bytes]:
    return {str(path.relative_to(root)): path.read_bytes() for path in sorted(root.rglob("*.parquet"))}


def versions(root: Path) -> dict[str, int]:
    return {
        f"{table}/{vehicle_of(path)}": int(pq.read_schema(path).metadata[VERSION_KEY.encode()])
        for table in HISTORY_TABLES
        for path in history_files(root, table)
    }


@pytest.mark.parametrize("commit", MADE_BY)
def test_every_row_and_value_of_an_older_warehouse_stays(commit: str, tmp_path: Path) -> None:
    root = older(commit, tmp_path)
    written = {
        table: pl.from_arrow(pq.read_table(path, partitioning=None))
        for table in HISTORY_TABLES
        for path in history_files(root, table)
    }
    read = {table: Warehouse(root).scan(table).collect() for table in HISTORY_TABLES}
    content = verify(root)["content_sha256"]
    planned = upgrade(root, dry_run=True)
    assert {file["status"] for file in planned["upgraded"]} == {"due"}
    done = upgrade(root)
    assert done["ok"]
    assert [{**file, "status": "due"} for file in done["upgraded"]] == planned["upgraded"]
    assert sum(file["rows"] for file in done["upgraded"]) >= 40
    after = files(root)
    assert set(after) == {f"tables/{table}/vehicle=sim-1/part.parquet" for table in written}
    assert not list(root.rglob("vehicle_id=*"))
    for table, before in written.items():
        assert isinstance(before, pl.DataFrame)
        now = read_history(root, table, "sim-1")
        polars.testing.assert_frame_equal(now.select(before.columns), before)
        polars.testing.assert_frame_equal(now, read[table])
        assert pq.read_schema(history_path(root, table, "sim-1")).metadata[VERSION_KEY.encode()] == (
            str(TABLES[table].version).encode()
        )
    found = verify(root)
    assert found["ok"]
    assert found["content_sha256"] == content
    assert upgrade(root) == {"ok": True, "files": len(written), "upgraded": []}
    assert files(root) == after


@pytest.mark.parametrize("upgraded", [False, True])
@pytest.mark.parametrize("commit", MADE_BY)
def test_all_that_asks_the_history_is_answered(commit: str, upgraded: bool, tmp_path: Path) -> None:
    """Older ones are read without an upgrade too."""
    root = older(commit, tmp_path)
    if upgraded:
        upgrade(root)
    for _, sql, python in QUESTIONS:
        answered(Warehouse(root), sql, python)
    assert Warehouse(root).sql("SELECT count(DISTINCT flight_id) FROM calibration").item() == 2
    for command in ("history --json", "drift --json", "export sim-1"):
        assert run([*command.split(), "--warehouse", str(root)]) == 0, command


@pytest.mark.parametrize("upgraded", [False, True])
def test_a_night_on_top_keeps_what_was_there(upgraded: bool, tmp_path: Path) -> None:
    root = older("185f901", tmp_path / "warehouse")
    if upgraded:
        upgrade(root)
    before = read_history(root, "calibration", "sim-1")
    write_flights(tmp_path / "archive", Experiment(seed=5, duration_s=20.0, sets=1))
    (session,) = (tmp_path / "archive" / "sim-1").iterdir()
    session.rename(session.with_name("2026-03-02"))
    night = plan_night(tmp_path / "archive", root)
    answer = flights(str(root), night.source, [job.plain() for job in night.missing()], code_digest())
    for publishing in publishings(night, [Outcome.of(plain) for plain in answer["outcomes"]]):
        publishing.publish()
    close_night(root, Criteria.of(night.configuration))
    assert verify(root)["ok"]
    flown = Warehouse(root).scan("flight").collect()
    assert flown.height == 3
    after = read_history(root, "calibration", "sim-1").filter(
        pl.col("flight_id").is_in(before["flight_id"].unique().to_list())
    )
    polars.testing.assert_frame_equal(after, before, check_row_order=False)
    assert {path.split("/")[0]: version for path, version in versions(root).items()}.items() <= {
        (table, TABLES[table].version) for table in HISTORY_TABLES
    }


@pytest.mark.parametrize("vehicle_id", ["a", "7", "x" * 500])
def test_folders_of_before_are_read_written_and_renamed(vehicle_id: str, tmp_path: Path) -> None:
    """Whose names engines took for another column of the same name."""
    publish(tmp_path, vehicle_id, flight(vehicle_id, "f1"), ["f1"])
    content = verify(tmp_path)["content_sha256"]
    for folder in [*tmp_path.rglob("vehicle=*")]:
        folder.rename(folder.with_name(folder.name.replace("vehicle=", "vehicle_id=")))
    assert verify(tmp_path)["content_sha256"] == content
    publish(tmp_path, vehicle_id, flight(vehicle_id, "f2"), ["f2"])
    assert set(Warehouse(tmp_path).scan("flight", vehicle_id=vehicle_id).collect()["flight_id"]) == {"f1", "f2"}
    assert not list((tmp_path / "tables" / "flight").glob("vehicle=*"))
    found = verify(tmp_path)
    assert found["ok"]
    assert upgrade(tmp_path)["ok"]
    assert verify(tmp_path) == found
    assert not list(tmp_path.rglob("vehicle_id=*"))
    assert upgrade(tmp_path)["upgraded"] == []


KILLED_AT_EVERY_RENAME = """
import os, shutil, signal, sys
from pathlib import Path
from fieldcal.warehouse.upkeep.upgrade import upgrade
source, folder = map(Path, sys.argv[1:3])
replace = os.replace
for number in range(int(sys.argv[3])):
    root = folder / str(number)
    shutil.copytree(source, root)
    if os.fork():
        os.wait()
        continue
    left = number
    def dying(*paths):
        global left
        if not left:
            os.kill(os.getpid(), signal.SIGKILL)
        left -= 1
        replace(*paths)
    os.replace = dying
    upgrade(root)
    os._exit(0)
"""


@outside_ci
def test_killed_at_any_rename_it_is_finished_by_the_next(tmp_path: Path) -> None:
    """Around every file its record is written before and after."""
    root = older("b07b24e", tmp_path / "warehouse")
    former, content, renames = (
        versions(root),
        verify(root)["content_sha256"],
        4 * len(history_files(root, "flight")) * 5,
    )
    program = [sys.executable, "-c", KILLED_AT_EVERY_RENAME, str(root), str(tmp_path / "killed"), str(renames + 1)]
    subprocess.run(program, check=True, timeout=120)
    upgrade(root)
    states = []
    for number in range(renames + 1):
        killed = tmp_path / "killed" / str(number)
        found = verify(killed)
        assert found["ok"], found["damaged"]
        assert found["content_sha256"] == content
        now = versions(killed)
        states.append(sum(now[path] != former[path] for path in former))
        assert upgrade(killed)["ok"]
        assert files(killed) == files(root)
        assert verify(killed)["ok"]
    assert states == [(number + 2) // 4 for number in range(renames)] + [5]


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Two vehicles, a flight each."""
    for vehicle_id in "ab":
        publish(tmp_path, vehicle_id, flight(vehicle_id, f"{vehicle_id}1"), [f"{vehicle_id}1"])
    return tmp_path


def test_what_cannot_be_upgraded_is_named_and_left(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """One that lacks what no row can do without, one of a newer version, one that is damaged; another is upgraded."""
    hopeless, newer, damaged, fine = (
        history_path(root, table, vehicle_id)
        for table, vehicle_id in (("flight", "a"), ("run", "a"), ("calibration", "a"), ("calibration", "b"))
    )
    age(root, hopeless, "flight", ["verdict"])
    rewrite(root, newer, pq.read_table(newer, partitioning=None), TABLES["run"].version + 1)
    damaged.write_bytes(damaged.read_bytes()[:-1])
    age(root, fine, "calibration", ["sequence"])
    before = files(root)
    assert run(["upgrade", "--warehouse", str(root), "--json"]) == 3
    told = json.loads(capsys.readouterr().out)
    assert not told["ok"]
    assert {(file["path"], file["status"]) for file in told["upgraded"]} == {
        *((str(path.relative_to(root)), "left") for path in (hopeless, newer, damaged)),
        (str(fine.relative_to(root)), "upgraded"),
    }
    after = files(root)
    assert {path for path in after if after[path] != before[path]} == {str(fine.relative_to(root))}
    assert run(["upgrade", "--warehouse", str(root)]) == 3
    said = " ".join(capsys.readouterr().out.split())
    assert "flight of a: left as it is" in said
    assert "missing verdict; schema version 1, this release knows version 2" in said
    assert "schema version 4, this release knows version 3. A newer fieldcal wrote it: update fieldcal" in said
    assert "is damaged" in said


@pytest.mark.parametrize("change", CHANGES, ids=lambda change: f"{change.table}-{change.version}")
def test_a_file_from_before_each_change_is_filled(change: Change, tmp_path: Path) -> None:
    """Without the columns that this change and those after it added."""
    root = older("5af0435", tmp_path)
    upgrade(root)
    path = history_path(root, change.table, "sim-1")
    if change.table == "pooled":  # no night had it then
        constant = {
            "sensor": "gyroscope",
            "parameter": "zero",
            "axis": "x",
            "unit": "rad/s",
            "shares": [1.0],
            "place": 0,
        }
        publish(root, "sim-1", {"pooled": rows("pooled", {**lead("sim-1", "f"), **constant, "status": "ok"})}, ())
    now = read_history(root, change.table, "sim-1")
    young = {
        name: has
        for other in CHANGES
        if other.table == change.table and other.version >= change.version
        for name, has in other.added.items()
    }
    rewrite(root, path, pq.read_table(path, partitioning=None).drop_columns(list(young)), change.version - 1)
    read = {table: Warehouse(root).scan(table).collect() for table in HISTORY_TABLES}
    (told,) = upgrade(root)["upgraded"]
    assert (told["status"], told["from_version"], told["rows"]) == ("upgraded", change.version - 1, now.height)
    filled = {name: pl.col(has) if isinstance(has, str) else pl.lit(has) for name, has in young.items()}
    expected = now.with_columns(value.cast(now.schema[name]).alias(name) for name, value in filled.items())
    polars.testing.assert_frame_equal(pl.read_parquet(path, hive_partitioning=False), expected)
    polars.testing.assert_frame_equal(read[change.table], expected)
    assert verify(root)["ok"]


def test_a_column_that_was_renamed_and_a_type_that_was_widened(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Readers refuse such a file, and say what to do; 7.0 is 7, 7.5 is not."""
    path, version = history_path(root, "flight", "a"), TABLES["flight"].version
    former = pq.read_table(path, partitioning=None)
    former = former.rename_columns(["length_s" if n == "duration_s" else n for n in former.column_names])
    at = former.column_names.index("n_samples")
    for number, status in ((7.5, "left"), (7.0, "upgraded")):
        field = former.schema.field(at).with_type(pa.float64())
        rewrite(root, path, former.set_column(at, field, pa.chunked_array([[number]])), version - 1)
        monkeypatch.setattr(migrations, "CHANGES", (Change("flight", version, {}, {"length_s": "duration_s"}),))
        for read in (Warehouse(root).scan, lambda table: Warehouse(root).sql(f"FROM {table}")):
            with pytest.raises(WarehouseError, match="run `fieldcal upgrade`"):
                read("flight")
        (told,) = upgrade(root)["upgraded"]
        assert told["status"] == status, told["reason"]
    row = Warehouse(root).scan("flight", vehicle_id="a").collect()
    assert row["n_samples"].to_list() == [7]
    assert "length_s" not in row.columns


def test_a_column_that_is_no_longer_is_not_lost(root: Path) -> None:
    path = history_path(root, "flight", "a")
    rows = pq.read_table(path, partitioning=None).append_column("former", pa.array([1.0]))
    rewrite(root, path, rows, TABLES["flight"].version - 1)
    before = path.read_bytes()
    (told,) = upgrade(root)["upgraded"]
    assert (told["status"], path.read_bytes()) == ("left", before)
    assert "would lose what the columns former hold" in str(told["reason"])


@pytest.mark.parametrize(
    "command", ["history", "drift", "export a", "verify", "report", "sql", pytest.param("nightly", marks=outside_ci)]
)
def test_whoever_meets_a_newer_version_says_so(
    command: str, root: Path, tmp_path_factory: pytest.TempPathFactory, capsys: pytest.CaptureFixture[str]
) -> None:
    for table in ("flight", "calibration", "run"):
        path = history_path(root, table, "a")
        rewrite(root, path, pq.read_table(path, partitioning=None), 9)
    rewrite(root, history_path(root, "drift", "a"), empty_frame("drift").to_arrow(), 9)
    archive = tmp_path_factory.mktemp("archive")
    more = {"sql": ["FROM calibration"], "nightly": [str(archive)]}.get(command, [])
    if command == "nightly":
        write_flights(archive, Experiment(seed=5, duration_s=20.0, sets=1))
        (archive / "sim-1").rename(archive / "a")
    assert run([*command.split(), *more, "--warehouse", str(root)]) == 1
    told = capsys.readouterr().err
    assert "schema version 9, this release knows version" in told
    assert "A newer fieldcal wrote it: update fieldcal" in told


def test_every_version_since_the_first_is_declared() -> None:
    """Whoever gives a table a new version says in `schemas/migrations.py` what it changed."""
    first = {table: 2 if table == "drift" else 1 for table in HISTORY_TABLES}  # no night wrote version 1 of drift
    for table in HISTORY_TABLES:
        declared = [change.version for change in CHANGES if change.table == table]
        assert declared == list(range(first[table] + 1, TABLES[table].version + 1)), table
        assert fillings(table).keys() <= {*TABLES[table].column_names}
    assert {TABLES[table].version for table in SIGNAL_TABLES} == {1}, "upgrade does not look at signals"


def test_without_a_warehouse_it_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["upgrade", "--warehouse", str(tmp_path / "nowhere")]) == 1
    assert "There is no warehouse at" in capsys.readouterr().err
    root = older("185f901", tmp_path / "some")
    before = files(root)
    shutil.rmtree(root / "checksums")
    assert run(["upgrade", "--dry-run", "--warehouse", str(root)]) == 3
    assert "no sha256 is recorded for it" in capsys.readouterr().out
    assert files(root) == before
