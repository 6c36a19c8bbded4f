"""Plots as SVG that lives inside a page: matplotlib draws, and its colours become the page's CSS variables.

So one drawing serves light, dark and print, its text stays text, and equal data give equal bytes.
"""

from __future__ import annotations

import hashlib
import io
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import chain
from typing import TYPE_CHECKING, Literal

import numpy as np
import numpy.typing as npt
from markupsafe import Markup, escape

from fieldcal.geometry.rotation import Array
from fieldcal.words.printable import printable

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.typing import RcKeyType
    from mpl_toolkits.mplot3d import Axes3D

INK = {
    name: f"#fe01{number:02x}"
    for number, name in enumerate(("fg", "muted", "line", "c1", "c2", "c3", "c4", "warn"), start=1)
}
"""Colours to draw with, by the name of the CSS variable that stands in their place on the page."""

Across = Array | npt.NDArray[np.datetime64] | npt.NDArray[np.object_]
"""Where points lie along an axis, (n,): numbers, or moments."""

XYZ = (INK["c1"], INK["c2"], INK["c3"])
BUCKETS = 500
"""A curve keeps the least and the greatest of so many equal shares of its samples: no peak is lost."""

_WIDTH_IN = 9.6
_STYLE: dict[RcKeyType, object] = {
    "svg.fonttype": "none",
    "timezone": "UTC",
    "font.size": 9,
    "axes.edgecolor": INK["muted"],
    "axes.labelcolor": INK["fg"],
    "axes.titlecolor": INK["fg"],
    "axes.titlesize": 9,
    "axes.linewidth": 0.6,
    "axes.facecolor": "none",
    "axes.grid": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.xmargin": 0.02,
    "axes.formatter.useoffset": False,
    "axes.formatter.limits": (-3, 5),
    "axes3d.grid": True,
    "grid.color": INK["line"],
    "grid.linewidth": 0.5,
    "xtick.color": INK["muted"],
    "ytick.color": INK["muted"],
    "xtick.labelcolor": INK["fg"],
    "ytick.labelcolor": INK["fg"],
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
    "text.color": INK["fg"],
    "lines.linewidth": 1.0,
    "lines.solid_joinstyle": "round",
    "figure.facecolor": "none",
    "savefig.facecolor": "none",
}


@contextmanager
def page_style() -> Iterator[None]:
    """All drawing of a page happens inside: its style, and nothing of the user's own settings."""
    import matplotlib as mpl

    with mpl.rc_context():
        mpl.rcdefaults()
        mpl.rcParams.update(_STYLE)
        yield


def panels(
    rows: int, columns: int, *, height_in: float, sharex: bool | Literal["col"] = False
) -> tuple[Figure, list[list[Axes]]]:
    """A figure of the page's width with (rows, columns) panels, by row."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

    figure = Figure(figsize=(_WIDTH_IN, height_in))
    axes: list[list[Axes]] = figure.subplots(rows, columns, squeeze=False, sharex=sharex).tolist()
    left, right, bottom, top, between = 0.75, 0.15, 0.5, 0.35, 0.32
    panel_in = (height_in - bottom - top) / (rows + between * (rows - 1))
    for axis in chain.from_iterable(axes):
        # Places of titles and labels are told: matplotlib spends long seeking them, and told ones are in line.
        axis.set_title("", y=1.0)
        axis.xaxis.set_label_coords(0.5, -0.32 / panel_in)
        axis.yaxis.set_label_coords(-0.07 * columns, 0.5)
        ticks = axis.yaxis.get_major_locator()
        assert isinstance(ticks, MaxNLocator)
        ticks.set_params(nbins=5)
        axis.yaxis.get_offset_text().set_x(-0.06 * columns)  # left of the title
    figure.subplots_adjust(
        left=left / _WIDTH_IN,
        right=1 - right / _WIDTH_IN,
        bottom=bottom / height_in,
        top=1 - top / height_in,
        wspace=0.22,
        hspace=between,
    )
    return figure, axes


def solid_panels(columns: int, *, height_in: float) -> tuple[Figure, list[Axes3D]]:
    """A figure of the page's width with three-dimensional panels."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(_WIDTH_IN, height_in))
    axes: list[Axes3D] = [figure.add_subplot(1, columns, i + 1, projection="3d") for i in range(columns)]
    for axis in axes:
        for own in (axis.xaxis, axis.yaxis, axis.zaxis):
            own.set_pane_color((0, 0, 0, 0))
            own._axinfo["grid"].update(color=INK["line"], linewidth=0.5)
    figure.subplots_adjust(left=0.02, right=0.95, bottom=0.06, top=0.92, wspace=0.12)
    return figure, axes


def svg(figure: Figure, name: str, title: str, description: str) -> Markup:
    """The figure as inline SVG, an image to assistive technology, with `title` and `description` as its text.

    `name` is the salt of its inner ids: the same at every run, others than those of the page's
    other figures.
    """
    import matplotlib as mpl

    out = io.StringIO()
    mpl.rcParams["svg.hashsalt"] = name
    figure.savefig(out, format="svg", metadata={"Date": None, "Creator": None})
    return Markup(_themed(out.getvalue(), name, title, description))


def _themed(text: str, name: str, title: str, description: str) -> str:
    own = "f" + hashlib.sha256(name.encode()).hexdigest()[:8]
    text = text[text.index("<svg") :]
    text = re.sub(r"\s*<metadata>.*?</metadata>", "", text, flags=re.S)
    text = re.sub(r"<style[^>]*>.*?</style>", "", text, flags=re.S)
    text = re.sub(r"<!--.*?-->\n?", "", text, flags=re.S)
    text = re.sub(r'<g id="[^"]*"', "<g", text)
    text = text.replace("xlink:href", "href")
    text = re.sub(r"font: *([\d.]+px)[^;\"]*", r"font-size: \1", text)
    text = re.sub(r"font-family:[^;\"]*;? ?", "", text)
    text = re.sub(r"<[^>]*>", lambda tag: re.sub(r"\d+\.\d{3,}", _short, tag[0]), text)
    for variable, colour in INK.items():
        text = text.replace(colour, f"var(--{variable})")
    text = re.sub(r"\n\s*", "\n", text)
    text = re.sub(r"<g([^>]*)>\n((?:<use [^>]*/>\n)+)</g>", _one_style, text)
    box = re.search(r'viewBox="([^"]*)"', text)
    size = box[1] if box else "0 0 1 1"
    opening = (
        f'<svg class="plot" xmlns="http://www.w3.org/2000/svg" viewBox="{size}" role="img"'
        f' aria-labelledby="{own}-t {own}-d"><title id="{own}-t">{escape(title)}</title>'
        f'<desc id="{own}-d">{escape(description)}</desc>'
    )
    return re.sub(r"^<svg[^>]*>", lambda _: opening, text, count=1).rstrip()


def _one_style(group: re.Match[str]) -> str:
    """Markers of one group with their common style said once."""
    styles = set(re.findall(r' style="([^"]*)"', group[2]))
    if len(styles) != 1:
        return group[0]
    marks = re.sub(r' style="[^"]*"', "", group[2])
    return f'<g{group[1]} style="{styles.pop()}">\n{marks}</g>'


def _short(number: re.Match[str]) -> str:
    """A coordinate to a hundredth of a point."""
    return f"{float(number[0]):.2f}".rstrip("0").rstrip(".")


def headed(axis: Axes, text: str) -> None:
    """Name a panel, above its left corner."""
    axis.set_title(text, loc="left", fontsize=9, color=INK["fg"], parse_math=False)


def legend(axis: Axes, columns: int = 4, *, inside: Literal["lower left"] | None = None) -> None:
    """Name a panel's curves: above its right corner, where no curve is, or at a place `inside`."""
    axis.legend(
        loc=inside or "lower right",
        bbox_to_anchor=(0.0, 0.0, 1.0, 1.0) if inside else (1.0, 1.0),
        ncols=columns,
        fontsize=8,
        frameon=False,
        labelcolor=INK["fg"],
        borderpad=0.1,
        borderaxespad=0.1,
        handlelength=1.4,
        columnspacing=1.2,
    )


def legend_below(figure: Figure, axis: Axes) -> None:
    """Name the curves of an axis for all panels, below them."""
    handles, labels = axis.get_legend_handles_labels()
    figure.legend(
        handles,
        labels,
        fontsize=8,
        frameon=False,
        labelcolor=INK["fg"],
        borderpad=0.1,
        loc="lower center",
        bbox_to_anchor=(0.5, 0.0),
        ncols=len(labels),
    )
    figure.subplots_adjust(bottom=0.85 / figure.get_figheight())


def curve(
    axis: Axes, t: Array, x: Array, colour: str, *, label: str | None = None, width: float = 1.0, dashes: str = "-"
) -> None:
    """A sampled curve, thinned by its least and greatest, broken where samples are missing."""
    axis.plot(*thinned(*with_gaps(t, x)), color=colour, label=label, linewidth=width, linestyle=dashes)


def backdrop(axis: Axes, t: Array, x: Array, label: str) -> None:
    """The curve that others are compared with: broad and pale, so that a thin one shows on it."""
    axis.plot(*thinned(*with_gaps(t, x)), color=INK["c1"], alpha=0.4, label=label, linewidth=3.2)


def without_wraps(angle: Array) -> Array:
    """Angles (n,) in rad with a NaN in place of each sample after a jump of more than π: no line runs across it."""
    out = angle.copy()
    out[1:][np.abs(np.diff(angle)) > np.pi] = np.nan
    return out


def with_gaps(t: Array, x: Array) -> tuple[Array, Array]:
    """(n,) stamps and values with a NaN wherever the next sample is more than 10 median intervals (0.1 s) away."""
    if len(t) < 3:
        return t, x
    step = np.diff(t)
    after = np.flatnonzero(step > max(10.0 * float(np.median(step)), 0.1)) + 1
    return np.insert(t, after, t[after - 1]), np.insert(x, after, np.nan)


def thinned(t: Array, x: Array, buckets: int = BUCKETS) -> tuple[Array, Array]:
    """The least and the greatest of each of `buckets` shares of (n,) samples, in order of time; gaps (NaN) are kept."""
    n = len(x)
    if n <= 4 * buckets:
        return t, x
    width = -(-n // buckets)
    padded = np.full(width * -(-n // width), np.nan)
    padded[:n] = x
    share = padded.reshape(-1, width)
    first = np.arange(len(share)) * width
    low = first + np.argmin(np.where(np.isnan(share), np.inf, share), axis=1)
    high = first + np.argmax(np.where(np.isnan(share), -np.inf, share), axis=1)
    keep = np.unique(np.concatenate([low, high, np.flatnonzero(np.isnan(x))]))
    keep = keep[keep < n]
    return t[keep], x[keep]


def sparkline(values: Sequence[float], marked: int | None, label: str) -> Markup:
    """A line of a few values without axes for a table's cell; the last one is a dot, `marked` starts after a step."""
    width, height, pad = 120.0, 28.0, 4.0
    x = np.linspace(pad, width - pad, max(len(values), 2))[-len(values) :]
    low, high = min(values), max(values)
    span = high - low
    y = [height / 2 if span == 0 else height - pad - (height - 2 * pad) * (value - low) / span for value in values]
    points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x, y, strict=True))
    step = "" if marked is None else f'<line class="step" x1="{x[marked]:.1f}" x2="{x[marked]:.1f}" y1="0" y2="28"/>'
    return Markup(
        f'<svg class="spark" viewBox="0 0 {width:.0f} {height:.0f}" width="{width:.0f}" height="{height:.0f}"'
        f' role="img" aria-label="{escape(printable(label))}">{step}<polyline points="{points}"/>'
        f'<circle cx="{x[-1]:.1f}" cy="{y[-1]:.1f}" r="2.5"/></svg>'
    )
