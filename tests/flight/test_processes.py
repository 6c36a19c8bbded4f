"""What a process of several begins with."""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import pytest

from fieldcal.flight.processes import one_of_many


def threads_of_polars() -> int:
    import polars as pl

    return pl.thread_pool_size()


@pytest.mark.parametrize(("asked", "given"), [(None, 1), ("2", 2)])
def test_polars_takes_one_thread_unless_the_user_says_otherwise(
    asked: str | None, given: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("POLARS_MAX_THREADS", raising=False)
    if asked is not None:
        monkeypatch.setenv("POLARS_MAX_THREADS", asked)
    with ProcessPoolExecutor(1, get_context("spawn"), one_of_many) as pool:
        assert pool.submit(threads_of_polars).result() == given
