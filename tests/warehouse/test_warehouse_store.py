"""Parquet files: what is written comes back, whole or not at all, and damage is found."""

from __future__ import annotations

import errno
import os
import signal
import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
import polars as pl
import pyarrow.parquet as pq
import pytest

from fieldcal.schemas import SchemaMismatch
from fieldcal.schemas.frames import empty_frame
from fieldcal.warehouse import store
from fieldcal.warehouse.errors import WarehouseError
from fieldcal.warehouse.files import AtomicFile, file_sha256, remove_abandoned, write_bytes


def imu(n: int, seed: int = 1) -> pl.DataFrame:
    rng = np.random.default_rng(seed)
    axes = [f"{sensor}_{axis}" for sensor in ("gyroscope", "accelerometer") for axis in "xyz"]
    stamps = 1_777_000_000_000_000_000 + np.arange(n) * 2_500_000 + rng.integers(0, 1000, n)
    return pl.DataFrame({"t_ns": stamps, **{axis: rng.integers(0, 4096, n) / 8192 for axis in axes}})


def test_round_trip_with_units_facts_and_checksums(tmp_path: Path) -> None:
    path = tmp_path / "a" / "b" / "imu.parquet"
    frame = imu(1000).with_columns(pl.lit(None, dtype=pl.Float64).alias("accelerometer_z"))
    sha256 = store.write_table(frame, "imu", path, units={"gyroscope": "deg/s"}, metadata={"fieldcal.log": "x.mcap"})
    assert sha256 == file_sha256(path)
    assert store.read_table(path, "imu").equals(frame)
    schema = pq.read_schema(path)
    assert schema.field("gyroscope_x").metadata[b"unit"] == b"deg/s"
    assert b"angular rate" in schema.field("gyroscope_x").metadata[b"meaning"]
    assert store.read_facts(path)["fieldcal.log"] == "x.mcap"
    column = pq.read_metadata(path).row_group(0).column(0)
    assert column.compression == "ZSTD"
    assert "DELTA_BINARY_PACKED" in column.encodings
    assert [name for name in os.listdir(path.parent) if name != path.name] == []


def test_batches_and_one_piece_give_the_same_bytes(tmp_path: Path) -> None:
    frame = imu(300_000)
    whole = store.write_table(frame, "imu", tmp_path / "whole.parquet")
    with store.TableWriter("imu", tmp_path / "parts.parquet") as writer:
        for start in range(0, frame.height, 7777):
            part = frame.slice(start, 7777)
            writer.write({name: part[name].to_numpy() for name in part.columns} if start % 2 else part.to_arrow())
    assert (writer.sha256, writer.n_rows) == (whole, 300_000)
    assert store.read_table(tmp_path / "parts.parquet", "imu").equals(frame)


def test_no_rows_are_a_table_too(tmp_path: Path) -> None:
    for table in ("vps", "calibration"):
        path = tmp_path / f"{table}.parquet"
        store.write_table(empty_frame(table), table, path)
        assert store.read_table(path, table).equals(empty_frame(table))


def test_widths_are_converted_losses_refused(tmp_path: Path) -> None:
    frame = pl.DataFrame({"row": [0, 1], "column": [0, 1], "value": [1.0, 2.0]})
    store.write_table(frame, "covariance", tmp_path / "c.parquet", stage=True)
    assert store.read_table(tmp_path / "c.parquet", "covariance", stage=True)["row"].dtype == pl.Int32
    for bad, sentence in (
        (frame.with_columns(pl.col("row") + 2**40), "cannot be int32"),
        (frame.with_columns(pl.col("row").cast(pl.Float64)), "must be whole numbers"),
        (frame.with_columns(pl.lit(None, pl.Int32).alias("row")), "identifies a row, yet 2 rows have none"),
        (frame.drop("value"), "missing value"),
        (frame.with_columns(pl.lit(1).alias("more")), "not in the table: more"),
    ):
        with pytest.raises(SchemaMismatch, match=sentence):
            store.write_table(bad, "covariance", tmp_path / "bad.parquet", stage=True)
        assert os.listdir(tmp_path) == ["c.parquet"]


def test_another_table_is_not_read(tmp_path: Path) -> None:
    store.write_table(imu(3), "imu", tmp_path / "x.parquet")
    with pytest.raises(WarehouseError, match=r"x\.parquet: this is not the table vps") as caught:
        store.read_table(tmp_path / "x.parquet", "vps")
    assert caught.value.reason_code == "schema_mismatch"


def test_no_flipped_bit_of_the_data_goes_unseen(tmp_path: Path) -> None:
    path = tmp_path / "imu.parquet"
    frame = imu(2000)
    store.write_table(frame, "imu", path)
    whole = path.read_bytes()
    rng = np.random.default_rng(3)
    outcomes = set()
    footer = len(whole) - 8 - int.from_bytes(whole[-8:-4], "little")
    for bit in [*rng.integers(0, len(whole) * 8, 200), *rng.integers(footer * 8, len(whole) * 8, 300)]:
        torn = bytearray(whole)
        torn[bit // 8] ^= 1 << (bit % 8)
        path.write_bytes(torn)
        try:
            outcomes.add(store.read_table(path, "imu").equals(frame))
        except WarehouseError as error:
            outcomes.add(error.reason_code)
    assert outcomes <= {True, "damaged_file", "schema_mismatch"}


@pytest.mark.parametrize("keep", [0, 3, 100, 0.5, 0.99])
def test_torn_files_are_refused_with_a_sentence(tmp_path: Path, keep: float) -> None:
    path = tmp_path / "imu.parquet"
    store.write_table(imu(2000), "imu", path)
    data = path.read_bytes()
    path.write_bytes(data[: int(keep * len(data)) if keep < 1 else int(keep)])
    with pytest.raises(WarehouseError, match="is damaged") as caught:
        store.read_table(path, "imu")
    assert caught.value.reason_code == "damaged_file"


def test_a_missing_file_is_a_sentence(tmp_path: Path) -> None:
    with pytest.raises(WarehouseError, match=r"none\.parquet cannot be read: it is not there"):
        store.read_table(tmp_path / "none.parquet", "imu")


def test_an_error_within_the_block_leaves_what_was_there(tmp_path: Path) -> None:
    path = tmp_path / "imu.parquet"
    before = store.write_table(imu(10), "imu", path)

    def half_way() -> None:
        with store.TableWriter("imu", path) as writer:
            writer.write(imu(1000))
            raise RuntimeError("half-way")

    with pytest.raises(RuntimeError, match="half-way"):
        half_way()
    assert file_sha256(path) == before
    assert os.listdir(tmp_path) == ["imu.parquet"]


@pytest.mark.parametrize(
    ("number", "reason_code"),
    [
        (errno.ENOSPC, "disk_full"),
        (errno.EROFS, "read_only"),
        (errno.EACCES, "permission_denied"),
        (errno.EIO, "disk_error"),
    ],
)
def test_a_disk_that_refuses_is_named_and_loses_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int, reason_code: str
) -> None:
    path = tmp_path / "imu.parquet"
    before = store.write_table(imu(10), "imu", path)

    def refuse(*_: object) -> int:
        raise OSError(number, os.strerror(number))

    with monkeypatch.context() as patched:
        patched.setattr(os, "write", refuse)
        with pytest.raises(WarehouseError, match=r"imu\.parquet cannot be written") as caught:
            store.write_table(imu(5000), "imu", path)
    assert caught.value.reason_code == reason_code
    assert file_sha256(path) == before
    assert os.listdir(tmp_path) == ["imu.parquet"]


def test_a_file_where_a_folder_is_needed(tmp_path: Path) -> None:
    (tmp_path / "signals").write_text("not a folder")
    with pytest.raises(WarehouseError, match="a file stands where a folder is needed"):
        write_bytes(tmp_path / "signals" / "imu" / "x", b"")


def test_killed_between_writing_and_renaming(tmp_path: Path) -> None:
    """The old file stays, the rest is cleared away once its writer is dead."""
    path = tmp_path / "data"
    write_bytes(path, b"old")
    script = f"""
        import os, signal
        from pathlib import Path
        from fieldcal.warehouse.files import write_bytes
        write_bytes(Path({str(path)!r}), b"new", lambda sha256: os.kill(os.getpid(), signal.SIGKILL))
    """
    ended = subprocess.run([sys.executable, "-c", textwrap.dedent(script)], check=False)
    assert ended.returncode == -signal.SIGKILL
    assert path.read_bytes() == b"old"
    (left,) = (name for name in tmp_path.iterdir() if name != path)
    assert remove_abandoned(tmp_path) == 0
    os.utime(left, (0, 0))
    assert remove_abandoned(tmp_path) == 1
    assert list(tmp_path.iterdir()) == [path]


def test_files_being_written_are_not_cleared_away(tmp_path: Path) -> None:
    with AtomicFile(tmp_path / "data") as file:
        file.write(b"x")
        (temporary,) = tmp_path.iterdir()
        os.utime(temporary, (0, 0))
        assert remove_abandoned(tmp_path) == 0
        file.commit()
    assert (tmp_path / "data").read_bytes() == b"x"
    with pytest.raises(ValueError, match="no longer being written"):
        file.write(b"y")


@pytest.mark.skipif(not Path("/proc/self/fd").exists(), reason="names of descriptors are read from /proc")
@pytest.mark.parametrize("durable", [True, False])
def test_files_and_folders_are_forced_to_disk_before_they_count(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, durable: bool
) -> None:
    """File, then its new folders and name; the rename comes after the file's own fsync."""
    done: list[str] = []
    fsync, replace = os.fsync, os.replace

    def seen_fsync(descriptor: int) -> None:
        done.append("fsync " + os.readlink(f"/proc/self/fd/{descriptor}").rpartition("/")[2].rpartition(".")[2])
        fsync(descriptor)

    def seen_replace(source: Path, target: Path) -> None:
        done.append("rename")
        replace(source, target)

    monkeypatch.setattr(os, "fsync", seen_fsync)
    monkeypatch.setattr(os, "replace", seen_replace)
    write_bytes(tmp_path / "new" / "data", b"x", durable=durable)
    parent = f"fsync {tmp_path.name}"
    assert done == ([parent, "fsync tmp", "rename", "fsync new"] if durable else ["rename"])


@pytest.mark.skipif(not Path("/proc/self").is_dir(), reason="counts threads")
def test_a_small_table_is_read_without_threads(tmp_path: Path) -> None:
    """Some processes that ended just after such a read were aborted: exit code 134 behind a good answer."""
    path = tmp_path / "part.parquet"
    store.write_table(empty_frame("flight"), "flight", path)
    program = """
import os, sys
from pathlib import Path
from fieldcal.warehouse.store import read_arrow
before = set(os.listdir("/proc/self/task"))
read_arrow(Path(sys.argv[1]), "flight")
print(len(set(os.listdir("/proc/self/task")) - before))
"""
    told = subprocess.run([sys.executable, "-c", program, str(path)], check=True, capture_output=True, text=True)
    assert told.stdout == "0\n"
