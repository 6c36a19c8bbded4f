"""Archives by URL: what is listed has its place, what is read is fetched once, and what nobody reads makes room."""

from __future__ import annotations

import hashlib
import os
import uuid
from collections.abc import Iterator
from pathlib import Path

import obstore
import pytest
from object_store import keys, machine, running_store, upload
from obstore.store import from_url

from fieldcal.batch.jobs import find_jobs
from fieldcal.config.configuration import parse
from fieldcal.errors import FieldcalError
from fieldcal.flight.job import file_stamp
from fieldcal.logs import find_logs
from fieldcal.reason_codes import ReasonCode
from fieldcal.remote import content
from fieldcal.remote.archive import local_archive
from fieldcal.remote.cache import GIGABYTES
from fieldcal.remote.content import here
from fieldcal.remote.objects import Objects
from fieldcal.remote.places import log_at, session_at

LOG = "v/monday/flight.csv"


@pytest.fixture(scope="module")
def address() -> Iterator[str]:
    with running_store() as address:
        yield address


@pytest.fixture
def url(address: str, tmp_path: Path) -> Iterator[str]:
    """An archive of two logs of one session, one of them a folder, on a machine of its own."""
    url = f"s3://logs/{uuid.uuid4().hex}"
    put(url, LOG, b"t,gx\n")
    put(url, "v/monday/other/imu.csv", b"t,gy\n")
    put(url, "fieldcal.toml", b"[defaults]\nprofile = 'full'\n")
    with machine(tmp_path / "cache"):
        yield url


@pytest.fixture
def fetched(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Keys whose content was fetched."""
    found: list[str] = []
    real = Objects.fetch

    def fetch(self: Objects, key: str, path: Path) -> object:
        found.append(key)
        return real(self, key, path)

    monkeypatch.setattr(content.Objects, "fetch", fetch)
    return found


def put(url: str, key: str, data: bytes) -> None:
    obstore.put(from_url(url), key, data)


def held(archive: Path) -> list[str]:
    """Logs whose content is there."""
    files = sorted(path for path in archive.rglob("*.csv") if path.stat().st_mode & 0o400)
    return [path.relative_to(archive).as_posix() for path in files]


def jobs(archive: Path, ledger: dict[str, tuple[tuple[int, ...], str]] | None = None) -> dict[str, str | None]:
    return {job.log_uri: job.sha256 for job in find_jobs(archive, parse("", None), None, ledger)}


def test_logs_are_found_by_their_names_and_fetched_when_they_are_read(url: str, fetched: list[str]) -> None:
    archive = local_archive(url)
    assert [log.log_uri for log in find_logs(archive)] == [LOG, "v/monday/other"]
    assert (archive / "fieldcal.toml").read_bytes().startswith(b"[defaults]")
    assert fetched == ["fieldcal.toml"]
    assert jobs(archive)[LOG] == hashlib.sha256(b"t,gx\n").hexdigest()
    assert sorted(fetched) == ["fieldcal.toml", LOG, "v/monday/other/imu.csv"]
    jobs(local_archive(url))
    assert len(fetched) == 3


def test_a_log_is_known_again_without_its_content(url: str, tmp_path: Path, fetched: list[str]) -> None:
    archive = local_archive(url)
    known = {job.path: (tuple(job.stamp), str(job.sha256)) for job in find_jobs(archive, parse("", None))}
    with machine(tmp_path / "another"):
        other = local_archive(url)
        fetched.clear()
        moved = {path.replace(str(archive), str(other)): seen for path, seen in known.items()}
        assert jobs(other, moved) == jobs(archive, known)
        assert fetched == []


def test_an_object_that_was_replaced_is_another_log(url: str) -> None:
    archive = local_archive(url)
    before, first = file_stamp(archive / LOG), jobs(archive)
    put(url, LOG, b"t,gz\n")
    put(url, "v/tuesday/third.csv", b"t\n")
    obstore.delete(from_url(url), "v/monday/other/imu.csv")
    local_archive(url)
    assert file_stamp(archive / LOG) != before
    now = jobs(archive)
    assert now[LOG] != first[LOG]
    assert list(now) == [LOG, "v/tuesday/third.csv"]


def test_an_object_that_is_replaced_after_it_was_listed_is_told(url: str) -> None:
    archive = local_archive(url)
    put(url, LOG, b"t,gz\n1,2\n")
    (job, _) = find_jobs(archive, parse("", None))
    assert job.sha256 is None
    assert job.problem is not None
    assert f"{url}/{LOG} was replaced or removed" in job.problem


def test_one_that_is_replaced_while_it_is_in_use_is_told(url: str) -> None:
    archive = local_archive(url)

    def read() -> None:
        with here(archive / LOG):
            put(url, LOG, b"t,gz\n1,2\n")
            local_archive(url)

    with pytest.raises(FieldcalError) as told:
        read()
    assert told.value.reason_code == ReasonCode.CHANGED_WHILE_READ


def test_what_was_used_longest_ago_makes_room(url: str, fetched: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    archive, other = local_archive(url), "v/monday/other/imu.csv"
    monkeypatch.setenv(GIGABYTES, "0")
    with here(archive / LOG):
        pass
    with here(archive / other):
        assert held(archive) == [other]
        with here(archive / LOG):
            assert held(archive) == [LOG, other]  # which is in use
    assert fetched.count(LOG) == 2
    assert file_stamp(archive / LOG)[0] == len(b"t,gx\n")


def test_keys_that_are_no_places_stay_out(url: str, tmp_path: Path) -> None:
    for key in (".hidden/a.csv", "v/monday/.b.csv", f"v/monday/{'l' * 256}.csv"):
        put(url, key, b"t\n")
    put(url, "v/monday", b"an object where a folder is")
    archive = local_archive(url)
    assert [log.log_uri for log in find_logs(archive)] == [LOG, "v/monday/other"]
    assert not list(tmp_path.rglob("*.hidden"))
    assert not list(archive.rglob("l" * 200 + "*"))


def test_a_session_and_a_log_are_named_by_their_urls(url: str) -> None:
    archive, session = session_at(f"{url}/v/monday")
    assert session == archive / "v" / "monday"
    assert log_at(f"{url}/{LOG}").read_bytes() == b"t,gx\n"
    for wrong, told in ((f"{url}/v/sunday", "no session folder"), ("s3://logs", "names no session")):
        with pytest.raises(FieldcalError, match=told):
            session_at(wrong)
    with pytest.raises(FieldcalError, match="There is no log at"):
        log_at(f"{url}/v/monday/none.csv")


def test_where_nothing_lies_there_is_no_archive(url: str) -> None:
    with pytest.raises(FieldcalError, match=f"There is no archive at {url}/nothing"):
        local_archive(f"{url}/nothing")


def test_copies_are_for_their_owner_alone(url: str) -> None:
    archive = local_archive(url)
    for folder in (archive, archive.parent):
        assert os.stat(folder).st_mode & 0o077 == 0


def test_uploads_come_whole(url: str, tmp_path: Path) -> None:
    (tmp_path / "more" / "v" / "s").mkdir(parents=True)
    (tmp_path / "more" / "v" / "s" / "ü a%b.csv").write_bytes(b"x" * 100_000)
    upload(tmp_path / "more", url)
    archive = local_archive(url)
    assert "v/s/ü a%b.csv" in keys(url)
    with here(archive / "v/s/ü a%b.csv"):
        assert (archive / "v/s/ü a%b.csv").read_bytes() == b"x" * 100_000
