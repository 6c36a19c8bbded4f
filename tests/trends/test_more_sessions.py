"""How many more sessions would tell: said beforehand, and so it comes."""

from __future__ import annotations

import drift_fleet
import numpy as np
import pytest
from outside_ci import outside_ci


@outside_ci
def test_a_drift_is_named_about_when_it_was_said_to_be(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(drift_fleet, "SESSIONS", 14)
    monkeypatch.setattr(drift_fleet, "STEP_SESSION", 8)
    monkeypatch.setattr(drift_fleet, "MAGNET_SESSIONS", ())
    late = [by for seed in (0, 1, 2) for by in drift_fleet.late_by(seed, 7, 14)]
    assert len(late) >= 3
    assert abs(np.median(late)) <= 2
    assert np.max(np.abs(late)) <= 5
