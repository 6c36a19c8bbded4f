"""Figures of a vehicle's history: parameters against time and temperature, agreement, and the clock of its VPS."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import datetime, timedelta
from typing import Any

import numpy as np
import polars as pl

from fieldcal.rotation import Array
from flows.report.page import Plot
from flows.report.plot import INK, XYZ, headed, legend, panels, svg
from flows.report.trend import days_after, predicted
from flows.report.words import count, day, unit

MOST_POINTS = 400
SIGMAS = 2.0
MARGIN = 0.15
_ROW_IN = 1.35


def parameter_plot(
    rows: pl.DataFrame, drift: Mapping[str, Mapping[str, Any]], vehicle_id: str, name: str, anchor: str
) -> Plot:
    """One parameter of one triad, a row of panels an axis: against time, and against temperature.

    `rows` are those of `calibration` of one IMU, sensor, method and parameter, in order of time; `drift` has the
    regression of an axis where there is one.
    """
    axes_names = sorted(rows["axis"].unique().to_list())
    figure, axes = panels(len(axes_names), 2, height_in=_ROW_IN * len(axes_names) + 0.85, sharex="col")
    told: set[str] = set()
    for row, name_of_axis in enumerate(axes_names):
        own = rows.filter(pl.col("axis") == name_of_axis).tail(MOST_POINTS)
        told |= _panel_row(axes[row], own, drift.get(name_of_axis), vehicle_id, name_of_axis, unit(own["unit"][0]))
    headed(axes[0, 0], f"{name} against time")
    headed(axes[0, 1], f"{name} against temperature")
    axes[-1, 1].set_xlabel("temperature (°C)")
    shown = rows.filter(pl.col("axis") == axes_names[0]).height
    caption = [
        f"{name}: {count(min(shown, MOST_POINTS), 'flight')}"
        + (f" of {shown}, the latest" if shown > MOST_POINTS else "")
    ]
    caption[0] += ", error bars ±1σ."
    if "trend" in told:
        caption.append(
            f"Line and band: the regression of table drift ±{SIGMAS:.0f}σ; points on the left are reduced to 25 °C, on"
            " the right to the time of the last flight."
        )
    else:
        caption.append("Values as estimated; table drift has no regression of it.")
    if "step" in told:
        caption.append("Dashed vertical line: detected step; paler points lie before it.")
    if "refused" in told:
        caption.append("Crosses: refused, not used.")
    if "outside" in told:
        caption.append("Triangles: beyond the panel.")
    if "elsewhere" in told:
        caption.append("Open circles: the same IMU on another vehicle.")
    if "undated" in told:
        caption.append("Flights without a known date are at the left edge.")
    description = (
        f"{name}, {count(shown, 'flight')}, axes {', '.join(axes_names)}, against time and against temperature"
    )
    return Plot(anchor, svg(figure, anchor, name, description), " ".join(caption))


def _panel_row(
    axes: Any, rows: pl.DataFrame, trend: Mapping[str, Any] | None, vehicle_id: str, axis_name: str, own_unit: str
) -> set[str]:
    told: set[str] = set()
    moments: list[datetime | None] = rows["started_at"].to_list()
    dated = [m for m in moments if m is not None]
    used = (rows["status"] == "ok").to_numpy()
    reference = max((m for m, ok in zip(moments, used, strict=True) if m is not None and ok), default=None)
    reference = reference or (max(dated) if dated else datetime(1970, 1, 1))
    days = days_after(moments, reference)
    degc = rows["temperature_degc"].cast(pl.Float64).fill_null(float("nan")).to_numpy()
    value = rows["value"].cast(pl.Float64).fill_null(float("nan")).to_numpy()
    sd = rows["sd"].cast(pl.Float64).fill_null(0.0).to_numpy()
    has_trend = trend is not None and trend["value_at_25degc"] is not None
    at_25, at_last = value, value
    if has_trend and trend is not None:
        told.add("trend")
        at_25 = value - np.nan_to_num((trend["slope_per_degc"] or 0.0) * (degc - 25.0))
        at_last = value - np.nan_to_num((trend["slope_per_day"] or 0.0) * days)
    changed = None if trend is None else trend["change_at"]
    before = np.zeros(len(value), dtype=bool)
    if changed is not None:
        told.add("step")
        before = days < days_after([changed], reference)[0]
    elsewhere = (rows["vehicle_id"] != vehicle_id).to_numpy()
    # days become dates for the axis; flights without one stand before the first
    first = float(np.nanmin(days)) if dated else 0.0
    when = np.where(np.isnan(days), first - max(1.0, 0.03 * -first), days)
    if dated and np.isnan(days).any():
        told.add("undated")
    x_time = np.array([reference + timedelta(days=float(d)) for d in when]) if dated else np.arange(1.0, len(value) + 1)
    for axis, x, y in ((axes[0], x_time, at_25), (axes[1], degc, at_last)):
        told |= _points(axis, x, y, sd, used, before, elsewhere, _limits(y[used], sd[used]))
    if has_trend and trend is not None:
        start = first if changed is None else float(days_after([changed], reference)[0])
        line = np.linspace(start, 0.0, 60)
        _band(axes[0], np.array([reference + timedelta(days=float(d)) for d in line]), predicted(trend, 25.0, line))
        known = degc[~np.isnan(degc) & used]
        if known.size:
            warm = np.linspace(known.min(), known.max(), 60)
            _band(axes[1], warm, predicted(trend, warm, 0.0))
    if changed is not None and dated:
        axes[0].axvline(changed, color=INK["warn"], linewidth=1.0, linestyle=(0, (4, 2)))
    axes[0].set_ylabel(f"{axis_name} ({own_unit})" if own_unit else axis_name)
    if dated:
        _dates(axes[0])
    else:
        axes[0].set_xlabel("flight")
    if np.isnan(degc).all():
        axes[1].text(
            0.5,
            0.5,
            "no temperature in the logs",
            transform=axes[1].transAxes,
            ha="center",
            va="center",
            color=INK["muted"],
        )
        axes[1].set_xticks([])
    return told


def _limits(value: Array, sd: Array) -> tuple[float, float]:
    """Where the panel ends: what was used with its error bars, those of a very doubtful flight apart."""
    value = value[np.isfinite(value)]
    if not value.size:
        return 0.0, 1.0
    bar = float(np.median(sd)) if sd.size else 0.0
    low, high = float(value.min()) - bar, float(value.max()) + bar
    span = (high - low) or abs(high) or 1.0
    return low - MARGIN * span, high + MARGIN * span


def _points(
    axis: Any,
    x: Array,
    y: Array,
    sd: Array,
    used: np.ndarray,
    before: np.ndarray,
    elsewhere: np.ndarray,
    limits: tuple[float, float],
) -> set[str]:
    low, high = limits
    axis.set_ylim(low, high)
    inside = (y >= low) & (y <= high)
    told = set()
    for mask, colour, marker, face in (
        (used & inside & before & ~elsewhere, INK["muted"], "o", INK["muted"]),
        (used & inside & ~before & ~elsewhere, INK["c1"], "o", INK["c1"]),
        (used & inside & elsewhere, INK["c1"], "o", "none"),
    ):
        if mask.any():
            axis.errorbar(
                x[mask],
                y[mask],
                yerr=sd[mask],
                fmt=marker,
                markersize=3.5,
                color=colour,
                markerfacecolor=face,
                elinewidth=0.7,
            )
    refused = ~used & np.isfinite(y)
    if (refused & inside).any():
        axis.plot(x[refused & inside], y[refused & inside], "x", color=INK["muted"], markersize=4)
    edge = MARGIN * 0.3 * (high - low)
    for mask, marker, at in (
        (np.isfinite(y) & (y > high), "^", high - edge),
        (np.isfinite(y) & (y < low), "v", low + edge),
    ):
        if mask.any():
            told.add("outside")
            axis.plot(x[mask], np.full(int(mask.sum()), at), marker, color=INK["muted"], markersize=4, linestyle="none")
    if refused.any():
        told.add("refused")
    if (used & elsewhere).any():
        told.add("elsewhere")
    return told


def _band(axis: Any, x: Array, line: tuple[Array, Array]) -> None:
    value, sd = line
    axis.fill_between(x, value - SIGMAS * sd, value + SIGMAS * sd, color=INK["c2"], alpha=0.18, linewidth=0)
    axis.plot(x, value, color=INK["c2"], linewidth=1.4)


def _dates(axis: Any) -> None:
    from matplotlib import dates

    ticks: Any = dates
    locator = ticks.AutoDateLocator(minticks=3, maxticks=7)
    axis.xaxis.set_major_locator(locator)
    axis.xaxis.set_major_formatter(ticks.ConciseDateFormatter(locator))


def _x_of(moments: list[datetime | None]) -> tuple[Any, bool]:
    """Dates for an axis; the number of the flight where no date is known. Undated flights among dated ones are NaT."""
    if not any(moments):
        return np.arange(1.0, len(moments) + 1), False
    return np.array(
        [np.datetime64("NaT") if m is None else np.datetime64(m.replace(tzinfo=None)) for m in moments]
    ), True


COMPARED = (
    ("attitude", "", "vps", "attitude against VPS"),
    ("quaternion_rate", "equation_error", "", "quaternion rate, equation error"),
    ("attitude_propagated", "output_error", "", "propagated attitude, output error"),
    ("body_rate", "output_error", "vps", "body rate against VPS, output error"),
)


def agreement_plot(fit: pl.DataFrame, anchor: str) -> Plot | None:
    """Theil inequality coefficients and rms errors over the flights, smoothed readings."""
    smoothed = fit.filter(pl.col("signal") == "smoothed", pl.col("tic").is_not_null()).sort("started_at", "flight_id")
    curves = []
    for quantity, method, reference, label in COMPARED:
        own = smoothed.filter(pl.col("quantity") == quantity)
        own = own if not method else own.filter(pl.col("method") == method)
        is_vps = pl.col("reference") == "vps"
        own = own.filter(is_vps if reference == "vps" else ~is_vps)
        if own.height:
            curves.append((own.tail(MOST_POINTS), label))
    if not curves:
        return None
    figure, axes = panels(1, 2, height_in=3.1)
    for number, (own, label) in enumerate(curves):
        x, dated = _x_of(own["started_at"].to_list())
        colour = (*XYZ, INK["c4"])[number]
        style = {"color": colour, "marker": "osD^"[number], "markersize": 3.5, "linewidth": 0.9, "label": label}
        axes[0, 0].plot(x, own["tic"].to_numpy(), **style)
        if own["rms_unit"][0] == "deg":
            axes[0, 1].plot(x, own["rms"].to_numpy(), **style)
        for axis in axes[0]:
            if dated:
                _dates(axis)
            else:
                axis.set_xlabel("flight")
    headed(axes[0, 0], "TIC (Eq. 16)")
    headed(axes[0, 1], "rms attitude error (°)")
    for axis in axes[0]:
        axis.set_ylim(bottom=0)
    legend(axes[0, 1], 2)
    title = "Agreement over the flights"
    caption = (
        "Theil's coefficient flatters unit quaternions (TIC ≈ α/4 for an rms error α in rad), so degrees stand beside."
    )
    return Plot(anchor, svg(figure, anchor, title, f"{title}: {', '.join(label for _, label in curves)}"), caption)


def lag_plot(sync: pl.DataFrame, anchor: str) -> Plot | None:
    """The VPS clock's lag at mid-flight and its rate over the flights."""
    good = (
        sync.filter(pl.col("status") == "ok", pl.col("lag_mid_s").is_not_null())
        .sort("started_at", "flight_id")
        .tail(MOST_POINTS)
    )
    if good.is_empty():
        return None
    figure, axes = panels(1, 2, height_in=2.6)
    x, dated = _x_of(good["started_at"].to_list())
    for axis, value, sd, factor, title in (
        (axes[0, 0], "lag_mid_s", "lag_sd_s", 1e3, "lag at mid-flight (ms)"),
        (axes[0, 1], "skew_ppm", "skew_sd_ppm", 1.0, "clock rate (ppm)"),
    ):
        y = factor * good[value].to_numpy()
        axis.errorbar(
            x,
            y,
            yerr=factor * good[sd].fill_null(0.0).to_numpy(),
            fmt="o",
            markersize=3.5,
            color=INK["c1"],
            elinewidth=0.7,
        )
        headed(axis, title)
        if dated:
            _dates(axis)
        else:
            axis.set_xlabel("flight")
    lag = 1e3 * good["lag_mid_s"].to_numpy()
    scatter = f"{np.std(lag, ddof=1):.3g} ms" if len(lag) > 1 else "unknown with one flight"
    caption = (
        f"VPS clock + lag = IMU clock; error bars ±1σ. Scatter of the lag between flights (sd): {scatter}."
        f" Last flight shown: {day(good['started_at'][-1])}."
    )
    return Plot(
        anchor, svg(figure, anchor, "Clock of the VPS", "Lag and rate of the VPS clock over the flights"), caption
    )
