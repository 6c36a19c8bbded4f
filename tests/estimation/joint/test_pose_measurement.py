"""The VPS inside the joint estimate: what it gains, honest sd, bad poses do no harm, and nothing without it."""

from __future__ import annotations

from typing import Any

import numpy as np
import polars as pl
import pytest
from numerics_support import rms

from fieldcal.names import SENSORS
from fieldcal.simulation.archive import settings, signals
from fieldcal.simulation.experiment import SimulatedFlight, constants_at, simulate
from fieldcal.stages.pipeline import run_flight
from fieldcal.stages.results import StageResult
from fieldcal.stages.tables import AXES

MOVING = {"translation_rms_mps2": 0.3, "lever_arm_m": (0.05, 0.02, -0.03)}
FAULTY = {"vps_dropout_share": 0.1, "vps_outlier_share": 0.01, "vps_skew_ppm": 200.0, "vps_misalignment_rad": 0.1}
SEEDS = (41, 42, 43)


def flown(r: SimulatedFlight, **changes: Any) -> dict[str, StageResult]:
    return run_flight(signals(r), settings(r.experiment, method="joint", lever_arm_m=None, **changes))


def scales(results: dict[str, StageResult], r: SimulatedFlight, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Relative errors, and errors over their sd."""
    rows = results["joint"].tables["calibration"].filter(pl.col("axis").is_in(AXES), sensor=name, parameter="scale")
    true = np.asarray(constants_at(r.experiment, name, 25.0)[0])
    error = rows["value"].to_numpy() - true
    return error / true, error / rows["sd"].to_numpy()


@pytest.fixture(scope="module")
def flights() -> list[tuple[SimulatedFlight, dict[str, StageResult]]]:
    recordings = [simulate(seed=seed, **MOVING, **FAULTY) for seed in SEEDS]
    return [(r, flown(r, use_vps=True)) for r in recordings]


def test_constants_are_of_reference_grade(flights: list[tuple[SimulatedFlight, dict[str, StageResult]]]) -> None:
    """Twice the medians of `benchmarks/joint_vps.py`; without the VPS they are 0.6, 0.7 and 1.1 %."""
    for name, bar in (("magnetometer", 0.001), ("accelerometer", 0.006), ("gyroscope", 0.006)):
        assert np.median([rms(scales(results, r, name)[0]) for r, results in flights]) < bar, name


def test_claimed_sd_are_honest(flights: list[tuple[SimulatedFlight, dict[str, StageResult]]]) -> None:
    normal = np.concatenate([scales(results, r, name)[1] for r, results in flights for name in SENSORS])
    assert 0.6 < rms(normal) < 1.6


def test_its_use_and_its_clock_are_told(flights: list[tuple[SimulatedFlight, dict[str, StageResult]]]) -> None:
    for r, results in flights:
        measured = results["joint"].measured
        assert measured["use_vps"] is True
        assert measured["vps_poses_refused"] > 0  # dropouts
        middle = 0.5 * float(r.t[0] + r.t[-1])
        true = middle - ((middle - r.delay_s) * (1 + 200e-6) + r.experiment.vps_offset_s)
        # Of the used segments' middle, some seconds from the flight's: 200 ppm of that.
        assert abs(measured["vps_lag_mid_s"] - true) < 1e-3
        assert abs(measured["vps_skew_ppm"] - 200.0) < 4.0 * measured["vps_skew_sd_ppm"]
        fit = results["verify"].tables["fit"].filter(method="joint", reference="vps")
        assert set(fit["sample"]) == {"all", "held_out"}


def test_a_vps_that_is_switched_off_changes_nothing() -> None:
    r = simulate(seed=44, duration_s=20.0, sets=1)
    with_vps, frames = flown(r, use_vps=False), signals(r)
    del frames["vps"]
    own = settings(r.experiment, method="joint", lever_arm_m=None)
    for use_vps in ("auto", True, False):
        without = run_flight(frames, own.changed(use_vps=use_vps))["joint"].tables["calibration"]
        assert with_vps["joint"].tables["calibration"].equals(without)


def test_a_vps_of_another_motion_is_left_out() -> None:
    r, other = simulate(seed=45, duration_s=20.0, sets=1), simulate(seed=46, duration_s=20.0, sets=1)
    results = run_flight(
        signals(r) | {"vps": signals(other)["vps"]}, settings(r.experiment, method="joint", use_vps=True)
    )
    assert results["joint"].measured["use_vps"] is False
    assert results["joint"].measured["use_vps_reason"] in (
        "flat_peak",
        "ambiguous_peak",
        "not_the_same_motion",
    )
