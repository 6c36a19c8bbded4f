"""A calibrated flight: what the constants make of the readings, and how sure each method is of its scales."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain
from typing import TYPE_CHECKING

import numpy as np

from fieldcal.geometry.rotation import Array
from fieldcal.plots.panels import COLOURS, REFUSED, curve, legend, panels, three, told, unit
from fieldcal.report.words import plain_name

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Rates = tuple[Array, Array]


@dataclass(frozen=True)
class SensorPlot:
    """What is shown of one triad; what there is not is None.

    `t` (n,) s and `z` (n, 3) calibrated by method `used`, in `unit`; `length` of the sensed vector, same unit; `vps`
    the stamps (m,), s, and rates (m, 3), rad/s, to lay beside; `scales`: method, scale (3,), sd (3,), and "ok" or
    why it does not count."""

    sensor: str
    unit: str
    t: Array | None
    z: Array | None
    length: float | None
    vps: Rates | None
    scales: list[tuple[str, Array, Array, str]]
    used: str | None
    refused: str | None


def plot_calibration(sensors: Sequence[SensorPlot], title: str) -> list[Axes]:
    """A column a sensor: readings above, scales below."""
    axes = panels(2, len(sensors), title=title, height_in=6.0, width_in=11.0)
    for above, below, sensor in zip(*axes, sensors, strict=True):
        above.set_title(sensor.sensor if sensor.used is None else f"{sensor.sensor}, {plain_name(sensor.used)}")
        if sensor.t is None or sensor.z is None or not np.isfinite(sensor.z).any():
            told(above, f"Refused: {sensor.refused}" if sensor.refused else "There is nothing to show.")
            below.set_visible(False)
            continue
        _readings(above, sensor)
        _scales(below, sensor)
    for axis in axes[0]:
        axis.title.set_fontsize("medium")
    return [axis for axis in chain.from_iterable(axes) if axis.get_visible()]


def _readings(axis: Axes, s: SensorPlot) -> None:
    assert s.t is not None
    assert s.z is not None
    if s.length is None:
        if s.vps is not None:
            for column, name in zip(s.vps[1].T, ("VPS", None, None), strict=True):
                curve(axis, s.vps[0], column, "0.75", name, width=3.0)
        three(axis, s.t, s.z)
        axis.set_ylabel(f"rate, body axes ({unit(s.unit)})")
        low, high = axis.get_ylim()
        axis.set_ylim(low, high + 0.25 * (high - low))
        axis.legend(loc="upper center", ncols=4, fontsize="small", frameon=False, handlelength=1.0, columnspacing=1.0)
    else:
        known = np.isfinite(s.z).all(axis=1)
        curve(axis, s.t[known], np.linalg.norm(s.z[known], axis=1), COLOURS[0], width=0.7)
        axis.axhline(s.length, color="k", linewidth=1.0, linestyle="--")
        axis.set_ylabel(f"length, dashed: {s.length:.4g} ({unit(s.unit)})")
    axis.set_xlabel("time (s)")
    if s.refused:
        axis.text(0.02, 0.02, "refused: not to be used", transform=axis.transAxes, color="tab:red", fontsize="small")


def _scales(axis: Axes, s: SensorPlot) -> None:
    """Each method's scale over the one in use, less 1, in per cent."""
    (reference,) = (value for name, value, _, _ in s.scales if name == s.used)
    step = 0.7 / len(s.scales)
    for number, (name, value, sd, standing) in enumerate(s.scales):
        ok = standing == "ok"
        x = np.arange(3) + step * (number - 0.5 * (len(s.scales) - 1))
        axis.errorbar(
            x,
            100.0 * (value / reference - 1.0),
            100.0 * sd / np.abs(reference),
            fmt="o" if ok else "x",
            color=COLOURS[number] if ok else REFUSED,
            label=plain_name(name) if ok else f"{plain_name(name)} ({standing})",
            markersize=4,
            capsize=3,
            linewidth=1.2,
        )
    axis.axhline(0.0, color="k", linewidth=0.6)
    axis.set_xticks(range(3), [f"λ{axis_name}" for axis_name in "xyz"])
    axis.set_xlim(-0.6, 2.6)
    axis.set_ylabel("scale, difference ± sd (%)")
    legend(axis, 1 if len(s.scales) > 2 else 2)
