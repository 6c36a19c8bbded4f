"""The VPS's clock at any offset and at other rates; another flight's VPS stays another's."""

from __future__ import annotations

import numpy as np
import pytest

from fieldcal.errors import UnusableFlight
from fieldcal.estimation.clock_sync.search import find_clock
from fieldcal.geometry.rotation import from_rotation_vector, multiply
from fieldcal.simulation.experiment import Experiment, Motion

LIMITS = {"max_lag_s": 60.0, "min_peak": 0.5, "max_gap_s": 0.05}
TENTH_MS = 1e-4
Record = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


def record(
    seed: int = 0, *, duration_s: float = 30.0, sets: int = 2, offset_s: float = 0.37, skew_ppm: float = 20.0
) -> Record:
    """IMU stamps and rates, VPS stamps (own clock: t (1 + skew) + offset) and attitudes of one motion."""
    rng = np.random.default_rng(seed)
    motion = Motion(Experiment(seed=seed, duration_s=duration_s, sets=sets), rng)
    t, t_vps = np.arange(0.0, duration_s, 1.0 / 185.0), np.arange(0.0, duration_s, 1.0 / 120.0)
    rate = motion.rate(t) + 0.02 * rng.normal(size=(len(t), 3))
    q = multiply(motion.attitude(t_vps), from_rotation_vector(3e-5 * rng.normal(size=(len(t_vps), 3))))
    return t, rate, t_vps * (1 + 1e-6 * skew_ppm) + offset_s, q


def refusal(*arrays: np.ndarray) -> UnusableFlight:
    with pytest.raises(UnusableFlight) as caught:
        find_clock(*arrays, **LIMITS)
    return caught.value


@pytest.mark.parametrize("offset_s", [0.37, -59.0, 90.3, -90.3, 7200.0])
def test_the_clock_is_found_at_any_offset(offset_s: float) -> None:
    fit = find_clock(*record(offset_s=offset_s), **LIMITS)
    assert abs(fit.lag_s + offset_s) < 2 * TENTH_MS
    assert abs(fit.skew_ppm - 20.0) < 15.0


@pytest.mark.parametrize("offset_s", [0.37, 90.3])
@pytest.mark.parametrize(("duration_s", "sets"), [(40.0, 3), (200.0, 12), (200.0, 4)])
@pytest.mark.parametrize("per_cent", [-3.0, -0.5, 2.4, 3.0])
def test_clocks_of_other_rates_are_told_with_their_difference(
    duration_s: float, sets: int, per_cent: float, offset_s: float
) -> None:
    """Also where the motion is all in the middle of the record and one lag nearly fits it."""
    error = refusal(*record(duration_s=duration_s, sets=sets, skew_ppm=1e4 * per_cent, offset_s=offset_s))
    assert error.reason_code == "clock_rates_differ"
    skew = error.measured["skew_ppm"]
    assert isinstance(skew, float)
    assert skew == pytest.approx(1e4 * per_cent, abs=100.0)
    assert f"differ by {abs(per_cent):.2f} %" in error.sentence


@pytest.mark.parametrize("seed", range(8))
def test_the_vps_of_another_flight_matches_nowhere(seed: int) -> None:
    (t, rate, _, _), (_, _, stamps, q) = record(seed), record(seed + 7)
    assert refusal(t, rate, stamps, q).reason_code in {"flat_peak", "ambiguous_peak", "not_the_same_motion"}


def test_a_gyroscope_at_rest_has_no_match_at_any_lag() -> None:
    t, rate, stamps, q = record()
    error = refusal(t, 0.1 * np.random.default_rng(5).normal(size=rate.shape), stamps, q)
    assert error.reason_code == "flat_peak"
    assert "at any lag" in error.sentence
    assert "same motion" not in error.sentence
