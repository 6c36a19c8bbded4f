"""Panels that every picture here is made of: few rules, so that all read alike."""

from __future__ import annotations

from itertools import chain
from typing import TYPE_CHECKING, Literal

from fieldcal.geometry.rotation import Array
from fieldcal.report.plot import thinned, with_gaps

if TYPE_CHECKING:
    from matplotlib.axes import Axes

COLOURS = ("tab:blue", "tab:orange", "tab:green", "tab:red", "tab:purple", "tab:brown", "tab:pink", "tab:olive")
REFUSED = "0.55"
WIDTH_IN, ROW_IN = 9.0, 2.2


def panels(
    rows: int,
    columns: int = 1,
    *,
    title: str = "",
    height_in: float | None = None,
    width_in: float = WIDTH_IN,
    sharex: bool | Literal["col"] = False,
    sharey: bool = False,
) -> list[list[Axes]]:
    """A new figure's axes, by row."""
    from matplotlib import pyplot

    size = (width_in, height_in or ROW_IN * rows + 0.6)
    figure, grid = pyplot.subplots(
        rows, columns, figsize=size, squeeze=False, layout="constrained", sharex=sharex, sharey=sharey
    )
    axes: list[list[Axes]] = grid.tolist()
    if title:
        figure.suptitle(title, fontsize="medium", parse_math=False)
    for axis in chain.from_iterable(axes):
        axis.grid(True, alpha=0.3, linewidth=0.6)
        axis.spines[["top", "right"]].set_visible(False)
        axis.ticklabel_format(axis="y", useOffset=False, scilimits=(-3, 5))
    return axes


def stacked(rows: int, *, title: str, height_in: float | None = None, sharex: bool = False) -> list[Axes]:
    """A new figure's axes, one below the other."""
    return [axis for (axis,) in panels(rows, title=title, height_in=height_in, sharex=sharex)]


def three(axis: Axes, t: Array, x: Array, names: tuple[str, ...] = ("x", "y", "z"), *, dashes: str = "-") -> None:
    """Curves of x (n, m) against t (n,) in one panel, broken where samples are missing, thinned to what can be seen."""
    for column, name, colour in zip(x.T, names, COLOURS, strict=False):
        curve(axis, t, column, colour, name, dashes=dashes)


def curve(
    axis: Axes, t: Array, x: Array, colour: str, name: str | None = None, *, width: float = 0.9, dashes: str = "-"
) -> None:
    """One curve."""
    axis.plot(*thinned(*with_gaps(t, x)), color=colour, label=name, linewidth=width, linestyle=dashes)


def legend(axis: Axes, columns: int = 4) -> None:
    """Name the curves above the panel's right corner, where none of them is."""
    axis.legend(
        loc="lower right",
        bbox_to_anchor=(1.0, 0.98),
        borderaxespad=0.0,
        ncols=columns,
        fontsize="small",
        frameon=False,
        handlelength=1.4,
        columnspacing=1.2,
    )


def told(axis: Axes, sentence: str) -> None:
    """A panel with nothing to draw says why."""
    import textwrap

    axis.set_axis_off()
    axis.text(0.5, 0.5, textwrap.fill(sentence, 34), ha="center", va="center", fontsize="small", parse_math=False)


def unit(text: str) -> str:
    """A unit as people write it."""
    return {"degC": "°C", "deg": "°", "1": "–", "": "–"}.get(text, text.replace("^2", "²"))
