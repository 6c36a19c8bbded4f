"""A flipped bit, wherever it lies: `verify` finds it, and no reader gives altered numbers."""

from __future__ import annotations

import json
import os
import shutil
from collections import Counter
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from fieldcal.batch.closing import close_night
from fieldcal.batch.flights import flights
from fieldcal.batch.night import plan_night, publishings
from fieldcal.batch.outcome import Outcome
from fieldcal.provenance.run_key import code_digest
from fieldcal.reason_codes import ReasonCode
from fieldcal.report.fitness import Criteria
from fieldcal.simulation.archive import write_flights
from fieldcal.simulation.experiment import Experiment
from fieldcal.warehouse import Warehouse
from fieldcal.warehouse.errors import WarehouseError
from fieldcal.warehouse.layout import checksum_path
from fieldcal.warehouse.publish import read_history
from fieldcal.warehouse.signals import read_signal
from fieldcal.warehouse.stage_store import StageStore
from fieldcal.warehouse.upkeep.verify import verify

FLIPS = 60 if os.environ.get("CI") else 400
PLACES = ("tables", "signals", "stages", "reports", "night", "checksums")


def night(archive: Path, root: Path) -> None:
    """A night without Prefect."""
    planned = plan_night(archive, root)
    missing = [job.plain() for job in planned.missing()]
    outcomes = flights(str(root), planned.source, missing, code_digest())["outcomes"] if missing else []
    for publishing in publishings(planned, [Outcome.of(plain) for plain in outcomes]):
        publishing.publish()
    close_night(root, Criteria.of(planned.configuration))


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A night's warehouse, and the archive beside it."""
    folder = tmp_path_factory.mktemp("flips")
    write_flights(folder / "archive", Experiment(seed=3, duration_s=20.0, sets=1))
    for _ in range(2):
        night(folder / "archive", folder / "warehouse")
    assert verify(folder / "warehouse")["ok"]
    return folder / "warehouse"


def flipped(path: Path, rng: np.random.Generator) -> bytes:
    """The file with one bit turned; what it held."""
    before = path.read_bytes()
    data = bytearray(before)
    data[rng.integers(len(data))] ^= 1 << int(rng.integers(8))
    path.write_bytes(bytes(data))
    return before


def answers(root: Path, path: Path) -> dict[str, pl.DataFrame]:
    """What everybody answers who reads this file, or what its record is about."""
    place, *below = path.relative_to(root).parts
    if place == "checksums":
        place, *below = below
    if place == "stages":
        stage, flight_id, run_key = below[:3]
        store = StageStore(root)
        if store.complete(stage, flight_id, run_key) is None:
            raise WarehouseError(ReasonCode.STAGE_INCOMPLETE, "The stage runs again.")
        return store.load(stage, flight_id, run_key)
    if place not in ("tables", "signals"):
        return {}  # a night holds what it remembers against its digest, and nobody reads reports
    warehouse = Warehouse(root)
    told = {"scan": warehouse.scan(below[0]).collect()}
    if place == "tables":
        told["sql"] = warehouse.sql(f"SELECT * FROM {below[0]} ORDER BY ALL")
        told["history"] = read_history(root, below[0], "sim-1")
    else:
        ids = warehouse.scan("flight").select("vehicle_id", "flight_id").collect().row(0)
        told["signal"] = read_signal(root, below[0], *ids)
    return told


def test_every_flip_is_found_by_verify_and_believed_by_nobody(root: Path) -> None:
    """In every kind of file that is kept, as often in each."""
    kept = {place: [p for p in sorted((root / place).rglob("*")) if p.is_file()] for place in PLACES}
    assert all(kept.values())
    assert any(path.suffix == ".npz" for path in kept["night"])
    rng = np.random.default_rng(17)
    found, refused = Counter[str](), Counter[str]()
    missed, believed = [], []
    for number in range(FLIPS):
        place = PLACES[number % len(PLACES)]
        path = kept[place][int(rng.integers(len(kept[place])))]
        sound = answers(root, path)
        before = flipped(path, rng)
        if verify(root)["ok"]:
            missed.append(path)
        else:
            found[place] += 1
        try:
            told = answers(root, path)
            if told.keys() != sound.keys() or not all(told[name].equals(sound[name]) for name in sound):
                believed.append(path)
        except WarehouseError:
            refused[place] += 1
        path.write_bytes(before)
    print(f"{FLIPS} flips: found {found.total()}, {dict(found)}; refused by readers {dict(refused)}")
    assert (missed, believed) == ([], [])
    assert all(refused[place] == found[place] for place in ("tables", "signals", "stages"))
    assert verify(root)["ok"]


def test_no_night_ends_well_over_a_flip(root: Path, tmp_path: Path) -> None:
    """Nothing is due, so that the night itself reads little. What can be made again is; else the file is named."""
    wanted = (
        "tables/run",
        "checksums/tables/calibration",
        "checksums/signals/imu",
        "drift_evidence",
        "fleet.html.json",
    )
    files = [path.relative_to(root) for place in PLACES for path in sorted((root / place).rglob("*")) if path.is_file()]
    if os.environ.get("CI"):
        files = [path for path in files if any(name in str(path) for name in wanted)]
    content, rng, refused = verify(root)["content_sha256"], np.random.default_rng(6), set()
    for number, path in enumerate(files):
        own = tmp_path / str(number)
        shutil.copytree(root, own)
        flipped(own / path, rng)
        told = None
        try:
            night(root.parent / "archive", own)
        except WarehouseError as error:
            told = error
        if told is not None:
            assert told.reason_code == "damaged_file"
            assert path.name in told.sentence
            refused.add("/".join(path.parts[:-2]))
            continue
        found = verify(own)
        assert (found["damaged"], found["content_sha256"]) == ([], content), path
    assert {"tables/run", "checksums/tables/calibration"} <= refused
    assert all("tables" in place for place in refused)


@pytest.mark.parametrize("table", ["calibration", "flight", "imu"])
def test_no_reader_believes_a_flip(root: Path, table: str) -> None:
    warehouse = Warehouse(root)
    ((flight_id, vehicle_id),) = warehouse.scan("flight").select("flight_id", "vehicle_id").collect().iter_rows()
    (path,) = (root / ("signals" if table == "imu" else "tables") / table).glob("*/*.parquet")
    readers = {"scan": lambda: warehouse.scan(table).collect()}
    if table == "imu":
        readers["signal"] = lambda: read_signal(root, table, vehicle_id, flight_id)
    else:
        readers["sql"] = lambda: warehouse.sql(f"SELECT * FROM {table}")
        readers["history"] = lambda: read_history(root, table, vehicle_id)
    rng = np.random.default_rng(4)
    for _ in range(30):
        before = flipped(path, rng)
        for name, read in readers.items():
            with pytest.raises(WarehouseError, match=path.name) as caught:
                pytest.fail(f"{name} gave {read()}")
            assert caught.value.reason_code == "damaged_file"
        path.write_bytes(before)
    for read in readers.values():
        assert read().height


def test_without_a_record_the_file_is_read_and_a_panic_is_a_sentence(
    root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (path,) = (root / "tables" / "flight").glob("*/*.parquet")
    record = checksum_path(root, path)
    before = record.read_bytes()
    record.write_bytes(b"torn")
    assert Warehouse(root).scan("flight").collect().height == 1
    record.write_bytes(before)

    def panics(*_: object, **__: object) -> None:
        raise pl.exceptions.PanicException("unwrap on None")

    monkeypatch.setattr("fieldcal.warehouse.store.pq.ParquetFile", panics)
    with pytest.raises(WarehouseError, match=r"part\.parquet is damaged \(unwrap on None\)"):
        read_history(root, "flight", path.parent.name.partition("=")[2])


def test_a_report_may_be_deleted(root: Path) -> None:
    for report in (root / "reports").iterdir():
        assert len(json.loads(checksum_path(root, report).read_bytes())["sha256"]) == 2
        report.unlink()
    assert verify(root)["ok"]
