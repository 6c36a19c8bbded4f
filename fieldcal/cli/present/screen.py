"""The screen: 80 columns unless it is wider, or all there is (`--wide`). Words wrap, numbers never break."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

from rich import box
from rich.cells import cell_len
from rich.console import Console
from rich.table import Table
from rich.text import Text

from fieldcal.cli.present.characters import for_stream
from fieldcal.words.printable import printable

if TYPE_CHECKING:
    from rich.console import ConsoleOptions, RenderResult

NARROW = 80
WIDE = 10_000
GAP = 2
LONG_WORD, LEAST_TEXT = 40, 12
"""A column of words keeps this long a word whole where it can, and this much of it where it must."""
_NUMBER = re.compile(r"\(?[+-]?\d[^ ]*( (±|\+-) [^ ]+)?( [^ ]+)?( (in 60 s|a turn|of heading))?")
NOTHING = ("", "–")


class Screen(Console):
    """A console whose lines of text are shown `printable`, in characters that it has."""

    def __init__(self, *, wide: bool = False) -> None:
        width = WIDE if wide else None if sys.stdout.isatty() else NARROW
        super().__init__(file=sys.stdout, width=width, highlight=False)
        self.is_wide = wide

    def print(self, *objects: object, **how: Any) -> None:
        """As rich does; what is text is no markup."""
        shown = (Text(for_stream(printable(one))) if isinstance(one, str) else one for one in objects)
        super().print(*shown, **how)


def console(*, wide: bool = False) -> Screen:
    """The screen of stdout."""
    return Screen(wide=wide)


class Listing:
    """A table that fits where it is printed: columns of words wrap, and where that is not enough the last columns are
    left out and named."""

    def __init__(
        self,
        columns: Sequence[str],
        rows: Iterable[Sequence[str]],
        title: str | None = None,
        *,
        drop_silent: bool = False,
    ) -> None:
        self.columns = [for_stream(printable(name)) for name in columns]
        self.rows = [[for_stream(printable(text)) for text in row] for row in rows]
        if drop_silent:
            says = [i for i in range(len(self.columns)) if any(row[i] not in NOTHING for row in self.rows)]
            self.columns = [self.columns[i] for i in says]
            self.rows = [[row[i] for i in says] for row in self.rows]
        self.title = title

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        widths = self._widths(options.max_width)
        shown = Table(
            box=box.SIMPLE_HEAD,
            title=None if self.title is None else Text(for_stream(printable(self.title))),
            title_justify="left",
            title_style="bold",
            pad_edge=False,
            padding=(0, 0, 0, 1),
            show_edge=False,
        )
        for i, width in enumerate(widths):
            is_number = self._numeric(i)
            shown.add_column(
                Text(self.columns[i]),
                justify="right" if is_number else "left",
                no_wrap=is_number,
                overflow="fold",
                min_width=width,
                max_width=width,
            )
        for row in self.rows:
            shown.add_row(*(Text(text) for text in row[: len(widths)]))
        yield Text("")
        yield shown
        if left := self.columns[len(widths) :]:
            yield Text(f"Not shown: {', '.join(left)} (--wide).")

    def _numeric(self, i: int) -> bool:
        cells = [row[i] for row in self.rows]
        return any(cell not in NOTHING for cell in cells) and all(
            cell in NOTHING or _NUMBER.fullmatch(cell) for cell in cells
        )

    def _widths(self, room: int) -> list[int]:
        """Width of each column that is shown."""
        whole = [max(map(cell_len, cells)) for cells in zip(self.columns, *self.rows, strict=False)]
        for longest in (LONG_WORD, LEAST_TEXT):
            least = [w if self._numeric(i) else min(w, self._longest_word(i, longest)) for i, w in enumerate(whole)]
            if sum(least) + GAP * (len(least) - 1) <= room:
                break
        while len(least) > 1 and sum(least) + GAP * (len(least) - 1) > room:
            least.pop()
        spare = room - sum(least) - GAP * (len(least) - 1)
        for i in sorted(range(len(least)), key=lambda i: whole[i] - least[i]):
            more = min(max(spare, 0), whole[i] - least[i])
            least[i], spare = least[i] + more, spare - more
        return [min(width, room) for width in least]

    def _longest_word(self, i: int, most: int) -> int:
        words = [cell_len(word) for row in self.rows for word in row[i].split()]
        return max(min(max(words, default=1), most), cell_len(self.columns[i]))


def table(
    columns: Sequence[str], rows: Iterable[Sequence[str]], title: str | None = None, *, drop_silent: bool = False
) -> Listing:
    """A table for people; numbers keep to the right. `drop_silent`: without columns in which no row says anything."""
    return Listing(columns, rows, title, drop_silent=drop_silent)
