"""Two clocks laid together: rotation rates of gyroscope and VPS."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from fieldcal.geometry.rotation import Array
from fieldcal.plots.panels import COLOURS, curve, legend, stacked

if TYPE_CHECKING:
    from matplotlib.axes import Axes

AROUND_S = 0.5
LIVELIEST_SHARE = 0.999
"""Of the rates: the moment is where they are nearly greatest, not at a single wild sample."""


def plot_clock(imu: tuple[Array, Array], vps: tuple[Array, Array], title: str, *, unit: str = "rad/s") -> list[Axes]:
    """Rates of both, (stamps (n,) s on the IMU's clock, rates (n, 3)): the whole record, and its liveliest second."""
    axes = stacked(2, title=title, height_in=5.0)
    lengths = [(t, np.linalg.norm(rate, axis=1)) for t, rate in (imu, vps)]
    own_t, own = lengths[1]
    known = np.isfinite(own)
    moment = float(own_t[known][np.argmax(own[known] >= np.quantile(own[known], LIVELIEST_SHARE))])
    for axis in axes:
        near = slice(None) if axis is axes[0] else None
        for (t, length), colour, name, width in zip(
            lengths, ("0.6", COLOURS[0]), ("gyroscope", "VPS"), (2.4, 1.0), strict=True
        ):
            inside = near if near is not None else np.abs(t - moment) <= AROUND_S
            curve(axis, t[inside], length[inside], colour, name, width=width)
        axis.set_ylabel(f"rotation rate ({unit})")
    axes[0].axvspan(moment - AROUND_S, moment + AROUND_S, color="tab:orange", alpha=0.2, linewidth=0)
    axes[1].set_xlim(moment - AROUND_S, moment + AROUND_S)
    axes[1].set_xlabel("time, IMU clock (s)")
    legend(axes[0])
    return axes
