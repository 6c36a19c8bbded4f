"""`verify` finds what changed; the content hash says when two warehouses say the same."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from history_rows import flight

from fieldcal import schemas
from fieldcal.warehouse import store
from fieldcal.warehouse.content import content_sha256, rows_sha256
from fieldcal.warehouse.errors import WarehouseError
from fieldcal.warehouse.layout import checksum_path, history_path, signal_path
from fieldcal.warehouse.publish import publish
from fieldcal.warehouse.signals import signal_writer
from fieldcal.warehouse.stage_store import StageStore
from fieldcal.warehouse.upkeep.verify import verify


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """A small warehouse: two flights' history, one signal, one stage."""
    root = tmp_path / "root"
    for name in "ab":
        publish(root, "v", flight("v", name), [name])
    position = {name: np.arange(50.0) for name in ("latitude_deg", "longitude_deg", "altitude_m")}
    with signal_writer(root, "position", "v", "a") as writer:
        writer.write({"t_ns": np.arange(50), **position})
    side = np.arange(1600)  # too many to lie in the record
    cells = pl.DataFrame({"row": side // 40, "column": side % 40, "value": np.random.default_rng(1).normal(size=1600)})
    StageStore(root).save("gyro_equation", "a", "k", {"covariance": cells}, {"status": "ok"})
    return root


def sha256_of(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def test_a_whole_warehouse_is_ok(root: Path) -> None:
    report = verify(root)
    assert report == {"ok": True, "files": 6, "damaged": [], "content_sha256": content_sha256(root)}


def test_any_flipped_bit_of_any_kept_file_is_found(root: Path) -> None:
    kept = [path for path in root.rglob("*") if path.suffix in (".parquet", ".json")]
    assert len(kept) == 3 + 1 + 4 + 2
    rng = np.random.default_rng(5)
    for path in kept:
        whole = path.read_bytes()
        for bit in rng.integers(0, len(whole) * 8, 12):
            changed = bytearray(whole)
            changed[bit // 8] ^= 1 << (bit % 8)
            path.write_bytes(changed)
            report = verify(root)
            assert not report["ok"], (path, bit)
            assert len(report["damaged"]) == 1
        path.write_bytes(whole)
    assert verify(root)["ok"]


def test_400_flips_of_single_bits_are_found_400_times(root: Path) -> None:
    kept = sorted(path for path in root.rglob("*") if path.suffix in (".parquet", ".json"))
    ends = np.cumsum([path.stat().st_size * 8 for path in kept])
    found = 0
    for bit in np.random.default_rng(400).integers(0, ends[-1], 400).tolist():
        number = int(np.searchsorted(ends, bit, side="right"))
        path, inside = kept[number], bit - (int(ends[number - 1]) if number else 0)
        whole = path.read_bytes()
        changed = bytearray(whole)
        changed[inside // 8] ^= 1 << (inside % 8)
        path.write_bytes(changed)
        (damage,) = verify(root)["damaged"]
        # A flipped record of a checksum is told by the name of the file whose checksum it is.
        found += Path(damage["path"]).name.split(".")[0] == path.name.split(".")[0]
        path.write_bytes(whole)
    assert found == 400
    assert verify(root)["ok"]


def test_missing_and_foreign_files_are_named(root: Path) -> None:
    signal_path(root, "position", "v", "a").unlink()
    (root / "tables" / "flight" / "vehicle=v" / "copy.parquet").write_bytes(b"x")
    reasons = {Path(item["path"]).name: item["reason"] for item in verify(root)["damaged"]}
    assert reasons == {"a.parquet": "it is missing", "copy.parquet": "no sha256 is recorded for it"}


def test_a_missing_stage_output_is_named_an_unfinished_or_deleted_stage_is_not(root: Path) -> None:
    folder = StageStore(root).folder("gyro_equation", "a", "k")
    (folder / "covariance.parquet").unlink()
    assert [item["reason"] for item in verify(root)["damaged"]] == ["it is missing"]
    (folder / "run.json").unlink()
    assert verify(root)["ok"]
    folder.rmdir()
    assert verify(root)["ok"]


def test_a_lost_record_is_named(root: Path) -> None:
    checksum_path(root, history_path(root, "run", "v")).unlink()
    assert [item["reason"] for item in verify(root)["damaged"]] == ["no sha256 is recorded for it"]


def test_leftovers_of_killed_writers_are_no_damage(root: Path) -> None:
    (root / "tables" / "flight" / "vehicle=v" / ".0123.tmp").write_bytes(b"half")
    assert verify(root)["ok"]


def test_logs_are_compared_with_the_archive(root: Path, tmp_path: Path) -> None:
    archive = tmp_path / "archive"
    session = archive / "v" / "spring"
    session.mkdir(parents=True)
    (session / "a.mcap").write_bytes(b"log a")
    rows = flight("v", "a")["flight"].with_columns(pl.lit(sha256_of(session / "a.mcap")).alias("log_sha256"))
    publish(root, "v", {**flight("v", "a"), "flight": rows}, ["a"])
    report = verify(root, archive, sha256_of)
    assert report["damaged"] == [{"path": "v/spring/b.mcap", "reason": "the log is no longer in the archive"}]
    (session / "a.mcap").write_bytes(b"log A")
    reasons = [item["reason"] for item in verify(root, archive, sha256_of)["damaged"]]
    assert reasons[0] == "the log is not the one that was calibrated: its sha256 differs"
    with pytest.raises(ValueError, match="log_sha256 is needed"):
        verify(root, archive)


def test_no_warehouse_is_a_sentence(tmp_path: Path) -> None:
    with pytest.raises(WarehouseError, match="There is no warehouse at"):
        verify(tmp_path / "none")


def test_content_hash_ignores_layout_order_and_provenance(root: Path) -> None:
    before = content_sha256(root)
    path = history_path(root, "calibration", "v")
    rows = store.read_table(path, "calibration")
    shuffled = rows.sample(fraction=1.0, shuffle=True, seed=1)
    store.write_table(shuffled.head(5), "calibration", path)
    store.write_table(shuffled.tail(-5), "calibration", path.with_name("more.parquet"))
    assert content_sha256(root) == before
    other = {**flight("v", "a"), "run": flight("v", "a")["run"].with_columns(pl.lit("other").alias("run_key"))}
    assert rows_sha256(other["run"], "run") == rows_sha256(flight("v", "a")["run"], "run")


def test_content_hash_sees_every_other_value(root: Path) -> None:
    for table in ("flight", "calibration", "run"):
        rows = flight("v", "a")[table]
        before = rows_sha256(rows, table)
        for column in schemas.TABLES[table].columns:
            if column.provenance:
                continue
            series = rows[column.name]
            if series.dtype == pl.String:
                changed = series.fill_null("") + "x"
            elif series.dtype == pl.Boolean:
                changed = ~series
            elif series.dtype.is_numeric():
                changed = series.fill_null(0) + 1
            else:
                changed = series.dt.offset_by("1us")
            assert rows_sha256(rows.with_columns(changed), table) != before, column.name
            assert rows_sha256(rows.head(rows.height - 1), table) != before


def test_content_hash_reads_json_by_meaning() -> None:
    rows = flight("v", "a")["run"]
    spelled, other = (rows.with_columns(pl.lit(text).alias("measured")) for text in ('{"b":1, "a":2}', '{"a":2,"b":2}'))
    same = rows.with_columns(pl.lit('{"a": 2, "b": 1}').alias("measured"))
    assert rows_sha256(spelled, "run") == rows_sha256(same, "run")
    assert rows_sha256(other, "run") != rows_sha256(same, "run")
