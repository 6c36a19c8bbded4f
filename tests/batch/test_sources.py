"""Digests of the steps' source: what they cover beside code, how they are remembered, and what the trends wait for."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from drift_history import publish_fleet

from fieldcal.batch import closing, sources
from fieldcal.batch.closing import close_night
from fieldcal.batch.sources import NAMES, TRENDS, know_sources, stage_source
from fieldcal.batch.steps import STEPS
from fieldcal.config.configuration import Alerts
from fieldcal.report.fitness import Criteria
from fieldcal.stages.pipeline import PIPELINE
from fieldcal.trends import drift_table

PLACE = Path("night") / "sources.json"


@pytest.fixture
def nothing_known(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sources, "_known", {})


def test_what_is_declared_of_a_stage_counts() -> None:
    stage = next(stage for stage in PIPELINE if stage.name == "gyro_output")
    changed = [
        replace(stage, trusts=()),
        replace(stage, needs=stage.needs[:-1]),
        replace(stage, reads={**stage.reads, "attitude": "attitude.attitude"}),
        replace(stage, function=PIPELINE[0].function),
    ]
    assert len({stage_source(one) for one in [stage, *changed]}) == 5


@pytest.mark.usefixtures("nothing_known")
def test_digests_are_kept_for_this_very_code(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert set(NAMES) == {*STEPS, TRENDS}
    know_sources(tmp_path, keep=False)
    assert not (tmp_path / PLACE).exists()
    know_sources(tmp_path, keep=True)
    known = dict(sources.sources())
    assert set(known) == set(NAMES)
    assert len(set(known.values())) == len(NAMES)

    monkeypatch.setattr(sources, "_known", {})
    monkeypatch.setattr(sources, "source_digest", lambda *functions: "worked out anew")
    know_sources(tmp_path, keep=False)
    assert sources.sources() == known

    monkeypatch.setattr(sources, "_known", {})
    monkeypatch.setattr(sources, "code_digest", lambda: "other code")
    know_sources(tmp_path, keep=True)
    assert sources.sources()[TRENDS] == "worked out anew"


@pytest.mark.usefixtures("nothing_known")
def test_a_ledger_that_is_torn_is_not_used(tmp_path: Path) -> None:
    know_sources(tmp_path, keep=True)
    data = (tmp_path / PLACE).read_bytes()
    (tmp_path / PLACE).write_bytes(data[: len(data) // 2])
    know_sources(tmp_path, keep=True)
    assert (tmp_path / PLACE).read_bytes() == data


def test_trends_are_made_anew_for_their_own_code_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    publish_fleet(tmp_path, 3)
    made: list[Path] = []
    real = drift_table.update_drift

    def counted(root: Path) -> tuple[str, ...]:
        made.append(root)
        return real(root)

    known = dict(sources.sources())
    monkeypatch.setattr(drift_table, "update_drift", counted)
    close_night(tmp_path, Criteria(Alerts()))
    close_night(tmp_path, Criteria(Alerts()))
    assert len(made) == 1
    monkeypatch.setattr(closing, "sources", lambda: {**known, "attitude": "changed"})
    close_night(tmp_path, Criteria(Alerts()))
    assert len(made) == 1
    monkeypatch.setattr(closing, "sources", lambda: {**known, TRENDS: "changed"})
    close_night(tmp_path, Criteria(Alerts()))
    assert len(made) == 2
