"""`fieldcal.plot`: a picture of any result in one call."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

import polars as pl

if TYPE_CHECKING:
    from matplotlib.axes import Axes


class Plottable(Protocol):
    """What draws itself: recordings, calibrations, fits, clocks."""

    def plot(self) -> list[Axes]: ...


def plot(result: Plottable | pl.DataFrame, *, sensor: str | None = None, parameter: str | None = None) -> list[Axes]:
    """Draw a result.

    Parameters
    ----------
    result : Recording, Calibration, fit, clock, or DataFrame
        What draws itself is asked to. A frame is one of `Warehouse`: rows of its history (parameters over the flights,
        ±1 sd, refused ones crossed), of its drift (the trend of each axis over time and temperature, ±2 sd), of table
        fit (Theil coefficients over the flights) or sync (lag and drift of the VPS's clock).
    sensor, parameter : str, optional
        Which rows of a history or drift frame are drawn; else the first sensor there is, and its scale or the first
        parameter there is.

    Returns
    -------
    list of matplotlib Axes
        The panels, row by row; ``axes[0].figure`` is the figure. Labels have units.

    Raises
    ------
    ValueError
        A frame that is none of these, or without rows to draw.

    Examples
    --------
    >>> import matplotlib
    >>> matplotlib.use("agg")
    >>> import fieldcal
    >>> flight = fieldcal.simulate(seed=1, duration_s=20.0)
    >>> fit = fieldcal.fit_ellipsoid(flight.counts["magnetometer"], 1.0, polarity=(1, 1, -1))
    >>> [axis.get_ylabel() for axis in fieldcal.plot(fit)]
    ['length less magnitude (%)', 'sine of elevation above its xy-plane']
    """
    if not isinstance(result, pl.DataFrame):
        return result.plot()
    from fieldcal.plots.frames import plot_frame

    return plot_frame(result, sensor, parameter)
