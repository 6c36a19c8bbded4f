"""The VPS's clock wherever it is: first near the IMU's, then at any offset, then on a clock of another rate."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import ArrayLike

from fieldcal.errors import UnusableFlight
from fieldcal.estimation.clock_sync.by_rates import (
    SURELY_EXPLAINED,
    SyncFit,
    UniformRates,
    correlate,
    on_one_grid,
    refined,
    synchronise,
)
from fieldcal.geometry.rotation import Array
from fieldcal.reason_codes import ReasonCode

FAR_OVERLAP_S = 20.0  # of both records far from the expected lag, where short pieces of many resemble each other
# Rates up to 3 % apart are those of a wrong sample rate (100 for 102.4 Hz); in steps that move the ends of the record
# by less than a manoeuvre lasts. Rates' norms at 20 Hz are enough for that.
LARGEST_RATE_ERROR, STEP_AT_THE_ENDS_S, COARSE_S, MOST_STEPS = 0.035, 0.25, 0.05, 401


def find_clock(
    t_imu: ArrayLike,
    rate_imu: ArrayLike,
    t_vps: ArrayLike,
    q_vps: ArrayLike,
    *,
    max_lag_s: float,
    min_peak: float,
    max_gap_s: float,
) -> SyncFit:
    """`by_rates.synchronise`, and where there is no match within `max_lag_s`, at any lag and on clocks whose rates
    differ.

    Raises
    ------
    UnusableFlight
        As `synchronise`; `clock_rates_differ` also where no single lag fits, `flat_peak` where nothing does.
    """
    given = t_imu, rate_imu, t_vps, q_vps
    near = _tried(lambda: synchronise(*given, max_lag_s=max_lag_s, min_peak=min_peak, max_gap_s=max_gap_s))
    if isinstance(near, SyncFit):
        return near
    if not _no_match(near) and near.reason_code != ReasonCode.CLOCK_RATES_DIFFER:
        raise near
    refused = [near]
    if _no_match(near):
        anywhere = partial(synchronise, max_lag_s=np.inf, min_overlap_s=FAR_OVERLAP_S)
        far = _tried(lambda: _surely(anywhere(*given, min_peak=min_peak, max_gap_s=max_gap_s)))
        if isinstance(far, SyncFit):
            return far
        refused.insert(0, far)
    # Also where rates that differ were found: from the wrong start their difference is not the whole one.
    imu, vps = on_one_grid(*given, max_gap_s=max_gap_s)
    t = np.asarray(t_imu, dtype=float)
    lag, skew, peak = other_rate(imu, vps, 0.5 * float(t[0] + t[-1]))
    if peak >= min_peak:
        numbers = {"peak": peak, "runner_up": peak, "peak_width_s": 0.0, "coarse_lag_s": lag}
        other = _tried(lambda: _surely(refined(imu, vps, lag, skew, t, numbers)))
        if isinstance(other, SyncFit):
            return other
        refused.append(other)
    raise max(refused, key=_says)


def _tried(fit: Callable[[], SyncFit]) -> SyncFit | UnusableFlight:
    try:
        return fit()
    except UnusableFlight as error:
        return error


def _says(error: UnusableFlight) -> tuple[bool, bool, float]:
    """How much a refusal says: clocks of other rates the most, then two motions that resemble each other, the better
    the more; a low correlation the least."""
    explained = error.measured.get("explained")
    return (
        error.reason_code == ReasonCode.CLOCK_RATES_DIFFER,
        error.reason_code == ReasonCode.NOT_THE_SAME_MOTION,
        float(explained) if isinstance(explained, float) else 0.0,
    )


def _no_match(error: UnusableFlight) -> bool:
    """Whether another lag, or clocks of other rates, may match where this one does not."""
    flat = error.reason_code == ReasonCode.FLAT_PEAK and "explained" not in error.measured
    return flat or error.reason_code == ReasonCode.NOT_THE_SAME_MOTION


def _surely(fit: SyncFit) -> SyncFit:
    """The fit, where it leaves no doubt: of so many lags some match by chance."""
    if fit.explained >= SURELY_EXPLAINED:
        return fit
    raise UnusableFlight(
        ReasonCode.NOT_THE_SAME_MOTION,
        f"At the best of all lags, {fit.lag_mid_s:.1f} s, the VPS explains {100 * fit.explained:.0f} % of the"
        f" gyroscope's variance, where {100 * SURELY_EXPLAINED:.0f} % are needed beyond vps_max_lag_s: not the same"
        " motion.",
        {"explained": fit.explained, "lag_mid_s": fit.lag_mid_s, "peak": fit.peak, "runner_up": fit.runner_up},
    )


def other_rate(imu: UniformRates, vps: UniformRates, middle_s: float) -> tuple[float, float, float]:
    """Lag at mid-record, s, skew (a ratio) and correlation of the best match among clocks of other rates."""
    every = max(1, round(COARSE_S / imu.interval_s))
    own, other = (
        replace(r, interval_s=every * r.interval_s, rate=r.rate[::every], valid=r.valid[::every]) for r in (imu, vps)
    )
    shorter_s = own.interval_s * min(len(own.rate), len(other.rate))
    steps = int(np.ceil(LARGEST_RATE_ERROR * shorter_s / (2.0 * STEP_AT_THE_ENDS_S)))
    best = (0.0, 0.0, -1.0)
    if 2 * steps + 1 > MOST_STEPS:
        return best
    for skew in np.linspace(-LARGEST_RATE_ERROR, LARGEST_RATE_ERROR, 2 * steps + 1):
        lag, peak, _, _ = correlate(own, _stretched(other, float(skew)), np.inf, min_overlap_s=FAR_OVERLAP_S)
        if peak > best[2]:
            # t_imu = t_vps / (1 + skew) + lag, which is lag_mid at mid-record.
            best = middle_s + (lag - middle_s) * (1.0 + float(skew)), float(skew), peak
    return best


def _stretched(rates: UniformRates, skew: float) -> UniformRates:
    """The lengths of rates whose clock runs fast by `skew`, on a grid of the same interval in true time."""
    t: Array = rates.t / (1.0 + skew)
    grid = t[0] + rates.interval_s * np.arange(int((t[-1] - t[0]) / rates.interval_s))
    length = np.interp(grid, t, np.linalg.norm(rates.rate, axis=1))
    valid = np.interp(grid, t, rates.valid.astype(float)) > 0.99
    return UniformRates(float(t[0]), rates.interval_s, length[:, None], valid)
