"""A recording as it was logged."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
import polars as pl

from fieldcal.errors import FieldcalError
from fieldcal.plots.panels import COLOURS, curve, legend, stacked, three, unit
from fieldcal.reason_codes import ReasonCode
from fieldcal.stages.tables import QUATERNION, matrix, seconds, triad

if TYPE_CHECKING:
    from matplotlib.axes import Axes

TRIADS = (("gyroscope", "imu"), ("accelerometer", "imu"), ("magnetometer", "magnetometer"))
SINGLE = (
    ("temperature", "temperature_degc", "temperature (°C)"),
    ("power", "current_a", "current (A)"),
    ("power", "throttle", "throttle (1)"),
)


def plot_signals(
    signals: Mapping[str, pl.DataFrame], units: Mapping[str, str], title: str, reason: str | None
) -> list[Axes]:
    """Every signal against time, s from the first IMU sample; the VPS on its own clock, from its first pose."""
    shown = [(name, table) for name, table in TRIADS if table in signals and _any(signals[table], f"{name}_x")]
    single = [(table, column, label) for table, column, label in SINGLE if _any(signals.get(table), column)]
    poses = "vps" in signals and not signals["vps"].is_empty()
    if not shown:
        raise FieldcalError(
            ReasonCode.NOT_USABLE, f"There is nothing to plot: {reason or 'the recording has no readings.'}"
        )
    rows = len(shown) + len(single) + poses
    axes = stacked(rows, title=title if reason is None else f"{title}\n{reason}", height_in=1.6 * rows + 0.8)
    origin = int(signals["imu"]["t_ns"][0])
    for axis, (name, table) in zip(axes, shown, strict=False):
        frame = signals[table]
        three(axis, seconds(frame["t_ns"], origin), matrix(frame, triad(name)))
        axis.set_ylabel(f"{name}\n({unit(units.get(name, 'unknown'))})")
        legend(axis)
    for axis, (table, column, label) in zip(axes[len(shown) :], single, strict=False):
        frame = signals[table]
        curve(axis, seconds(frame["t_ns"], origin), matrix(frame, [column])[:, 0], COLOURS[3])
        axis.set_ylabel(label.replace(" ", "\n", 1))
    for axis in axes[1 : rows - poses]:
        axis.sharex(axes[0])
    for axis in axes[: rows - poses - 1]:
        axis.tick_params(labelbottom=False)
    axes[rows - poses - 1].set_xlabel("time from the first IMU sample (s)")
    if poses:
        frame = signals["vps"]
        t = seconds(frame["t_ns"], int(frame["t_ns"][0]))
        three(axes[-1], t, matrix(frame, QUATERNION), ("ε₁", "ε₂", "ε₃", "δ"))
        axes[-1].set_ylabel("VPS quaternion\n(1)")
        axes[-1].set_xlabel("time from the first pose, VPS clock (s)")
        legend(axes[-1])
    return axes


def _any(table: pl.DataFrame | None, column: str) -> bool:
    """Whether the column has numbers."""
    return table is not None and bool(np.isfinite(matrix(table, [column])).any())
