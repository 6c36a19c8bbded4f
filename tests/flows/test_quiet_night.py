"""A night in which nothing is new: it asks what earlier nights wrote down, and no server, but one that is named."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

import fieldcal.flows.run as module
from fieldcal.batch import night
from fieldcal.batch.documents import NightDocument
from fieldcal.batch.night import Night, plan_night
from fieldcal.flows.run import run_night
from fieldcal.simulation.archive import write_flights
from fieldcal.simulation.experiment import Experiment
from fieldcal.warehouse.content import content_sha256

COMMAND = """
import sys
from fieldcal.cli.main import run
code = run(["nightly", sys.argv[1], "--warehouse", sys.argv[2]])
print(code, [name for name in ("prefect", "pandas", "scipy.stats") if name in sys.modules])
"""


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory, prefect_server: str) -> tuple[Path, Path]:
    """An archive, and the warehouse after its first night."""
    folder = tmp_path_factory.mktemp("quiet")
    archive, root = folder / "archive", folder / "warehouse"
    write_flights(archive, Experiment(seed=8, duration_s=20.0))
    assert run_night(archive, root)["stages_run"] > 0
    return archive, root


def test_it_loads_neither_prefect_nor_what_only_trends_need(flown: tuple[Path, Path]) -> None:
    archive, root = flown
    before = content_sha256(root)
    alone = {name: value for name, value in os.environ.items() if not name.startswith("PREFECT_")}
    told = subprocess.run(
        [sys.executable, "-c", COMMAND, str(archive), str(root)], capture_output=True, text=True, env=alone, timeout=120
    )
    assert told.stdout.splitlines()[-1] == "0 []", told.stderr
    assert content_sha256(root) == before
    assert not (root / "prefect" / "server.json").exists()


def test_a_server_that_is_named_hears_of_it_and_nothing_else_differs(
    flown: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    archive, root = flown
    asked: list[object] = []
    with_prefect = module._with_prefect

    def heard(*args: Any, **where: Any) -> tuple[NightDocument, float]:
        asked.append(args)
        return with_prefect(*args, **where)

    monkeypatch.setattr(module, "_with_prefect", heard)
    named = run_night(archive, root)
    assert len(asked) == 1
    monkeypatch.delenv("PREFECT_API_URL")
    alone = run_night(archive, root)
    assert len(asked) == 1
    assert alone["server_seconds"] == 0.0
    timed = ("seconds", "server_seconds", "stage_seconds")
    assert {k: v for k, v in alone.items() if k not in timed} == {k: v for k, v in named.items() if k not in timed}


def test_a_new_log_has_a_server_started(
    flown: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    archive, root = flown
    (log,) = write_flights(tmp_path, Experiment(seed=9, duration_s=20.0))
    (archive / "another" / "2026-05-01").mkdir(parents=True)
    log.rename(archive / "another" / "2026-05-01" / log.name)
    monkeypatch.delenv("PREFECT_API_URL")
    monkeypatch.setattr(module, "running_server", lambda root: (_ for _ in ()).throw(RuntimeError("started")))
    with pytest.raises(RuntimeError, match="started"):
        run_night(archive, root)


def test_code_that_is_new_has_a_server_start_while_it_plans_and_needs_none_where_nothing_is_new(
    flown: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    archive, root = flown
    run_night(archive, root)
    monkeypatch.delenv("PREFECT_API_URL")
    planned = plan_night(archive, root)
    assert not planned.has_work()
    told: list[str] = []

    @contextmanager
    def server(_: Path) -> Iterator[None]:
        told.append("started")
        yield
        told.append("ended")

    def plan(*given: Any) -> Night:
        told.append("planned")
        return planned

    monkeypatch.setattr(module, "running_server", server)
    monkeypatch.setattr(night, "plan_night", plan)
    run_night(archive, root)
    assert told == ["planned"]
    (root / "night" / "sources.json").unlink()
    assert run_night(archive, root)["server_seconds"] == 0.0
    assert told == ["planned", "started", "planned", "ended"]
