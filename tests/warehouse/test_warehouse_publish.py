"""The history: union of what is published, replaced whole, untouched when nothing changes."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import polars as pl
import pytest
from history_rows import flight, lead, rows

from fieldcal.schemas import SchemaMismatch
from fieldcal.warehouse import checksums
from fieldcal.warehouse.content import content_sha256
from fieldcal.warehouse.errors import WarehouseError
from fieldcal.warehouse.files import file_sha256
from fieldcal.warehouse.layout import checksum_path, history_path
from fieldcal.warehouse.lock import vehicle_lock
from fieldcal.warehouse.publish import publish, read_history
from fieldcal.warehouse.upkeep.verify import verify


def stat_of(root: Path) -> dict[str, tuple[int, int]]:
    return {str(p): (p.stat().st_ino, p.stat().st_mtime_ns) for p in sorted((root / "tables").rglob("*.parquet"))}


def test_flights_add_up_in_order_of_time(tmp_path: Path) -> None:
    assert publish(tmp_path, "v", flight("v", "b", 2), ["b"]) == ("calibration", "run", "flight")
    publish(tmp_path, "v", flight("v", "a", 3), ["a"])
    publish(tmp_path, "v", flight("v", "c", 1), ["c"])
    publish(tmp_path, "v", flight("v", "d", None), ["d"])
    assert read_history(tmp_path, "flight", "v")["flight_id"].to_list() == ["d", "c", "b", "a"]
    assert read_history(tmp_path, "calibration", "v").height == 24
    assert read_history(tmp_path, "sync", "v").is_empty()
    assert not history_path(tmp_path, "sync", "v").exists()
    assert verify(tmp_path)["ok"]


def test_the_order_of_publishing_leaves_no_trace(tmp_path: Path) -> None:
    for root, order in ((tmp_path / "1", "abc"), (tmp_path / "2", "cab")):
        for name in order:
            publish(root, "v", flight("v", name, 1), [name])
    publish(
        tmp_path / "3",
        "v",
        {table: pl.concat([flight("v", name, 1)[table] for name in "bca"]) for table in flight("v", "a")},
        ["a", "b", "c"],
    )
    hashes = {
        tuple(file_sha256(history_path(tmp_path / root, table, "v")) for table in ("flight", "calibration", "run"))
        for root in "123"
    }
    assert len(hashes) == 1


def test_nothing_new_touches_no_file(tmp_path: Path) -> None:
    publish(tmp_path, "v", flight("v", "a"), ["a"])
    publish(tmp_path, "v", flight("v", "b"), ["b"])
    before = stat_of(tmp_path)
    assert publish(tmp_path, "v", flight("v", "a"), ["a"]) == ()
    assert publish(tmp_path, "v", {}, []) == ()
    assert stat_of(tmp_path) == before
    assert publish(tmp_path, "v", flight("v", "a", value=2.0), ["a"]) == ("calibration",)


def test_replaced_flights_lose_rows_that_are_no_longer_made(tmp_path: Path) -> None:
    publish(tmp_path, "v", flight("v", "a"), ["a"])
    publish(tmp_path, "v", flight("v", "b"), ["b"])
    publish(tmp_path, "v", {"flight": flight("v", "a")["flight"]}, ["a"])
    assert set(read_history(tmp_path, "calibration", "v")["flight_id"]) == {"b"}
    assert set(read_history(tmp_path, "flight", "v")["flight_id"]) == {"a", "b"}


def test_drift_is_replaced_as_a_whole(tmp_path: Path) -> None:
    def drift(value: float, *axes: str) -> dict[str, pl.DataFrame]:
        return {
            "drift": rows(
                "drift",
                *(
                    {
                        "vehicle_id": "v",
                        "imu_id": "i",
                        "sensor": "gyroscope",
                        "method": "output_error",
                        "parameter": "zero_bias",
                        "axis": axis,
                        "value_at_25degc": value,
                        "status": "stable",
                    }
                    for axis in axes
                ),
            )
        }

    publish(tmp_path, "v", flight("v", "a"), ["a"])
    assert publish(tmp_path, "v", drift(1.0, "x", "y"), []) == ("drift",)
    assert publish(tmp_path, "v", drift(2.0, "x"), []) == ("drift",)
    assert read_history(tmp_path, "drift", "v")["value_at_25degc"].to_list() == [2.0]
    assert read_history(tmp_path, "flight", "v").height == 1


def test_unknown_numbers_are_null(tmp_path: Path) -> None:
    publish(tmp_path, "v", {"sync": rows("sync", {**lead("v", "a"), "lag_s": float("nan"), "peak": 0.5})}, ["a"])
    assert read_history(tmp_path, "sync", "v")["lag_s"].to_list() == [None]


def test_wrong_rows_are_refused_before_anything_is_written(tmp_path: Path) -> None:
    good = flight("v", "a")
    twice = {**good, "flight": pl.concat([good["flight"], good["flight"]])}
    for bad, flights, sentence in (
        (flight("w", "a"), ["a"], "rows of vehicle 'w'"),
        (good, ["b"], "rows of flight 'a'"),
        ({"samples": good["flight"]}, ["a"], "samples is no table of the history"),
        ({"flight": good["flight"].drop("verdict")}, ["a"], "missing verdict"),
    ):
        with pytest.raises(SchemaMismatch, match=sentence):
            publish(tmp_path, "v", bad, flights)
        assert not (tmp_path / "tables").exists()
    with pytest.raises(SchemaMismatch, match="more than one row with flight_id = a"):
        publish(tmp_path, "v", twice, ["a"])


def test_hostile_vehicle_names_stay_inside_and_come_back(tmp_path: Path) -> None:
    root = tmp_path / "root"
    names = ["../../x", "", ".", "..", "a/b", "ü \U0001f681", "x" * 4000, "nul\0"]
    for name in names:
        publish(root, name, flight(name, "f"), ["f"])
        assert read_history(root, "flight", name)["vehicle_id"].to_list() == [name]
    assert list(tmp_path.iterdir()) == [root]
    assert verify(root)["ok"]


def test_damage_is_never_published_over(tmp_path: Path) -> None:
    publish(tmp_path, "v", flight("v", "a"), ["a"])
    path = history_path(tmp_path, "calibration", "v")
    data = bytearray(path.read_bytes())
    data[100] ^= 1
    path.write_bytes(data)
    with pytest.raises(WarehouseError, match="nothing is published over it") as caught:
        publish(tmp_path, "v", flight("v", "b"), ["b"])
    assert caught.value.reason_code == "damaged_file"
    path.unlink()
    checksum_path(tmp_path, path).unlink()
    publish(tmp_path, "v", flight("v", "a"), ["a"])
    assert verify(tmp_path)["ok"]


@pytest.mark.parametrize("point", ["before the record", "between the renames", "before it is settled", "after all"])
@pytest.mark.parametrize("first", [True, False])
def test_killed_at_any_point_then_again_is_as_if_never_killed(tmp_path: Path, point: str, first: bool) -> None:
    whole, torn = tmp_path / "whole", tmp_path / "torn"
    for root in (whole, torn):
        if not first:
            publish(root, "v", flight("v", "a"), ["a"])
    publish(whole, "v", flight("v", "b", value=3.0), ["b"])
    script = f"""
        import os, signal, sys
        sys.path.insert(0, {str(Path(__file__).parents[1])!r})
        from pathlib import Path
        from history_rows import flight
        from fieldcal.warehouse import checksums, publish
        record, point = checksums.record, {point!r}
        def killed(root, path, allowed):
            ours = path.parts[-3] == "run"
            settled = len(allowed) == 1
            if ours and (point == "before the record" or point == "before it is settled" and settled):
                os.kill(os.getpid(), signal.SIGKILL)
            record(root, path, allowed)
            if ours and (point == "between the renames" or settled):
                os.kill(os.getpid(), signal.SIGKILL)
        checksums.record = killed
        publish.publish(Path({str(torn)!r}), "v", flight("v", "b", value=3.0), ["b"])
    """
    ended = subprocess.run([sys.executable, "-c", textwrap.dedent(script)], check=False)
    assert ended.returncode == -signal.SIGKILL
    report = verify(torn)
    assert report["damaged"] == []
    assert report["content_sha256"] != content_sha256(whole)
    publish(torn, "v", flight("v", "b", value=3.0), ["b"])
    assert verify(torn)["ok"]
    assert content_sha256(torn) == content_sha256(whole)


def test_writers_of_one_vehicle_wait_for_each_other(tmp_path: Path) -> None:
    """Four processes publish twelve flights at once: the union, nothing twice."""
    script = f"""
        import sys
        sys.path.insert(0, {str(Path(__file__).parents[1])!r})
        from pathlib import Path
        from history_rows import flight
        from fieldcal.warehouse.publish import publish
        for number in range(4):
            for name in (f"own-{{sys.argv[1]}}-{{number}}", f"shared-{{number}}"):
                publish(Path({str(tmp_path)!r}), "v", flight("v", name), [name])
    """
    started = [subprocess.Popen([sys.executable, "-c", textwrap.dedent(script), str(n)]) for n in range(3)]
    assert [process.wait() for process in started] == [0, 0, 0]
    found = read_history(tmp_path, "flight", "v")["flight_id"].to_list()
    expected = {f"own-{n}-{k}" for n in range(3) for k in range(4)} | {f"shared-{k}" for k in range(4)}
    assert sorted(found) == sorted(expected)
    assert read_history(tmp_path, "calibration", "v").height == 6 * 16
    assert verify(tmp_path)["ok"]


def test_a_held_lock_is_busy_and_ends_with_its_process(tmp_path: Path) -> None:
    script = f"""
        import time
        from pathlib import Path
        from fieldcal.warehouse.lock import vehicle_lock
        with vehicle_lock(Path({str(tmp_path)!r}), "v"):
            print("held", flush=True)
            time.sleep(60)
    """
    holder = subprocess.Popen([sys.executable, "-c", textwrap.dedent(script)], stdout=subprocess.PIPE, text=True)
    assert holder.stdout is not None
    assert holder.stdout.readline() == "held\n"
    with pytest.raises(WarehouseError, match="another process has been publishing vehicle 'v'") as caught:
        publish(tmp_path, "v", flight("v", "a"), ["a"], timeout_s=0.1)
    assert caught.value.reason_code == "busy"
    with vehicle_lock(tmp_path, "other", timeout_s=0.1):
        pass
    os.kill(holder.pid, signal.SIGKILL)
    holder.wait()
    holder.stdout.close()
    begun = time.monotonic()
    publish(tmp_path, "v", flight("v", "a"), ["a"], timeout_s=5.0)
    assert time.monotonic() - begun < 2.0


def test_an_unwritable_root_is_a_sentence(tmp_path: Path) -> None:
    (tmp_path / "root").write_text("a file")
    with pytest.raises(WarehouseError, match="a file stands where a folder is needed"):
        publish(tmp_path / "root", "v", flight("v", "a"), ["a"])


def test_checksums_accept_what_was_there_before(tmp_path: Path) -> None:
    path = tmp_path / "tables" / "x"
    with checksums.recording(tmp_path, path, "1" * 64):
        assert checksums.problem(tmp_path, path, None) is None
        assert checksums.problem(tmp_path, path, "1" * 64) is None
    assert checksums.problem(tmp_path, path, None) == "it is missing"
    assert checksums.problem(tmp_path, path, "1" * 64) is None
    assert checksums.problem(tmp_path, path, "2" * 64) == "its content is not what was written: the sha256 differs"
    assert checksums.problem(tmp_path, tmp_path / "y", "1") == "no sha256 is recorded for it"
