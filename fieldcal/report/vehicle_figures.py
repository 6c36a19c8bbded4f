"""Figures of a vehicle's history: parameters against time and temperature, agreement, and the clock of its VPS."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import datetime, timedelta
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import polars as pl

from fieldcal.geometry.rotation import Array
from fieldcal.names import Status
from fieldcal.report.page import Plot
from fieldcal.report.plot import INK, XYZ, Across, headed, legend_below, panels, svg
from fieldcal.report.trend import days_after, predicted, warmed
from fieldcal.report.words import count, day
from fieldcal.schemas.columns import FLOWN_ORDER
from fieldcal.schemas.reference import REFERENCE_DEGC
from fieldcal.schemas.rows import DriftRow

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MOST_POINTS = 250
"""Flights in a panel; fewer where a page has more panels."""

SIGMAS = 2.0
MARGIN = 0.15
_ROW_IN = 1.35


TOLD = {
    "trend": f"Line and band: the regression of table drift ±{SIGMAS:.0f}σ; points against time are reduced to"
    f" {REFERENCE_DEGC:g} °C, those against temperature to the time of the last flight.",
    "plain": "Values as estimated; table drift has no regression of it.",
    "step": "Dashed vertical line: detected step; grey points lie before it.",
    "refused": "Crosses: refused, not used.",
    "outside": "Triangles: beyond the panel.",
    "elsewhere": "Open circles: the same IMU on another vehicle.",
    "undated": "Flights without a known date are at the left edge.",
    "cold": "The logs have no temperature.",
}
"""What a caption says of what its figure shows."""


def parameter_plot(
    rows: pl.DataFrame, drift: Mapping[str, DriftRow], vehicle_id: str, name: str, anchor: str, most: int
) -> Plot:
    """One parameter of one triad, a row of panels an axis: against time, and (where logged) against temperature.

    `rows` are those of `calibration` of one IMU, sensor, method and parameter, in order of time; `drift` has the
    regression of an axis where there is one, and `most` is how many flights are shown, the latest.
    """
    names = sorted(rows["axis"].unique().to_list())
    warm = rows["temperature_degc"].is_not_null().any()
    figure, axes = panels(len(names), 2 if warm else 1, height_in=_ROW_IN * len(names) + 0.85, sharex="col")
    told: set[str] = set() if warm else {"cold"}
    for row, axis_name in zip(axes, names, strict=True):
        own = rows.filter(pl.col("axis") == axis_name).tail(most)
        told |= _panel_row(row, own, drift.get(axis_name), vehicle_id)
        own_unit = own["unit"][0]
        row[0].set_ylabel(f"{axis_name} ({own_unit})" if own_unit else axis_name, parse_math=False)
    headed(axes[0][0], f"{name} against time")
    if warm:
        headed(axes[0][1], f"{name} against temperature")
        axes[-1][1].set_xlabel("temperature (°C)")
    n = rows.filter(pl.col("axis") == names[0]).height
    shown = count(n, "flight") if n <= most else f"the latest {most} of {n} flights"
    sentences = [f"{name}: {shown}, error bars ±1σ.", *(sentence for key, sentence in TOLD.items() if key in told)]
    description = f"{name}, {shown}, axes {', '.join(names)}, against time{' and temperature' if warm else ''}"
    return Plot(anchor, svg(figure, anchor, name, description), " ".join(sentences))


def _panel_row(axes: list[Axes], rows: pl.DataFrame, trend: DriftRow | None, vehicle_id: str) -> set[str]:
    """One axis; what its caption has to tell."""
    from matplotlib.dates import date2num

    trend = None if trend is None or trend["value_at_25degc"] is None else trend
    told = {"plain" if trend is None else "trend"}
    moments: list[datetime | None] = rows["started_at"].to_list()
    used = (rows["status"] == Status.OK).to_numpy()
    dated = [m for m in moments if m is not None]
    last = max((m for m, ok in zip(moments, used, strict=True) if m is not None and ok), default=None)
    stated = None if trend is None else trend["as_of"]
    reference = stated or last or (max(dated) if dated else datetime(1970, 1, 1))
    days = days_after(moments, reference)
    degc, value = (rows[c].cast(pl.Float64).fill_null(float("nan")).to_numpy() for c in ("temperature_degc", "value"))
    sd = rows["sd"].cast(pl.Float64).fill_null(0.0).to_numpy()
    elsewhere = (rows["vehicle_id"] != vehicle_id).to_numpy()
    at_25, at_last, changed = value, value, None
    before = np.zeros(len(value), dtype=bool)
    if trend is not None:
        at_25 = value - np.nan_to_num(warmed(trend, degc))
        at_last = value - np.nan_to_num((trend["slope_per_day"] or 0.0) * days)
        changed = trend["change_at"]
    if changed is not None:
        told.add("step")
        before = days < days_after([changed], reference)[0]
    if dated and np.isnan(days).any():
        told.add("undated")
    first = float(np.nanmin(days)) if dated else 0.0
    when = np.where(np.isnan(days), first - max(1.0, -0.03 * first), days)
    x = _dates_at(when, reference) if dated else np.arange(1.0, len(value) + 1)
    for axis, across, y in zip(axes, (x, degc), (at_25, at_last), strict=False):
        told |= _points(axis, across, y, sd, used, before, elsewhere)
    if trend is not None and dated:
        line = np.linspace(first if changed is None else days_after([changed], reference)[0], 0.0, 60)
        _band(axes[0], _dates_at(line, reference), predicted(trend, REFERENCE_DEGC, line))
    known = degc[~np.isnan(degc) & used]
    if trend is not None and known.size and len(axes) > 1:
        warm = np.linspace(known.min(), known.max(), 60)
        _band(axes[1], warm, predicted(trend, warm, 0.0))
    if changed is not None and dated:
        axes[0].axvline(date2num(changed), color=INK["warn"], linewidth=1.0, linestyle=(0, (4, 2)))
    if dated:
        _dates(axes[0])
    else:
        axes[0].set_xlabel("flight")
    return told


def _dates_at(days: Array, reference: datetime) -> npt.NDArray[np.object_]:
    """Moments so many days after the reference, for an axis."""
    return np.array([reference + timedelta(days=float(d)) for d in days])


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
    axis: Axes,
    x: Across,
    y: Array,
    sd: Array,
    used: np.ndarray,
    before: np.ndarray,
    elsewhere: np.ndarray,
) -> set[str]:
    low, high = _limits(y[used], sd[used])
    axis.set_ylim(low, high)
    inside = (y >= low) & (y <= high)
    told = set()
    for mask, colour, marker, face in (
        (used & inside & before & ~elsewhere, INK["muted"], "o", INK["muted"]),
        (used & inside & ~before & ~elsewhere, INK["c1"], "o", INK["c1"]),
        (used & inside & elsewhere, INK["c1"], "o", "none"),
    ):
        if mask.any():
            _bars(axis, x[mask], y[mask], sd[mask], colour)
            axis.plot(x[mask], y[mask], marker, markersize=3.5, color=colour, markerfacecolor=face, linestyle="none")
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


def _bars(axis: Axes, x: Across, y: Array, sd: Array, colour: str) -> None:
    """Error bars of (n,) points, as one line with gaps."""
    across = np.repeat(x, 3)
    along = np.column_stack([y - sd, y + sd, np.full(len(y), np.nan)]).ravel()
    axis.plot(across, along, color=colour, linewidth=0.7)


def _band(axis: Axes, x: Across, line: tuple[Array, Array]) -> None:
    value, sd = line
    axis.fill_between(x, value - SIGMAS * sd, value + SIGMAS * sd, color=INK["c2"], alpha=0.18, linewidth=0)
    axis.plot(x, value, color=INK["c2"], linewidth=1.4)


def _dates(axis: Axes) -> None:
    from matplotlib import dates

    locator = dates.AutoDateLocator(minticks=3, maxticks=7)
    axis.xaxis.set_major_locator(locator)
    axis.xaxis.set_major_formatter(dates.ConciseDateFormatter(locator))


def _x_of(moments: list[datetime | None]) -> tuple[Across, bool]:
    """Dates for an axis; the number of the flight where no date is known. Undated flights among dated ones are NaT."""
    if not any(moments):
        return np.arange(1.0, len(moments) + 1), False
    return np.array(
        [np.datetime64("NaT") if m is None else np.datetime64(m.replace(tzinfo=None)) for m in moments]
    ), True


COMPARED = (
    ("attitude", "", "vps", "attitude against VPS"),
    ("quaternion_rate", "equation_error", "", "quaternion rate, equation error"),
    ("attitude_propagated", "output_error", "", "propagated attitude against QUEST"),
    ("attitude_propagated", "output_error", "vps", "the same against VPS"),
    ("body_rate", "output_error", "vps", "body rate against VPS, output error"),
)


def agreement_plot(fit: pl.DataFrame, anchor: str) -> Plot | None:
    """Theil inequality coefficients and rms errors over the flights, smoothed readings."""
    smoothed = fit.filter(pl.col("signal") == "smoothed", pl.col("tic").is_not_null()).sort(FLOWN_ORDER)
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
    figure, axes = panels(1, 2, height_in=3.2)
    for number, (own, label) in enumerate(curves):
        x, dated = _x_of(own["started_at"].to_list())
        colour = (*XYZ, INK["c4"], INK["fg"])[number]
        for axis, column in ((axes[0][0], "tic"), (axes[0][1], "rms")):
            if column == "tic" or own["rms_unit"][0] == "deg":
                y, marker = own[column].to_numpy(), "osD^v"[number]
                axis.plot(x, y, color=colour, marker=marker, markersize=3.5, linewidth=0.9, label=label)
        for axis in axes[0]:
            if dated:
                _dates(axis)
            else:
                axis.set_xlabel("flight")
    headed(axes[0][0], "TIC (Eq. 16)")
    headed(axes[0][1], "rms attitude error (°)")
    axes[0][0].set_yscale("log")
    axes[0][1].set_ylim(bottom=0)
    legend_below(figure, axes[0][0])
    title = "Agreement over the flights"
    caption = (
        "Theil's coefficient flatters unit quaternions (TIC ≈ α/4 for an rms error α in rad), so degrees stand beside."
    )
    return Plot(anchor, svg(figure, anchor, title, f"{title}: {', '.join(label for _, label in curves)}"), caption)


def lag_plot(sync: pl.DataFrame, anchor: str) -> Plot | None:
    """The VPS clock's lag at mid-flight and its rate over the flights."""
    good = (
        sync.filter(pl.col("status") == Status.OK, pl.col("lag_mid_s").is_not_null())
        .sort(FLOWN_ORDER)
        .tail(MOST_POINTS)
    )
    if good.is_empty():
        return None
    figure, axes = panels(1, 2, height_in=2.6)
    x, dated = _x_of(good["started_at"].to_list())
    for axis, value, sd, factor, title in (
        (axes[0][0], "lag_mid_s", "lag_sd_s", 1e3, "lag at mid-flight (ms)"),
        (axes[0][1], "skew_ppm", "skew_sd_ppm", 1.0, "clock rate (ppm)"),
    ):
        y = factor * good[value].to_numpy()
        _bars(axis, x, y, factor * good[sd].fill_null(0.0).to_numpy(), INK["c1"])
        axis.plot(x, y, "o", markersize=3.5, color=INK["c1"], linestyle="none")
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
