"""A fetch whose connection breaks goes on with the range that is missing: gigabytes need not come anew."""

from __future__ import annotations

import http.client
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import obstore
import pytest
from object_store import machine, running_store
from obstore.store import from_url

from fieldcal.remote import objects
from fieldcal.remote.archive import local_archive
from fieldcal.remote.content import here
from fieldcal.remote.url import RemoteError

URL, LOG = "s3://logs/broken", "v/s/flight.bin"
LOG_BYTES, CUT_BYTES = 8 << 20, 3 << 20


@contextmanager
def breaking_off(store: str, asked: Callable[[str | None], None]) -> Iterator[str]:
    """The same store by way of connections that break after `CUT_BYTES`; `asked` is told each range of the log."""

    class Between(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            upstream = http.client.HTTPConnection(urlsplit(store).netloc)
            upstream.request("GET", self.path, headers=dict(self.headers))
            answer = upstream.getresponse()
            content = answer.read()
            self.send_response_only(answer.status)
            for name, value in answer.getheaders():
                if name.lower() not in ("connection", "transfer-encoding"):
                    self.send_header(name, value)
            self.send_header("Connection", "close")
            self.end_headers()
            if self.path.endswith(LOG):
                asked(self.headers["Range"])
            with suppress(ConnectionError):
                self.wfile.write(content[:CUT_BYTES])
            self.close_connection = True

        def log_message(self, *_: object) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Between)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{server.server_port}"
    finally:
        server.shutdown()
        server.server_close()


def fetched(store: str, asked: Callable[[str | None], None]) -> bytes:
    """Content of the log by such a connection."""
    with breaking_off(store, asked) as address, pytest.MonkeyPatch.context() as patch:
        patch.setenv("AWS_ENDPOINT_URL", address)
        objects.opened.cache_clear()
        try:
            log = local_archive(URL) / LOG
            with here(log):
                return log.read_bytes()
        finally:
            objects.opened.cache_clear()


def test_what_a_broken_connection_did_not_bring_is_asked_for_alone(tmp_path: Path) -> None:
    content = np.random.default_rng(1).bytes(LOG_BYTES)
    ranges: list[str | None] = []
    with running_store() as store, machine(tmp_path):
        obstore.put(from_url(URL), LOG, content)
        assert fetched(store, ranges.append) == content
    assert ranges == [None, *(f"bytes={begin}-{LOG_BYTES - 1}" for begin in (CUT_BYTES, 2 * CUT_BYTES))]


def test_a_log_that_is_replaced_meanwhile_is_not_put_together_of_two(tmp_path: Path) -> None:
    first, second = (np.random.default_rng(seed).bytes(LOG_BYTES) for seed in (1, 2))
    with running_store() as store, machine(tmp_path):
        own = from_url(URL, endpoint=store)
        obstore.put(own, LOG, first)

        def replaced(_: str | None) -> None:
            obstore.put(own, LOG, second)

        with pytest.raises(RemoteError, match=r"^s3://logs/broken: .*run it again\.$"):
            fetched(store, replaced)
