"""The clock of the visual positioning system (VPS) against the IMU's, as a flight's calibration found it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

from fieldcal.errors import FieldcalError, Refused
from fieldcal.geometry.rotation import Array
from fieldcal.reason_codes import ReasonCode
from fieldcal.schemas.rows import SyncRow

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Rates = tuple[Array, Array]
"""Stamps (n,), s, IMU clock, and body rates (n, 3), rad/s, FRD."""


@dataclass(frozen=True)
class VpsClock:
    """VPS clock + lag = IMU clock. The numbers raise `Refused` where the clocks could not be told apart.

    Attributes
    ----------
    status : {"ok", "refused"}
    reason_code, reason : str or None
        Why it was refused.
    peak, runner_up : float or None
        Height of the correlation peak of the rotation rates, 1 for equal signals, and of the next best.

    Examples
    --------
    >>> import tempfile
    >>> import fieldcal
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     log = fieldcal.write_flights(folder, fieldcal.Experiment(duration_s=20.0))[0]
    ...     clock = fieldcal.calibrate(log).sync
    >>> clock.status, round(clock.lag_s, 2), clock.lag_sd_s < 1e-3
    ('ok', -0.37, True)
    """

    status: str
    reason_code: str | None
    reason: str | None
    peak: float | None
    runner_up: float | None
    _row: SyncRow = field(repr=False)
    _rates: tuple[Rates, Rates] | None = field(repr=False)

    @property
    def lag_s(self) -> float:
        """Lag at the first IMU sample, s; it contains the sensors' group delay."""
        return self._number("lag_s")

    @property
    def lag_mid_s(self) -> float:
        """Lag in the middle of the flight, s."""
        return self._number("lag_mid_s")

    @property
    def lag_sd_s(self) -> float:
        """One standard deviation of `lag_mid_s`, s."""
        return self._number("lag_sd_s")

    @property
    def skew_ppm(self) -> float:
        """Drift of the VPS clock against the IMU's, ppm, positive when the VPS clock is fast."""
        return self._number("skew_ppm")

    @property
    def skew_sd_ppm(self) -> float:
        """One standard deviation of `skew_ppm`, ppm."""
        return self._number("skew_sd_ppm")

    def plot(self) -> list[Axes]:
        """Rotation rates of calibrated gyroscope and VPS on the IMU's clock: the flight, and its liveliest second.

        Raises
        ------
        Refused
            The clocks could not be put together.
        FieldcalError
            `no_calibration`: the gyroscope has no constants to show its rates with.
        """
        from fieldcal.plots.clock import plot_clock

        title = f"VPS clock: lag {1e3 * self.lag_mid_s:.3f} ± {1e3 * self.lag_sd_s:.2g} ms at mid-flight"
        if self._rates is None:
            raise FieldcalError(
                ReasonCode.NO_CALIBRATION, "The gyroscope has no constants, so its rates cannot be shown."
            )
        return plot_clock(*self._rates, title)

    def _number(self, name: Literal["lag_s", "lag_mid_s", "lag_sd_s", "skew_ppm", "skew_sd_ppm"]) -> float:
        if self.status != "ok":
            sentence = f"The VPS's clock ({name}) was refused. {self.reason or ''}"
            raise Refused(ReasonCode(self.reason_code or ReasonCode.NOT_USABLE), sentence.strip())
        value = self._row[name]
        return float("nan") if value is None else value
