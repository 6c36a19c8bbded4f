"""An object store for tests: moto's server in a thread, reached as any other by what the environment says; and
machines, which share nothing but that store."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from urllib.request import Request, urlopen

import boto3
import moto.settings
import obstore
import pytest
from moto.server import ThreadedMotoServer
from obstore.store import from_url

from fieldcal.remote import objects
from fieldcal.remote.cache import FOLDER

KEYS = {
    "AWS_ACCESS_KEY_ID": "test",
    "AWS_SECRET_ACCESS_KEY": "test",
    "AWS_REGION": "us-east-1",
    "AWS_ALLOW_HTTP": "true",
}
BUCKETS = ("logs", "warehouse")


@contextmanager
def running_store() -> Iterator[str]:
    """A store with the `BUCKETS`, empty; its address. What reaches it stands in the environment during the block."""
    logging.getLogger("werkzeug").setLevel(logging.ERROR)
    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    _, port = server.get_host_and_port()
    address = f"http://127.0.0.1:{port}"
    objects.opened.cache_clear()  # of another server
    with pytest.MonkeyPatch.context() as patch:
        for name, value in {**KEYS, "AWS_ENDPOINT_URL": address}.items():
            patch.setenv(name, value)
        # What an earlier server of this process held is still there: moto keeps it in the process, not in the server.
        urlopen(Request(f"{address}/moto-api/reset", method="POST")).close()
        client = boto3.client("s3", endpoint_url=address, region_name="us-east-1")
        for bucket in BUCKETS:
            client.create_bucket(Bucket=bucket)
        yield address
    server.stop()


@contextmanager
def asking_for_credentials() -> Iterator[None]:
    """The store knows nobody during the block."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(moto.settings, "INITIAL_NO_AUTH_ACTION_COUNT", 0.0)
        yield


@contextmanager
def machine(folder: Path) -> Iterator[None]:
    """This process on another machine: with copies in a folder of its own."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(FOLDER, str(folder))
        yield


def upload(folder: Path, url: str) -> None:
    """Put all files of a folder below a URL."""
    store = from_url(url)
    for path in sorted(folder.rglob("*")):
        if path.is_file():
            obstore.put(store, path.relative_to(folder).as_posix(), path)


def keys(url: str, prefix: str = "") -> dict[str, str]:
    """Every key below a URL with its tag."""
    pages = obstore.list(from_url(url), prefix or None)
    return {one["path"]: one["e_tag"] or "" for page in pages for one in page}
