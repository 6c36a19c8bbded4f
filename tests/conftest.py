"""One Prefect server for all tests that run flows."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

# Before NumPy is loaded, for processes that tests start too: two test processes whose linear algebra takes both cores
# wait for each other.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# Studies that are run by hand have parts that are tested.
sys.path.append(str(Path(__file__).parents[1] / "benchmarks"))


@pytest.fixture(scope="session")
def prefect_server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Address of a server that is running, which fieldcal takes from the environment; started at the first use."""
    from kept_processes import kept

    from fieldcal.flows.server import Server, prepare_environment

    former = os.environ.pop("PREFECT_API_URL", None)
    prepare_environment(tmp_path_factory.mktemp("prefect"))
    with kept(), Server(Path(os.environ["PREFECT_HOME"])) as server:
        url = server.wait()
        yield url
    if former is not None:
        os.environ["PREFECT_API_URL"] = former
