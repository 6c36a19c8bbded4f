"""`fieldcal.synchronise`: the VPS's clock against the IMU's, from arrays."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from fieldcal.estimation.clock_sync import by_rates
from fieldcal.estimation.clock_sync.by_field import refine_by_field
from fieldcal.estimation.clock_sync.by_rates import SyncFit
from fieldcal.estimation.clock_sync.search import find_clock
from fieldcal.geometry.rotation import Array
from fieldcal.stages import vps_poses

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@dataclass(frozen=True, kw_only=True)
class Synchronisation(SyncFit):
    """VPS clock + lag = IMU clock.

    Attributes
    ----------
    lag_mid_s : float
        Lag at mid-record, IMU time `reference_s`, s; `lag_sd_s` its standard deviation. `lag_s`: at the first sample.
    skew_ppm : float
        Drift, ppm, positive when the VPS clock is fast; `skew_sd_ppm` its standard deviation.
    covariance : (2, 2) array
        Of the lag at mid-record, s, and the skew (a ratio), of noise alone.
    spread : (2,) array
        Half of what both differ from those by slower motion, beyond chance; it is in `lag_sd_s` and `skew_sd_ppm`.
    peak, runner_up : float
        Correlation of the rotation rates at the lag, and the best one away from it; `peak_width_s`.
    explained : float
        Share of the gyroscope's variance that the VPS accounts for.
    matrix : (3, 3) array
        From the VPS's body rates to the given rates.
    turning : (3, 3) array
        Covariance of the VPS's body rates over the record, (rad/s)².
    reference_s, first_s : float
        IMU times of mid-record and of the first sample, s.
    t, rate : (n,), (n, 3) arrays
        The IMU's stamps, s, and rates as they were given.
    t_vps, vps_rate : (m,), (m, 3) arrays
        Stamps on the IMU's clock, s, and the VPS's rates put through `matrix`; NaN beside gaps.
    findings : tuple of str
        What was left out of the poses, or is odd about them.

    Examples
    --------
    >>> import fieldcal
    >>> flight = fieldcal.simulate(seed=1, duration_s=20.0)
    >>> sync = fieldcal.synchronise(flight.t, flight.counts["gyroscope"], flight.vps_t, flight.vps_q)
    >>> bool(abs(sync.lag_s - flight.lag_s) < 5e-3), sync.peak > sync.runner_up
    (True, True)
    """

    t: Array = field(repr=False)
    rate: Array = field(repr=False)
    t_vps: Array = field(repr=False)
    vps_rate: Array = field(repr=False)
    findings: tuple[str, ...] = ()

    def plot(self) -> list[Axes]:
        """Rotation rates of both on the IMU's clock: the record, and its liveliest second."""
        from fieldcal.plots.clock import plot_clock

        centred = self.rate - np.median(self.rate, axis=0)
        title = f"VPS clock: lag {1e3 * self.lag_mid_s:.3f} ± {1e3 * self.lag_sd_s:.2g} ms at mid-record"
        return plot_clock((self.t, centred), (self.t_vps, self.vps_rate), title, unit="as given")


def synchronise(
    t_imu: ArrayLike,
    rate_imu: ArrayLike,
    t_vps: ArrayLike,
    q_vps: ArrayLike,
    *,
    magnetometer: ArrayLike | None = None,
    max_lag_s: float = 60.0,
    min_peak: float = 0.5,
    max_gap_s: float = 0.05,
) -> Synchronisation:
    """Find lag and drift of a VPS's clock against the IMU's from the motion that both have seen.

    Coarse: masked, normalised cross-correlation of the rotation rates' lengths, which needs no alignment of frames.
    Fine: Gauss–Newton on ω_imu(t) ≈ M ω_vps(t) + c with the VPS's stamps moved and stretched; the free M (3, 3) takes
    up mounting and calibration, so that neither moves the lag. Poses that the VPS repeated, made up or got wrong are
    left out first, as in a night. Where nothing matches within `max_lag_s`, clocks further apart, and of other rates,
    are tried.

    Parameters
    ----------
    t_imu, rate_imu : (n,), (n, 3) arrays
        IMU stamps, s, rising, and gyroscope readings, any axes, rad/s or logged units.
    t_vps, q_vps : (m,), (m, 4) arrays
        VPS stamps on its own clock, s, and attitudes, scalar last, body to world.
    magnetometer : (n, 3) array, optional
        Readings at `t_imu`, any unit, NaN where there is none: with less noise than rates they sharpen the lag.
    max_lag_s : float
        Lags are sought between ± this first.
    min_peak : float
        Least correlation.
    max_gap_s : float
        Longest gap between poses that is bridged, s; of a slow system longer ones are.

    Returns
    -------
    Synchronisation

    Raises
    ------
    UnusableFlight
        `vps_too_short`, `flat_peak` (below `min_peak`), `ambiguous_peak` (the next best within 2 %),
        `not_the_same_motion`, `vps_lost` (most poses are left out), `clock_rates_differ`; `err.measured` has the
        numbers.

    Notes
    -----
    The lag contains the difference of the two sensors' group delays: nothing here can tell one from the other.

    References
    ----------
    Padfield, Masked object registration in the Fourier domain (2012), for the correlation.

    Examples
    --------
    >>> import fieldcal
    >>> flight = fieldcal.simulate(seed=1, duration_s=20.0)
    >>> counts = flight.counts
    >>> sync = fieldcal.synchronise(
    ...     flight.t, counts["gyroscope"], flight.vps_t, flight.vps_q, magnetometer=counts["magnetometer"]
    ... )
    >>> round(sync.lag_s, 2), sync.lag_sd_s < 3e-4
    (-0.37, True)
    """
    t, rate = np.asarray(t_imu, dtype=float), np.asarray(rate_imu, dtype=float)
    stamps, q = np.asarray(t_vps, dtype=float), np.asarray(q_vps, dtype=float)
    if rate.shape != (len(t), 3) or q.shape != (len(stamps), 4):
        raise ValueError(f"(n,), (n, 3), (m,), (m, 4) wanted, got {t.shape}, {rate.shape}, {stamps.shape}, {q.shape}")
    admitted = vps_poses.admitted(stamps, q, max_gap_s)
    vps_poses.need_most(admitted)
    stamps, q, gap_s = admitted.t, admitted.q, admitted.max_gap_s
    centred = rate - np.median(rate, axis=0)
    fit = find_clock(t, centred, stamps, q, max_lag_s=max_lag_s, min_peak=min_peak, max_gap_s=gap_s)
    if magnetometer is not None:
        fit, _ = refine_by_field(t, np.asarray(magnetometer, dtype=float), stamps, q, fit, max_gap_s=gap_s)
    rates = by_rates.vps_rates(stamps, q, float(np.median(np.diff(stamps))), max_gap_s=gap_s)
    turned = np.where(rates.valid[:, None], rates.rate @ fit.matrix.T, np.nan)
    told = tuple(
        fault.sentence for fault in (*admitted.found, *vps_poses.far_clock(admitted, fit.lag_mid_s, max_lag_s))
    )
    return Synchronisation(**vars(fit), t=t, rate=rate, t_vps=fit.to_imu_clock(rates.t), vps_rate=turned, findings=told)
