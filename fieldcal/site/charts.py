"""Figures of the site's pages as data, which a script draws; and what they show, as rows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import polars as pl
from markupsafe import Markup

from fieldcal.geometry.rotation import Array
from fieldcal.names import Json
from fieldcal.report.page import Plot
from fieldcal.words.printable import printable

DIGITS = 7


@dataclass(frozen=True)
class Curve:
    """Points of one panel: (n,) x and y in order of x, NaN where there is none.

    kind : "line" (y joined), "points", "refused" (crosses) or "open" (circles)
    sd : (n,) one standard deviation of points; low, high : (n,) a band about a line
    of : what each point is of, a flight's id
    """

    name: str
    kind: str
    x: Array
    y: Array
    sd: Array | None = None
    low: Array | None = None
    high: Array | None = None
    of: Sequence[str] = ()


@dataclass(frozen=True)
class Panel:
    """Curves above one another's x. `marked`: where a vertical line stands."""

    title: str
    unit: str
    curves: Sequence[Curve]
    marked: float | None = None


@dataclass(frozen=True)
class View:
    """Panels with x in common: `x_name` with its unit; x of a `time` are seconds since 1970, UTC."""

    name: str
    x_name: str
    panels: Sequence[Panel]
    time: bool = False


@dataclass(frozen=True)
class Chart:
    """A figure: one view, or several to choose from."""

    anchor: str
    title: str
    views: Sequence[View]


@dataclass
class Charts:
    """The charts of a page, in order."""

    drawn: list[Chart] = field(default_factory=list)

    def plot(self, chart: Chart, caption: str) -> Plot:
        """The place on the page where a chart is drawn."""
        self.drawn.append(chart)
        place = Markup('<div class="chart" data-chart="{}"></div>').format(chart.anchor)
        return Plot(chart.anchor, place, caption)

    def plain(self) -> list[Json]:
        """As JSON; texts are printable."""
        return [_plain(chart) for chart in self.drawn]

    def rows(self) -> pl.DataFrame:
        """What the charts show, a row a point: figure, view, panel, curve, flight_id, x, y, sd, low, high, unit."""
        columns: dict[str, list[object]] = {name: [] for name in _SCHEMA}
        for chart in self.drawn:
            for view in chart.views:
                for panel in view.panels:
                    for curve in panel.curves:
                        _add(columns, chart, view, panel, curve)
        return pl.DataFrame(columns, schema=_SCHEMA).with_columns(pl.col(pl.Float64).fill_nan(None))


_SCHEMA = {
    **dict.fromkeys(("figure", "view", "panel", "curve", "flight_id", "x_name"), pl.String),
    **dict.fromkeys(("x", "y", "sd", "low", "high"), pl.Float64),
    "unit": pl.String,
}


def _plain(chart: Chart) -> Json:
    xs: dict[int, int] = {}
    axes: list[Json] = []

    def place(view: View, x: Array) -> int:
        """Number of an x that curves have in common."""
        if id(x) not in xs:
            xs[id(x)] = len(axes)
            axes.append([round(float(v), 3) for v in x] if view.time else numbers(x))
        return xs[id(x)]

    views: list[Json] = [
        {
            "name": view.name,
            "x": printable(view.x_name),
            "time": view.time,
            "panels": [
                {
                    "title": printable(panel.title),
                    "unit": printable(panel.unit),
                    "marked": panel.marked,
                    "curves": [_curve(curve, place(view, curve.x)) for curve in panel.curves],
                }
                for panel in view.panels
            ],
        }
        for view in chart.views
    ]
    return {"id": chart.anchor, "title": printable(chart.title), "xs": axes, "views": views}


def _curve(curve: Curve, x: int) -> Json:
    told: dict[str, Json] = {"name": printable(curve.name), "kind": curve.kind, "x": x, "y": numbers(curve.y)}
    for name in ("sd", "low", "high"):
        values = getattr(curve, name)
        if values is not None:
            told[name] = numbers(values)
    if curve.of:
        told["of"] = list(curve.of)
    return told


def numbers(values: Array) -> list[Json]:
    """Values to seven digits; None where there is none."""
    values = np.asarray(values, dtype=float)
    size = np.abs(np.where(np.isfinite(values) & (values != 0.0), values, 1.0))
    power = DIGITS - 1 - np.floor(np.log10(size))
    low = np.minimum(power, 300.0)
    with np.errstate(over="ignore", invalid="ignore"):
        rounded = np.where(low >= 0, np.round(values * 10.0**low) / 10.0**low, np.round(values))
    return [v if ok else None for v, ok in zip(rounded.tolist(), np.isfinite(rounded).tolist(), strict=True)]


def _add(columns: Mapping[str, list[object]], chart: Chart, view: View, panel: Panel, curve: Curve) -> None:
    n = len(curve.x)
    for name, text in (
        ("figure", chart.title),
        ("view", view.name),
        ("panel", panel.title),
        ("curve", curve.name),
        ("x_name", view.x_name),
        ("unit", panel.unit),
    ):
        columns[name].extend([printable(text)] * n)
    columns["flight_id"].extend(curve.of or [None] * n)
    for name in ("x", "y", "sd", "low", "high"):
        values = getattr(curve, name)
        columns[name].extend([None] * n if values is None else np.asarray(values, dtype=float).tolist())
