"""Frames of the warehouse: parameters, trends, agreement and clocks over many flights."""

from __future__ import annotations

from datetime import timedelta
from itertools import chain
from typing import TYPE_CHECKING

import numpy as np
import polars as pl

from fieldcal.geometry.rotation import Array
from fieldcal.plots.panels import COLOURS, REFUSED, legend, panels, stacked, unit
from fieldcal.report.plot import Across
from fieldcal.report.trend import predicted
from fieldcal.report.words import plain_name, preferred
from fieldcal.schemas.reference import REFERENCE_DEGC
from fieldcal.schemas.rows import DriftRow
from fieldcal.words.rows import typed

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MOST_CURVES = 8
SIGMAS = 2.0
YEAR_DAYS = 365.0


def plot_frame(frame: pl.DataFrame, sensor: str | None, parameter: str | None) -> list[Axes]:
    """The picture that the frame's columns ask for."""
    columns = set(frame.columns)
    if frame.is_empty():
        raise ValueError("the frame has no rows to draw")
    if {"value_at_25degc", "slope_per_day", "as_of"} <= columns:
        return plot_drift(*_chosen(frame, sensor, parameter))
    if {"parameter", "axis", "value", "sd", "status", "method"} <= columns:
        return plot_history(*_chosen(frame, sensor, parameter))
    if {"quantity", "tic", "rms"} <= columns:
        return plot_agreement(frame)
    if {"lag_mid_s", "skew_ppm"} <= columns:
        return plot_clocks(frame)
    raise ValueError(
        "a frame of the tables calibration (or the history), drift, fit or sync is wanted, with all their columns; this"
        f" has {', '.join(frame.columns)}"
    )


def plot_history(rows: pl.DataFrame, title: str) -> list[Axes]:
    """Rows of one sensor and parameter, a panel an axis, a colour a unit: values ±1 sd over the flights."""
    names = sorted(rows["axis"].unique().to_list())
    axes = stacked(len(names), title=title, sharex=True)
    identity = "unit_id" if "unit_id" in rows.columns else "method"
    shown = rows[identity].unique(maintain_order=True).to_list()
    for axis, name in zip(axes, names, strict=True):
        here = rows.filter(pl.col("axis") == name)
        for number, own in enumerate(shown[:MOST_CURVES]):
            part = here.filter(pl.col(identity) == own, pl.col("status") == "ok", pl.col("value").is_not_null())
            y, sd = part["value"].to_numpy(), part["sd"].fill_null(0.0).to_numpy()
            _bars(axis, _x(part, rows), y, sd, COLOURS[number], str(own))
        limits = axis.get_ylim()
        refused = here.filter(pl.col("status") != "ok", pl.col("value").is_not_null())
        axis.plot(_x(refused, rows), refused["value"].to_numpy(), "x", ms=5, color=REFUSED)
        if (here["status"] == "ok").any():  # a refused value may be far off: it does not set the limits
            axis.set_ylim(limits)
        axis.set_ylabel(f"{name} ({unit(rows['unit'][0])})")
    _when(axes[-1], rows)
    if len(shown) > 1:
        legend(axes[0], MOST_CURVES // 2)
    return axes


def plot_drift(rows: pl.DataFrame, title: str) -> list[Axes]:
    """Rows of one sensor and parameter, a row of panels an axis, a colour a unit: the trend over time and over
    temperature, ±2 sd, as far as it was flown."""
    names = sorted(rows["axis"].unique().to_list())
    axes = panels(len(names), 2, title=title, sharex="col", width_in=11.0)
    shown = rows["unit_id"].unique(maintain_order=True).to_list()[:MOST_CURVES]
    for (in_time, warm), name in zip(axes, names, strict=True):
        for colour, own in zip(COLOURS, shown, strict=False):
            for row in typed(
                rows.filter(pl.col("axis") == name, pl.col("unit_id") == own).iter_rows(named=True), DriftRow
            ):
                if row["value_at_25degc"] is None:
                    continue
                _trend_in_time(in_time, row, colour, f"{own}: {row['status']}")
                _trend_over_temperature(warm, row, colour)
        in_time.set_ylabel(f"{name} at 25 °C ({unit(rows['unit'][0])})")
        legend(in_time, 3)
    in_time, warm = axes[-1]
    _dates(in_time)
    in_time.set_xlabel("date")
    warm.set_xlabel("temperature (°C)")
    return list(chain.from_iterable(axes))


def plot_agreement(rows: pl.DataFrame) -> list[Axes]:
    """Theil's coefficient and rms error of each comparison: over the flights, or side by side for one."""
    rows = rows.filter(pl.col("tic").is_not_null())
    if "flight_id" in rows.columns and rows["flight_id"].n_unique() > 1:
        return _agreement_over_flights(rows)
    lines = rows.sort("quantity", "method", "reference", "signal", "sample").to_dicts()
    names = [
        f"{plain_name(r['quantity'])}, {plain_name(r['method'])}\n{r['signal']}, {r['sample']}, against"
        f" {plain_name(r['reference'])}"
        for r in lines
    ]
    axes = panels(1, 2, title="Agreement", height_in=0.42 * len(lines) + 1.2, sharey=True, width_in=11.0)[0]
    at = np.arange(len(lines))
    axes[0].barh(at, [r["tic"] for r in lines], color=COLOURS[0], height=0.6)
    axes[0].set_yticks(at, names, fontsize="x-small")
    axes[0].invert_yaxis()
    axes[0].set_xlabel("Theil inequality coefficient (0 perfect, 1 no likeness)")
    axes[1].set_xlabel("rms error, unit beside the bar")
    axes[1].set_xscale("log")
    axes[1].barh(at, [r["rms"] for r in lines], color=COLOURS[1], height=0.6)
    for i, row in enumerate(lines):
        axes[1].text(row["rms"], i, f" {row['rms']:.3g} {unit(row['rms_unit'])}", va="center", fontsize="x-small")
    axes[1].margins(x=0.25)
    return axes


def _agreement_over_flights(rows: pl.DataFrame) -> list[Axes]:
    smoothed = rows.filter(pl.col("signal") == "smoothed", pl.col("sample") == "all")
    keys = smoothed.select("quantity", "method", "reference").unique(maintain_order=True).rows()
    axes = stacked(2, title="Agreement over the flights, smoothed readings", height_in=6.0, sharex=True)
    for number, (quantity, method, reference) in enumerate(keys[:MOST_CURVES]):
        own = smoothed.filter(quantity=quantity, method=method, reference=reference)
        label = f"{plain_name(quantity)}, {plain_name(method)} / {plain_name(reference)}"
        _dots(axes[0], _x(own, rows), own["tic"].to_numpy(), COLOURS[number], label)
        if own["rms_unit"][0] == "deg":
            _dots(axes[1], _x(own, rows), own["rms"].to_numpy(), COLOURS[number])
    axes[0].set_ylabel("Theil coefficient (1)")
    axes[0].set_yscale("log")
    axes[1].set_ylabel("rms attitude error (°)")
    axes[0].legend(fontsize="x-small", frameon=False, loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=2)
    _when(axes[1], rows)
    return axes


def plot_clocks(rows: pl.DataFrame) -> list[Axes]:
    """Lag at mid-flight and drift of the VPS's clock over the flights, ±1 sd."""
    good = rows.filter(pl.col("status") == "ok", pl.col("lag_mid_s").is_not_null())
    if good.is_empty():
        raise ValueError("no flight of the frame has a VPS clock that was not refused")
    axes = stacked(2, title="Clock of the VPS: VPS clock + lag = IMU clock", height_in=5.0, sharex=True)
    for axis, value, sd, factor, label in (
        (axes[0], "lag_mid_s", "lag_sd_s", 1e3, "lag at mid-flight (ms)"),
        (axes[1], "skew_ppm", "skew_sd_ppm", 1.0, "drift (ppm)"),
    ):
        y, bar = factor * good[value].to_numpy(), factor * good[sd].fill_null(0.0).to_numpy()
        _bars(axis, _x(good, good), y, bar, COLOURS[0])
        axis.set_ylabel(label)
    _when(axes[1], good)
    return axes


def _chosen(frame: pl.DataFrame, sensor: str | None, parameter: str | None) -> tuple[pl.DataFrame, str]:
    """The rows of one sensor, parameter and the most exact method, in order of time; and what they are."""
    sensors = frame["sensor"].unique(maintain_order=True).to_list()
    sensor = sensor or str(sensors[0])
    own = frame.filter(pl.col("sensor") == sensor)
    parameters = own["parameter"].unique(maintain_order=True).to_list()
    parameter = parameter or ("scale" if "scale" in parameters else str(parameters[0]) if parameters else "scale")
    own = own.filter(pl.col("parameter") == parameter)
    if own.is_empty():
        raise ValueError(
            f"the frame has no {parameter} of sensor {sensor}; it has sensors {', '.join(sensors)}, and of this one"
            f" {', '.join(parameters) or 'nothing'}"
        )
    method = preferred(set(own["method"].to_list()))
    own = own.filter(pl.col("method") == method)
    if "started_at" in own.columns:
        own = own.sort("started_at", nulls_last=True, maintain_order=True)
    return own, f"{sensor}: {parameter}, {plain_name(method)}"


def _trend_in_time(axis: Axes, row: DriftRow, colour: str, label: str) -> None:
    """From the step, or as long before the mean flight as the last one is after it, to the last flight."""
    from matplotlib.dates import date2num

    as_of, level = row["as_of"], row["value_at_25degc"]
    if as_of is None:
        axis.plot([], [], color=colour, label=label)
        if level is not None:
            axis.axhline(level, color=colour)
        return
    span = YEAR_DAYS
    if row["best_known_at"] is not None:
        span = max(2.0 * (as_of - row["best_known_at"]).total_seconds() / 86400.0, 1.0)
    if row["change_at"] is not None:
        span = min(span, (as_of - row["change_at"]).total_seconds() / 86400.0)
        axis.axvline(date2num(row["change_at"]), color=colour, linestyle=":", linewidth=1.2)
    days = np.linspace(-span, 0.0, 60)
    value, sd = predicted(row, REFERENCE_DEGC, days)
    x = np.array([as_of + timedelta(days=float(d)) for d in days])
    _band(axis, x, value, sd, colour, label)


def _trend_over_temperature(axis: Axes, row: DriftRow, colour: str) -> None:
    low, high, level = row["temperature_min_degc"], row["temperature_max_degc"], row["value_at_25degc"]
    if low is None or high is None or level is None:
        return
    if low == high:
        axis.errorbar([low], [level], [SIGMAS * (row["sd"] or 0.0)], fmt="o", capsize=3, color=colour)
        return
    degc = np.linspace(low, high, 60)
    value, sd = predicted(row, degc, 0.0)
    _band(axis, degc, value, sd, colour, None)


def _dots(axis: Axes, x: Across, y: Array, colour: str, label: str | None = None) -> None:
    axis.plot(x, y, marker="o", ms=3.5, ls="none", color=colour, label=label)


def _bars(axis: Axes, x: Across, y: Array, sd: Array, colour: str, label: str | None = None) -> None:
    axis.errorbar(x, y, sd, fmt="o", ms=4, lw=1.0, capsize=2, color=colour, label=label)


def _band(axis: Axes, x: Across, value: Array, sd: Array, colour: str, label: str | None) -> None:
    axis.fill_between(x, value - SIGMAS * sd, value + SIGMAS * sd, color=colour, alpha=0.15, linewidth=0)
    axis.plot(x, value, color=colour, linewidth=1.4, label=label)


def _x(part: pl.DataFrame, whole: pl.DataFrame) -> Across:
    """Dates where every flight of the whole frame has one, else the flight's number."""
    if _dated(whole):
        return part["started_at"].dt.convert_time_zone("UTC").dt.replace_time_zone(None).to_numpy()
    if "flight_id" not in whole.columns:
        return np.arange(part.height, dtype=float)
    number = {flight: i for i, flight in enumerate(whole["flight_id"].unique(maintain_order=True).to_list(), start=1)}
    return np.array([number[flight] for flight in part["flight_id"].to_list()])


def _dated(rows: pl.DataFrame) -> bool:
    return "started_at" in rows.columns and rows["started_at"].null_count() == 0


def _when(axis: Axes, rows: pl.DataFrame) -> None:
    """The time axis' ticks and label."""
    if _dated(rows):
        _dates(axis)
        axis.set_xlabel("start of the flight (UTC)")
    else:
        axis.set_xlabel("flight")


def _dates(axis: Axes) -> None:
    from matplotlib import dates

    locator = dates.AutoDateLocator(minticks=3, maxticks=8)
    axis.xaxis.set_major_locator(locator)
    axis.xaxis.set_major_formatter(dates.ConciseDateFormatter(locator))
