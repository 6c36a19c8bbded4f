"""A thinned run of `benchmarks/hostile_logs.py`, which reads 5,000 hostile files."""

from __future__ import annotations

import hostile_logs
import pytest


def test_hostile_files_are_read_or_refused_in_bounds(capsys: pytest.CaptureFixture[str]) -> None:
    assert hostile_logs.run(range(100), seed=2) == 0, capsys.readouterr().out


def test_a_file_that_takes_too_long_is_a_fall(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(hostile_logs, "SECONDS", 0.0)
    assert hostile_logs.run([1], seed=2) == 1
    assert "fall: more than 0 s" in capsys.readouterr().out
