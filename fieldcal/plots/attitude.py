"""Attitudes against time: what a fit leaves, and what it found."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from fieldcal.geometry.rotation import Array, continuous, euler_angles
from fieldcal.plots.panels import COLOURS, curve, legend, stacked, three
from fieldcal.plots.panels import unit as plain_unit
from fieldcal.report.plot import without_wraps

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def plot_attitude_error(t: Array, rate: Array, error: Array, stretch: Array, title: str) -> list[Axes]:
    """Calibrated rates (n, 3), rad/s, and the attitude error (n, 3), rad, inertial axes, at stamps t (n,), s; no line
    runs from one `stretch` (n,) of integration to the next."""
    degrees = np.degrees(error)
    degrees[1:][stretch[1:] != stretch[:-1]] = np.nan
    axes = stacked(2, title=title, height_in=5.0, sharex=True)
    three(axes[0], t, rate)
    axes[0].set_ylabel("calibrated rate (rad/s)")
    three(axes[1], t, degrees, ("about north", "east", "down"))
    axes[1].set_ylabel("attitude error (°)")
    axes[1].set_xlabel("time (s)")
    for axis in axes:
        legend(axis)
    return axes


def plot_joint(t: Array, q: Array, lengths: Mapping[str, tuple[Array, Array, float, str]], title: str) -> list[Axes]:
    """Attitude q (n, 4) of the sensor axes as Euler angles, and each vector triad's calibrated length: sensor →
    (stamps (k,), lengths (k,), the length it should have, its unit)."""
    axes = stacked(1 + len(lengths), title=title, height_in=2.0 * (1 + len(lengths)) + 0.8, sharex=True)
    angles = euler_angles(continuous(q))
    for i, name in enumerate(("bank φ", "pitch θ", "heading ψ")):
        curve(axes[0], t, np.degrees(without_wraps(angles[:, i])), COLOURS[i], name)
    axes[0].set_ylabel("attitude (°)")
    legend(axes[0])
    for axis, (name, (stamps, length, wanted, unit)) in zip(axes[1:], lengths.items(), strict=True):
        curve(axis, stamps, length, COLOURS[0], width=0.7)
        axis.axhline(wanted, color="k", linewidth=1.0, linestyle="--")
        axis.set_ylabel(f"{name},\nlength ({plain_unit(unit)})")
    axes[-1].set_xlabel("time (s)")
    return axes
