"""A vector triad's calibrated readings on the sphere they should lie on."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from fieldcal.geometry.rotation import Array
from fieldcal.plots.panels import COLOURS, panels

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MOST_POINTS = 4000


def plot_sphere(z: Array, magnitude: float, title: str) -> list[Axes]:
    """Relative error of the length of z (n, 3) at each reading, and the directions sensed: equal areas are equal solid
    angles."""
    axes = panels(1, 2, title=title, height_in=3.6)[0]
    length = np.linalg.norm(z, axis=1)
    thin = slice(None, None, -(-len(z) // MOST_POINTS))
    axes[0].plot(np.arange(len(z))[thin], 100.0 * (length / magnitude - 1.0)[thin], ".", ms=2, color=COLOURS[0])
    axes[0].axhline(0.0, color="k", linewidth=0.8)
    axes[0].set_xlabel("reading")
    axes[0].set_ylabel("length less magnitude (%)")
    azimuth = np.degrees(np.arctan2(z[:, 1], z[:, 0]))
    axes[1].plot(azimuth[thin], (z[:, 2] / length)[thin], ".", ms=2, color=COLOURS[1])
    axes[1].set(xlim=(-180, 180), ylim=(-1, 1), xticks=range(-180, 181, 90))
    axes[1].set_xlabel("azimuth about the sensor's z (°)")
    axes[1].set_ylabel("sine of elevation above its xy-plane")
    return axes
