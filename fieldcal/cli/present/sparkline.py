"""A series as a word of small bars, on terminals that have them and on those that have ASCII."""

from __future__ import annotations

from collections.abc import Sequence

BARS = "▁▂▃▄▅▆▇█"
"""Each has its own plain character in `characters.PLAIN`."""
NONE = " "
MOST = 40


def sparkline(values: Sequence[float | None], most: int = MOST) -> str:
    """The latest values, a bar each, from the least to the greatest of them.

    Examples
    --------
    >>> sparkline([1.0, 2.0, None, 3.0]), sparkline([2.0, 2.0]), sparkline([])
    ('▁▅ █', '▅▅', '')
    """
    shown = values[-most:]
    known = [value for value in shown if value is not None and value == value]
    if not known:
        return ""
    least, span = min(known), max(known) - min(known)
    top = len(BARS) - 1
    return "".join(
        NONE if value is None or value != value else BARS[round(top * (value - least) / span) if span else 4]
        for value in shown
    )
