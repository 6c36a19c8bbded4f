"""An object store for tests: moto's server in a thread, reached as any other by what the environment says."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import boto3
import obstore
from moto.server import ThreadedMotoServer
from obstore.store import from_url

ENVIRONMENT = {
    "AWS_ACCESS_KEY_ID": "test",
    "AWS_SECRET_ACCESS_KEY": "test",
    "AWS_REGION": "us-east-1",
    "AWS_ALLOW_HTTP": "true",
}
BUCKETS = ("logs", "warehouse")


@contextmanager
def running_store() -> Iterator[dict[str, str]]:
    """A store with the `BUCKETS`, empty; the environment by which it is reached, which holds during the block."""
    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    _, port = server.get_host_and_port()
    environment = {**ENVIRONMENT, "AWS_ENDPOINT_URL": f"http://127.0.0.1:{port}"}
    former = {name: os.environ.get(name) for name in environment}
    os.environ.update(environment)
    try:
        client = boto3.client("s3", endpoint_url=environment["AWS_ENDPOINT_URL"], region_name="us-east-1")
        for bucket in BUCKETS:
            client.create_bucket(Bucket=bucket)
        yield environment
    finally:
        for name, value in former.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
        server.stop()


def upload(folder: Path, url: str) -> None:
    """Put all files of a folder below a URL."""
    store = from_url(url)
    for path in sorted(folder.rglob("*")):
        if path.is_file():
            obstore.put(store, path.relative_to(folder).as_posix(), path)


def keys(url: str) -> dict[str, tuple[int, str]]:
    """Every key below a URL, with size and tag."""
    return {one["path"]: (one["size"], one["e_tag"] or "") for page in obstore.list(from_url(url)) for one in page}
