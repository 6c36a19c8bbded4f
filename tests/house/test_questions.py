"""The documentation's five questions: both forms of each are run, and say the same."""

from __future__ import annotations

import pytest
from questions import PAGE, QUESTIONS, answered

from fieldcal.flows.run import run_night
from fieldcal.simulation.archive import write_flights
from fieldcal.simulation.experiment import Experiment
from fieldcal.warehouse import Warehouse


@pytest.fixture(scope="module")
def warehouse(tmp_path_factory: pytest.TempPathFactory, prefect_server: str) -> Warehouse:
    """A fleet whose flights differ in temperature; one log has no VPS, one is empty."""
    folder = tmp_path_factory.mktemp("questions")
    for session, temperature in enumerate((5.0, 20.0, 35.0)):
        experiment = Experiment(
            seed=session,
            duration_s=20.0,
            temperature_degc=(temperature, temperature),
            bias_per_degc={"accelerometer": (1e-2, -2e-2, 5e-3)},
            vps=session > 0,
        )
        write_flights(folder / f"part-{session}", experiment, vehicles=2)
        for log in sorted((folder / f"part-{session}").rglob("*.mcap")):
            place = folder / "archive" / log.parent.parent.name / f"session-{session}"
            place.mkdir(parents=True)
            log.rename(place / log.name)
    (folder / "part-0" / "fieldcal.toml").rename(folder / "archive" / "fieldcal.toml")
    (folder / "archive" / "sim-2" / "session-2" / "empty.mcap").write_bytes(b"")
    run_night(folder / "archive", folder / "warehouse")
    return Warehouse(folder / "warehouse")


def test_there_are_five() -> None:
    assert len(QUESTIONS) == PAGE.count("<!-- question -->") == 5


@pytest.mark.parametrize(("question", "sql", "python"), QUESTIONS, ids=[question[0] for question in QUESTIONS])
def test_sql_and_polars_answer_the_same(warehouse: Warehouse, question: str, sql: str, python: str) -> None:
    assert answered(warehouse, sql, python).height
