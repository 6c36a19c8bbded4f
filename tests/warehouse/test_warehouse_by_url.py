"""A warehouse by URL: what one machine publishes the others see, whole, whoever writes, dies or removes garbage."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import textwrap
import time
import uuid
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from functools import partial
from pathlib import Path

import numpy as np
import obstore
import polars as pl
import pytest
from history_rows import START, flight, rows
from object_store import KEYS, asking_for_credentials, keys, machine, running_store
from obstore.store import from_url

import fieldcal
from fieldcal.cli.main import run
from fieldcal.reason_codes import ReasonCode
from fieldcal.remote.url import RemoteError
from fieldcal.warehouse import checksums
from fieldcal.warehouse.content import content_sha256
from fieldcal.warehouse.errors import WarehouseError
from fieldcal.warehouse.files import write_bytes
from fieldcal.warehouse.publish import append, publish, read_history
from fieldcal.warehouse.query import Warehouse
from fieldcal.warehouse.remote import turn
from fieldcal.warehouse.remote.garbage import garbage
from fieldcal.warehouse.remote.heads import GRACE, Head
from fieldcal.warehouse.remote.share import share
from fieldcal.warehouse.remote.turn import in_turn
from fieldcal.warehouse.sealed import seal
from fieldcal.warehouse.signals import read_signal, signal_writer
from fieldcal.warehouse.upkeep.prune import of_vehicle, remove
from fieldcal.warehouse.upkeep.verify import verify

ROUNDS = 3 if os.environ.get("CI") else 25
"""Of each of four writers."""
WITHDRAWN = {"flight_id": "a", "decided_at": START, "decision": "withdraw", "reason": "r", "author": "n"}
WRITER = textwrap.dedent(
    """
    import sys
    sys.path.insert(0, sys.argv[1])
    from history_rows import flight
    from fieldcal.warehouse.publish import publish
    from fieldcal.warehouse.query import Warehouse
    root = Warehouse(sys.argv[2]).root
    for i in range(int(sys.argv[4])):
        name = f"{sys.argv[3]}-{i:02}"
        publish(root, "v", flight("v", name, i), [name])
        print(name, flush=True)
    """
)


@pytest.fixture(scope="module")
def address() -> Iterator[str]:
    with running_store() as address:
        yield address


@pytest.fixture
def url(address: str) -> str:
    return f"s3://warehouse/{uuid.uuid4().hex}"


def published(url: str, vehicle_id: str, *names: str) -> Path:
    """Publish flights from this machine, and let others see them."""
    root = Warehouse(url).root
    for name in names:
        publish(root, vehicle_id, flight(vehicle_id, name), [name])
    share(root)
    return root


def flights(url: str) -> list[str]:
    return Warehouse(url).scan("flight").sort("flight_id").collect()["flight_id"].to_list()


def writer(url: str, cache: Path, name: str, rounds: int = ROUNDS) -> subprocess.Popen[str]:
    command = [sys.executable, "-c", WRITER, str(Path(__file__).parents[1]), url, name, str(rounds)]
    environment = {**os.environ, "FIELDCAL_CACHE_DIR": str(cache / name)}
    return subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True)


def test_what_one_machine_publishes_the_others_have(url: str, tmp_path: Path) -> None:
    for vehicle in ("v", "ä/.."):
        publish(tmp_path / "here", vehicle, flight(vehicle, f"a of {vehicle}"), [f"a of {vehicle}"])
    with machine(tmp_path / "1"):
        for vehicle in ("v", "ä/.."):
            root = published(url, vehicle, f"a of {vehicle}")
        assert verify(root)["ok"]
    with machine(tmp_path / "2"):
        other = Warehouse(url)
        assert other.scan("flight").collect()["vehicle_id"].sort().to_list() == ["v", "ä/.."]
        assert other.sql("SELECT count(*) AS n FROM calibration").item() == 12
        found = verify(other.root)
        assert found["ok"]
        assert found["content_sha256"] == content_sha256(tmp_path / "here")


def test_nothing_is_fetched_again_that_did_not_change(
    url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with machine(tmp_path):
        published(url, "v", "a")
        published(url, "w", "b")
        fetched: list[str] = []
        real = obstore.get
        monkeypatch.setattr(obstore, "get", lambda store, key: fetched.append(key) or real(store, key))
        assert flights(url) == ["a", "b"]
        assert fetched == []


def test_a_plain_glob_over_the_live_files_counts_no_row_twice(url: str, address: str, tmp_path: Path) -> None:
    with machine(tmp_path):
        published(url, "v", "a")
        published(url, "v", "b")
        published(url, "w", "c")
    options = {"aws_endpoint_url": address, "aws_allow_http": "true", "aws_region": "us-east-1"}
    credentials = {name.lower(): KEYS[name] for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY")}
    live = pl.scan_parquet(f"{url}/tables/flight/**/*.parquet", storage_options=options | credentials)
    assert live.collect()["flight_id"].sort().to_list() == ["a", "b", "c"]
    assert len(keys(url, "objects")) > len(keys(url, "tables"))


def test_who_is_slower_publishes_on_top_of_who_was_faster(url: str, tmp_path: Path) -> None:
    tried = []
    with machine(tmp_path / "1"):
        root = published(url, "v", "a")
        path = root / "tables" / "sync" / "vehicle=v" / "part.parquet"

        def change() -> None:
            if not tried:
                with machine(tmp_path / "2"):
                    published(url, "v", "b")
            tried.append(read_history(root, "flight", "v")["flight_id"].to_list())
            write_bytes(path, b"of this machine", partial(checksums.recording, root, path))

        in_turn(root, "v", change)
    assert tried == [["a"], ["a", "b"]]


def test_a_write_whose_answer_was_lost_is_not_done_twice(
    url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with machine(tmp_path):
        root = published(url, "v", "a")
        real = turn.Objects.swap
        monkeypatch.setattr(turn.Objects, "swap", lambda *given: real(*given) and None)
        append(root, "v", "decision", rows("decision", {"vehicle_id": "v", **WITHDRAWN}))
        assert Warehouse(url).scan("decision").collect().height == 1


def test_four_writers_lose_nothing(url: str, tmp_path: Path) -> None:
    writers = [writer(url, tmp_path, name) for name in "abcd"]
    assert [one.wait(300) for one in writers] == [0, 0, 0, 0]
    with machine(tmp_path / "reader"):
        assert flights(url) == sorted(f"{name}-{i:02}" for name in "abcd" for i in range(ROUNDS))
        share(Warehouse(url).root)
        assert verify(Warehouse(url).root)["ok"]


def test_a_writer_that_is_killed_leaves_what_it_had_published(url: str, tmp_path: Path) -> None:
    victim, other = writer(url, tmp_path, "a", 100), writer(url, tmp_path, "b", 3)
    assert victim.stdout is not None
    said = [victim.stdout.readline().strip() for _ in range(3)]
    time.sleep(float(np.random.default_rng().uniform(0.0, 0.1)))
    victim.send_signal(signal.SIGKILL)
    victim.wait()
    assert other.wait(120) == 0
    with machine(tmp_path / "reader"):
        found = flights(url)
        assert set(found) >= {*said, "b-00", "b-01", "b-02"}
        assert verify(published(url, "w", "after"))["ok"]
    assert writer(url, tmp_path, "a", 2).wait(120) == 0  # its own copy is behind, or ahead of the head
    with machine(tmp_path / "reader"):
        assert verify(published(url, "w", "at last"))["ok"]


def test_an_upload_that_is_not_named_is_not_seen(url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with machine(tmp_path / "1"):
        published(url, "v", "a")
        root = Warehouse(url).root
        with monkeypatch.context() as patch:
            patch.setattr(turn.Objects, "swap", _interrupted)
            with pytest.raises(KeyboardInterrupt):
                publish(root, "v", flight("v", "b"), ["b"])
        assert flights(url) == ["a"]  # its own copy was ahead
    with machine(tmp_path / "2"):
        assert flights(url) == ["a"]
        assert verify(Warehouse(url).root)["ok"]


def test_an_object_that_was_cut_short_is_told(url: str, tmp_path: Path) -> None:
    with machine(tmp_path / "1"):
        published(url, "v", "a")
    store, key = from_url(url), next(key for key in keys(url, "objects"))
    obstore.put(store, key, bytes(obstore.get(store, key).bytes())[:-10])
    with machine(tmp_path / "2"), pytest.raises(WarehouseError, match=rf"{key} is damaged") as told:
        Warehouse(url)
    assert told.value.reason_code == ReasonCode.DAMAGED_FILE
    with machine(tmp_path / "1"):
        damaged = verify(Warehouse(url).root)["damaged"]
        assert [one["path"] for one in damaged] == [key]


@pytest.mark.parametrize("head", [b"{}", b"", seal(Head("other").plain())])
def test_a_head_that_is_none_is_told(url: str, tmp_path: Path, head: bytes) -> None:
    obstore.put(from_url(url), "heads/v.json", head)
    with machine(tmp_path), pytest.raises(WarehouseError, match=rf"{url}/heads/v.json is") as told:
        Warehouse(url)
    assert told.value.reason_code == ReasonCode.DAMAGED_FILE


def test_readings_go_along_and_come_when_they_are_asked_for(url: str, tmp_path: Path) -> None:
    with machine(tmp_path / "1"):
        root = Warehouse(url).root
        for name, height in (("a", 3), ("b", 4)):
            with signal_writer(root, "temperature", "v", name) as signals:
                signals.write({"t_ns": np.arange(height, dtype=np.int64), "temperature_degc": np.arange(float(height))})
            publish(root, "v", flight("v", name), [name])
    with machine(tmp_path / "2"):
        other = Warehouse(url)
        assert not (other.root / "signals").exists()
        assert read_signal(other.root, "temperature", "v", "b").height == 4
        assert len(list((other.root / "signals").rglob("*.parquet"))) == 1
        assert other.scan("temperature").collect().height == 7
        with signal_writer(other.root, "temperature", "v", "a") as signals:
            signals.write({"t_ns": np.arange(5, dtype=np.int64), "temperature_degc": np.arange(5.0)})
        publish(other.root, "v", flight("v", "a", value=2.0), ["a"])
        share(other.root)
        assert verify(other.root)["ok"]
    with machine(tmp_path / "1"):
        assert Warehouse(url).scan("temperature", flight_id="a").collect().height == 5


def test_garbage_goes_after_the_grace_and_nothing_else(url: str, tmp_path: Path) -> None:
    with machine(tmp_path):
        root = published(url, "v", "a")
        published(url, "v", "b")
        assert garbage(root).files == ()
        later = datetime.now(UTC) + GRACE + timedelta(minutes=1)
        found = garbage(root, later)
        assert len(found.files) == 3
        found.remove()
        assert verify(root)["ok"]
        assert len(keys(url, "objects")) == 3
    with machine(tmp_path / "2"):
        assert flights(url) == ["a", "b"]


def test_a_vehicle_that_is_removed_is_gone_for_all(url: str, tmp_path: Path) -> None:
    with machine(tmp_path / "2"):
        published(url, "v", "a")
        published(url, "w", "b")
    with machine(tmp_path / "1"):
        root = Warehouse(url).root
        remove(root, of_vehicle(root, "v"))
    with machine(tmp_path / "2"):
        assert flights(url) == ["b"]
    assert not [key for key in keys(url, "tables") if "vehicle=v" in key]


def test_what_was_removed_from_a_copy_is_fetched_anew(url: str, tmp_path: Path) -> None:
    with machine(tmp_path):
        root = published(url, "v", "a")
        path = root / "tables" / "calibration" / "vehicle=v" / "part.parquet"
        data = bytearray(path.read_bytes())
        data[100] ^= 1
        path.write_bytes(bytes(data))
        with pytest.raises(WarehouseError, match=f"Remove it: it is a copy of what lies at {url}"):
            Warehouse(url).scan("calibration")
        path.unlink()
        assert Warehouse(url).scan("calibration").collect().height == 6
        assert verify(root)["ok"]


def test_a_copy_that_is_damaged_is_not_published(url: str, tmp_path: Path) -> None:
    with machine(tmp_path / "1"):
        root = published(url, "v", "a")
        path = root / "tables" / "run" / "vehicle=v" / "part.parquet"
        data = bytearray(path.read_bytes())
        data[100] ^= 1
        path.write_bytes(bytes(data))
        with pytest.raises(WarehouseError, match=r"run/vehicle=v/part\.parquet is damaged"):
            append(root, "v", "decision", rows("decision", {"vehicle_id": "v", **WITHDRAWN}))
    with machine(tmp_path / "2"):
        assert verify(Warehouse(url).root)["ok"]
        assert Warehouse(url).scan("decision").collect().is_empty()


def test_where_nothing_was_published_there_is_no_warehouse(url: str, tmp_path: Path) -> None:
    with machine(tmp_path), pytest.raises(WarehouseError, match=f"There is no warehouse at {url};"):
        fieldcal.Warehouse(url).history()


def test_wrong_credentials_are_one_sentence(url: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with machine(tmp_path), asking_for_credentials():
        assert run(["history", "--warehouse", url]) == 1
    told = capsys.readouterr().err.splitlines()
    assert len(told) == 1
    assert f"{url}: the store refuses access (InvalidAccessKeyId): check the credentials" in told[0]


@pytest.mark.parametrize(
    ("place", "told"),
    [
        ("s3://nobodys/fleet", "s3://nobodys/fleet: there is no such bucket"),
        ("ftp://warehouse/fleet", "no place for logs or results"),
        ("s3://key:secret@warehouse/fleet", "s3://warehouse/fleet: a URL holds no credentials"),
        ("s3://warehouse/fleet?token=secret", "s3://warehouse/fleet: a URL holds no credentials"),
    ],
)
def test_a_url_that_cannot_be_is_one_sentence(address: str, tmp_path: Path, place: str, told: str) -> None:
    with machine(tmp_path), pytest.raises(RemoteError) as error:
        Warehouse(place)
    assert told in error.value.sentence
    assert "secret" not in error.value.sentence


def test_a_store_that_does_not_answer_is_one_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in {**KEYS, "AWS_ENDPOINT_URL": "http://127.0.0.1:9"}.items():
        monkeypatch.setenv(name, value)
    with machine(tmp_path), pytest.raises(RemoteError, match="cannot be reached"):
        Warehouse("s3://warehouse/unreachable")


def test_without_the_library_the_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [name for name in sys.modules if name.partition(".")[0] == "obstore"]:
        monkeypatch.setitem(sys.modules, name, None)
    with machine(tmp_path), pytest.raises(RemoteError, match=r'pip install "fieldcal\[remote\]"'):
        Warehouse("s3://warehouse/without-library")


def _interrupted(*given: object) -> None:
    raise KeyboardInterrupt
