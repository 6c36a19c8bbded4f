"""Charts of a vehicle's page: what `report.vehicle_figures` draws on paper, as data."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import datetime

import numpy as np
import polars as pl

from fieldcal.geometry.rotation import Array
from fieldcal.names import Status
from fieldcal.report.page import Plot
from fieldcal.report.trend import days_after, predicted, warmed
from fieldcal.report.vehicle import Drawing
from fieldcal.report.vehicle_figures import COMPARED, SIGMAS, TOLD
from fieldcal.report.words import count
from fieldcal.schemas.columns import FLOWN_ORDER
from fieldcal.schemas.reference import REFERENCE_DEGC
from fieldcal.schemas.rows import DriftRow
from fieldcal.site.charts import Chart, Charts, Curve, Panel, View

EVERY = 10**9
DAY_S = 86400.0
LINE = 60
EPOCH = datetime.fromisoformat("1970-01-01T00:00:00+00:00")


def on_site(charts: Charts) -> Drawing:
    """Draw a vehicle's figures into `charts`, every flight of them."""

    def parameter(
        rows: pl.DataFrame, drift: Mapping[str, DriftRow], vehicle_id: str, name: str, anchor: str, most: int
    ) -> Plot:
        return _parameter(charts, rows, drift, vehicle_id, name, anchor)

    return Drawing(
        parameter, lambda fit, anchor: _agreement(charts, fit, anchor), lambda s, anchor: _lag(charts, s, anchor), EVERY
    )


def _parameter(
    charts: Charts, rows: pl.DataFrame, drift: Mapping[str, DriftRow], vehicle_id: str, name: str, anchor: str
) -> Plot:
    axes = sorted(rows["axis"].unique().to_list(), key=lambda axis: (len(axis), axis))
    told: set[str] = set()
    panels = {
        axis: _panels(rows.filter(pl.col("axis") == axis), axis, drift.get(axis), vehicle_id, told) for axis in axes
    }
    dated = bool(rows["started_at"].is_not_null().any())
    warm = rows["temperature_degc"].is_not_null().any()
    told |= set() if warm else {"cold"}
    views = []
    for what, of in (("", [a for a in axes if len(a) <= 1]), ("matrix, ", [a for a in axes if len(a) > 1])):
        if of:
            views.append(
                View(f"{what}against time", "time (UTC)" if dated else "flight", [panels[a][0] for a in of], dated)
            )
        if of and warm:
            views.append(View(f"{what}against temperature", "temperature (°C)", [panels[a][1] for a in of]))
    n = rows.filter(pl.col("axis") == axes[0]).height
    sentences = [f"{name}: {count(n, 'flight')}, error bars ±1σ.", *(text for key, text in TOLD.items() if key in told)]
    return charts.plot(Chart(anchor, name, views), " ".join(sentences))


def _panels(
    rows: pl.DataFrame, axis: str, trend: DriftRow | None, vehicle_id: str, told: set[str]
) -> tuple[Panel, Panel]:
    """One axis, against time and against temperature; what the caption has to tell goes into `told`."""
    trend = None if trend is None or trend["value_at_25degc"] is None else trend
    told.add("plain" if trend is None else "trend")
    moments: list[datetime | None] = rows["started_at"].to_list()
    used = (rows["status"] == Status.OK).to_numpy()
    dated = [m for m in moments if m is not None]
    last = max((m for m, ok in zip(moments, used, strict=True) if m is not None and ok), default=None)
    reference = (None if trend is None else trend["as_of"]) or last or (max(dated) if dated else EPOCH)
    days = days_after(moments, reference)
    degc, value = (rows[c].cast(pl.Float64).fill_null(float("nan")).to_numpy() for c in ("temperature_degc", "value"))
    sd = rows["sd"].cast(pl.Float64).fill_null(0.0).to_numpy()
    at_25, at_last = value, value
    before, changed = np.zeros(len(value), dtype=bool), None
    if trend is not None:
        at_25 = value - np.nan_to_num(warmed(trend, degc))
        at_last = value - np.nan_to_num((trend["slope_per_day"] or 0.0) * days)
        changed = trend["change_at"]
    if changed is not None:
        told.add("step")
        before = days < days_after([changed], reference)[0]
    x = _time(days, reference, told) if dated else np.arange(1.0, len(value) + 1)
    elsewhere = (rows["vehicle_id"] != vehicle_id).to_numpy()
    masks = {
        ("flights", "points"): used & ~before & ~elsewhere,
        ("before the step", "before"): used & before & ~elsewhere,
        ("on another vehicle", "open"): used & elsewhere,
        ("refused", "refused"): ~used,
    }
    if (used & elsewhere).any():
        told.add("elsewhere")
    if (~used & np.isfinite(value)).any():
        told.add("refused")
    ids = rows["flight_id"].to_numpy()
    own_unit = str(rows["unit"][0])
    in_time, in_warmth = _points(masks, x, at_25, sd, ids), _points(masks, degc, at_last, sd, ids)
    if trend is not None and dated:
        first = float(np.nanmin(days)) if changed is None else float(days_after([changed], reference)[0])
        line = np.linspace(first, 0.0, LINE)
        in_time.append(_band(_seconds(line, reference), predicted(trend, REFERENCE_DEGC, line)))
    known = degc[~np.isnan(degc) & used]
    if trend is not None and known.size:
        warm = np.linspace(known.min(), known.max(), LINE)
        in_warmth.append(_band(warm, predicted(trend, warm, 0.0)))
    marked = None if changed is None or not dated else changed.timestamp()
    return Panel(axis, own_unit, in_time, marked), Panel(axis, own_unit, in_warmth)


def _time(days: Array, reference: datetime, told: set[str]) -> Array:
    """Seconds since 1970; flights without a date at the left edge."""
    if np.isnan(days).any():
        told.add("undated")
    first = float(np.nanmin(days))
    return _seconds(np.where(np.isnan(days), first - max(1.0, -0.03 * first), days), reference)


def _seconds(days: Array, reference: datetime) -> Array:
    return np.asarray(days) * DAY_S + reference.timestamp()


def _points(masks: Mapping[tuple[str, str], np.ndarray], x: Array, y: Array, sd: Array, ids: np.ndarray) -> list[Curve]:
    curves = []
    for (name, kind), mask in masks.items():
        shown = np.flatnonzero(mask & np.isfinite(y) & np.isfinite(x))
        shown = shown[np.argsort(x[shown], kind="stable")]
        if shown.size:
            curves.append(Curve(name, kind, x[shown], y[shown], sd[shown], of=ids[shown].tolist()))
    return curves


def _band(x: Array, line: tuple[Array, Array]) -> Curve:
    value, sd = line
    return Curve(f"trend ±{SIGMAS:.0f}σ", "trend", x, value, low=value - SIGMAS * sd, high=value + SIGMAS * sd)


def _agreement(charts: Charts, fit: pl.DataFrame, anchor: str) -> Plot | None:
    smoothed = fit.filter(pl.col("signal") == "smoothed", pl.col("tic").is_not_null()).sort(FLOWN_ORDER)
    tics: list[Curve] = []
    degrees: list[Curve] = []
    for quantity, method, reference, label in COMPARED:
        own = smoothed.filter(pl.col("quantity") == quantity)
        own = own if not method else own.filter(pl.col("method") == method)
        is_vps = pl.col("reference") == "vps"
        own = own.filter(is_vps if reference == "vps" else ~is_vps)
        if own.is_empty():
            continue
        own, x = _dated(own)
        ids = own["flight_id"].to_list()
        tics.append(Curve(label, "joined", x, own["tic"].to_numpy(), of=ids))
        if own["rms_unit"][0] == "deg":
            degrees.append(Curve(label, "joined", x, own["rms"].to_numpy(), of=ids))
    if not tics:
        return None
    panels = [Panel("TIC (Eq. 16)", "", tics)]
    panels += [Panel("rms attitude error", "°", degrees)] if degrees else []
    dated = bool(smoothed["started_at"].is_not_null().any())
    view = View("against time", "time (UTC)" if dated else "flight", panels, dated)
    caption = (
        "Theil's coefficient flatters unit quaternions (TIC ≈ α/4 for an rms error α in rad), so degrees stand beside."
    )
    return charts.plot(Chart(anchor, "Agreement over the flights", [view]), caption)


def _dated(rows: pl.DataFrame) -> tuple[pl.DataFrame, Array]:
    """Rows and their x: those with a date where any has one, else the number of the flight."""
    if not rows["started_at"].is_not_null().any():
        return rows, np.arange(1.0, rows.height + 1)
    rows = rows.filter(pl.col("started_at").is_not_null()).sort("started_at")
    return rows, np.array([moment.timestamp() for moment in rows["started_at"]])


def _lag(charts: Charts, sync: pl.DataFrame, anchor: str) -> Plot | None:
    good = sync.filter(pl.col("status") == Status.OK, pl.col("lag_mid_s").is_not_null()).sort(FLOWN_ORDER)
    if good.is_empty():
        return None
    dated = bool(good["started_at"].is_not_null().any())
    good, x = _dated(good)
    ids = good["flight_id"].to_list()
    panels = [
        Panel(
            title,
            of_unit,
            [Curve("flights", "points", x, factor * _floats(good, v), factor * _floats(good, s), of=ids)],
        )
        for v, s, factor, title, of_unit in (
            ("lag_mid_s", "lag_sd_s", 1e3, "lag at mid-flight", "ms"),
            ("skew_ppm", "skew_sd_ppm", 1.0, "clock rate", "ppm"),
        )
    ]
    caption = f"VPS clock + lag = IMU clock; error bars ±1σ. {count(good.height, 'flight')}."
    view = View("against time", "time (UTC)" if dated else "flight", panels, dated)
    return charts.plot(Chart(anchor, "Clock of the VPS", [view]), caption)


def _floats(rows: pl.DataFrame, column: str) -> Array:
    return rows[column].cast(pl.Float64).fill_null(float("nan")).to_numpy()
