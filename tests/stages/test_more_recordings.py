"""Recordings on which estimators failed: with and without their optical poses, nothing wrong is published.

What is printed of them, and how it is judged, is `benchmarks/real_recordings.py`; needs `FIELDCAL_EXAMPLE_LOGS`.
"""

from __future__ import annotations

import json
from collections import defaultdict
from typing import Any

import numpy as np
import pytest
import real_recordings
from example_logs import PARENT, needs_examples
from outside_ci import outside_ci

from fieldcal.config.configuration import load
from fieldcal.logs import ingest
from fieldcal.stages.pipeline import run_flight

pytestmark = needs_examples

ARCHIVE = PARENT / "recordings-2"
TOO_FAR_SD = 4.0
QUICK = {("jana04.mcap", True), ("upenn_07", True), ("upenn_07", False), ("diodem_1_2", False)}
GYROSCOPE_ROWS = {("broad_09", False): 6, ("jana04.mcap", True): 4, ("upenn_07", True): 6}
"""Published scales and zeros where they are known to be found."""


def every() -> list[Any]:
    """Each recording with and without the VPS in the estimate; the quick ones run in CI."""
    names = json.loads((ARCHIVE / "expected.json").read_text()) if (ARCHIVE / "expected.json").exists() else {}
    return [
        pytest.param(name, by_vps, marks=() if (name.split("/")[-1], by_vps) in QUICK else outside_ci)
        for name in names
        for by_vps in (True, False)
    ]


@pytest.mark.parametrize(("name", "by_vps"), every())
def test_what_is_published_of_the_gyroscope_is_true_by_its_sd(name: str, by_vps: bool) -> None:
    vehicle = load(ARCHIVE / "fieldcal.toml").vehicle(name.split("/")[0])
    signals, facts = ingest.read_flight(ARCHIVE / name, vehicle)
    settings = ingest.settings_of(facts, vehicle).changed(method="auto", use_vps="auto" if by_vps else False)
    results = run_flight(signals, settings)
    assert results["joint"].reason_code != "joint_diverged"
    entry = json.loads((ARCHIVE / "expected.json").read_text())[name]
    ratios: dict[str, list[float]] = defaultdict(list)
    real_recordings.row(name, entry, results, settings, 0.0, ratios)
    off = [z for quantity, values in ratios.items() if quantity.startswith("gyroscope") for z in values]
    assert np.abs(off).max(initial=0.0) < TOO_FAR_SD
    assert len(off) >= GYROSCOPE_ROWS.get((name.split("/")[-1], by_vps), 0)
