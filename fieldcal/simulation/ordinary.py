"""Ordinary flights as experiments: an autopilot's sensors in their own units, a receiver, no VPS."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fieldcal.names import Triple
from fieldcal.simulation.experiment import Experiment
from fieldcal.simulation.flown import Flown

# Of sensors on autopilots as they log them, sd about perfect ones: scale, and zero in units.
SCALE_SD = {"magnetometer": 0.03, "accelerometer": 0.005, "gyroscope": 0.01}
ZERO_SD = {"magnetometer": 0.05, "accelerometer": 0.1, "gyroscope": 0.01}
# Noise behind the band limit, variance: 0.1 °/s (0.01 °/s/√Hz), 0.05 m/s², 0.6 % of the field.
NOISE_VARIANCE = {"magnetometer": 34e-6, "accelerometer": 2.5e-3, "gyroscope": 3e-6}
LAG_S = (0.04, 0.26)
LARGEST_ARM_M = 0.3
DIP_RAD = 1.1


def ordinary_flight(motion: str, seed: int = 0, **changes: object) -> Experiment:
    """An experiment of an ordinary flight: constants, lag and antenna arm are drawn by the seed.

    Parameters
    ----------
    motion : {"mission", "lively", "hover", "fixed_wing"}
        What is flown.
    seed : int
        Of everything.
    **changes
        Replace fields of the experiment.

    Returns
    -------
    Experiment
        For `simulate` and `write_flights`.

    Raises
    ------
    ValueError
        No such motion.

    Examples
    --------
    >>> import fieldcal
    >>> e = fieldcal.ordinary_flight("lively", seed=3, duration_s=60.0)
    >>> e.logged, e.vps, 0.04 < e.gnss_lag_s < 0.26
    ('si', False, True)
    """
    rng = np.random.default_rng([seed, 1919])
    scale = {name: _three(1.0 + sd * rng.normal(size=3)) for name, sd in SCALE_SD.items()}
    bias = {name: _three(sd * rng.normal(size=3)) for name, sd in ZERO_SD.items()}
    own = Experiment(
        seed=seed,
        motion=Flown(motion),
        logged="si",
        duration_s=120.0,
        dip_rad=DIP_RAD,
        scale=scale,
        bias=bias,
        noise_variance=dict(NOISE_VARIANCE),
        vps=False,
        gnss_rate_hz=5.0,
        gnss_lag_s=float(rng.uniform(*LAG_S)),
        gnss_arm_m=_three(rng.uniform(-LARGEST_ARM_M, LARGEST_ARM_M, 3)),
    )
    return replace(own, **changes)  # type: ignore[arg-type]


def _three(x: np.ndarray) -> Triple:
    return float(x[0]), float(x[1]), float(x[2])
