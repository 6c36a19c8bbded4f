"""Speed of the numerics, as ratios and times: QUEST against the `ahrs` package, and the chain of a 40 s flight.

    python benchmarks/bench_numerics.py [--json]

Everything runs on one core (BLAS threads are switched off before numpy is loaded); times are the best of five.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Callable

for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[variable] = "1"

import numpy as np

from fieldcal.estimation import ellipsoid, smoothing, wahba
from fieldcal.estimation.gyroscope import equation_error, output_error
from fieldcal.estimation.gyroscope.equation_error import GyroFit
from fieldcal.simulation.experiment import SCALE, SimulatedFlight, simulate

REFERENCE = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def best_of_five(function: Callable[[], object]) -> float:
    """Shortest of five runs, s."""
    times = []
    for _ in range(5):
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return min(times)


def chain(r: SimulatedFlight, *, method: str, equations: str, output: bool) -> GyroFit:
    """The paper's calibration of one flight: smoothing, both ellipsoids, QUEST, gyroscope."""
    names = ("gyroscope", "accelerometer", "magnetometer")
    logged = np.hstack([r.counts[name] for name in names])
    smoothed = smoothing.smooth_samples(r.t, logged, 8.0)
    raw, smooth = ({n: x[:, 3 * i : 3 * i + 3] for i, n in enumerate(names)} for x in (logged, smoothed))
    source = raw if method == "robust" else smooth
    vectors = []
    sigma = []
    for name, magnitude in (("magnetometer", 1.0), ("accelerometer", r.experiment.gravity_mps2)):
        fit = ellipsoid.fit_ellipsoid(source[name], magnitude, method=method, polarity=np.sign(SCALE[name]))
        vectors.append(fit.apply(smooth[name]))
        sigma.append(max(fit.residual_rms, 1e-4))
    q = wahba.attitudes(np.stack(vectors, axis=1), REFERENCE, np.array(sigma)).q
    q_dot = smoothing.differentiate_samples(r.t, q, window_s=0.027)
    start = equation_error.fit_equation_error(q, q_dot, smooth["gyroscope"], equations=equations)
    return output_error.fit_output_error(r.t, q, raw["gyroscope"], start, stretch_s=5.0) if output else start


def quest_rates(n: int = 200_000, n_ahrs: int = 2_000) -> tuple[float, float]:
    """Attitudes per second of ours and of ahrs.filters.QUEST on the same kind of vectors."""
    from ahrs.filters import QUEST

    recording = simulate(seed=1)
    times = -(-n // len(recording.q))
    q = np.tile(recording.q, (times, 1))[:n]
    observed = np.stack([wahba.rotate_reference(q, v) for v in REFERENCE], axis=1)
    observed += 0.005 * np.random.default_rng(1).normal(size=observed.shape)
    ours = n / best_of_five(lambda: wahba.attitudes(observed, REFERENCE, np.array([0.005, 0.005])))
    magnetic, gravity = observed[:n_ahrs, 0].copy(), observed[:n_ahrs, 1].copy()
    theirs = n_ahrs / best_of_five(lambda: QUEST(acc=gravity, mag=magnetic, magnetic_dip=0.0))
    return ours, theirs


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args()
    ours, theirs = quest_rates()
    flight = simulate(seed=1)
    cases = {
        "Li-Griffiths, equation error": {"method": "li", "equations": "all", "output": False},
        "robust ellipsoid, equation error": {"method": "robust", "equations": "all", "output": False},
        "robust ellipsoid, output error": {"method": "robust", "equations": "all", "output": True},
    }
    times = {name: best_of_five(lambda o=options: chain(flight, **o)) for name, options in cases.items()}
    figures = {
        "quest_attitudes_per_s": ours,
        "quest_over_ahrs": ours / theirs,
        "flight_40s_ms": {k: 1e3 * v for k, v in times.items()},
    }
    if given.json:
        print(json.dumps(figures, indent=1))
        return
    print(
        f"QUEST with covariance and TASTE: {ours / 1e6:.2f} million attitudes/s, {ours / theirs:.0f} × ahrs (same run)"
    )
    print(f"A 40 s flight, {len(flight.t)} samples, one core, best of five:")
    for name, seconds in times.items():
        print(f"  {name:<34} {1e3 * seconds:6.1f} ms")


if __name__ == "__main__":
    main()
