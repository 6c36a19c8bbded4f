"""What a report is made of, and its HTML: Jinja2 fills the templates and escapes every text that is not markup already.

A page is plain data: sections of `Text`, `Notice`, `Heading`, `Table`, `Plot` and `Folded`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib import resources
from typing import ClassVar

from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

import fieldcal
from fieldcal.names import DriftStatus, Standing, Status, Verdict
from fieldcal.words.printable import printable

GOOD: tuple[str, ...] = (Status.OK, DriftStatus.STABLE, Standing.FINE)
LOOK: tuple[str, ...] = (
    *(Verdict.PARTIAL, DriftStatus.DRIFTING, Status.REFUSED, DriftStatus.OUTLIER, "expired"),
    Standing.LOOK,
)
BAD: tuple[str, ...] = (Verdict.QUARANTINED, Verdict.REJECTED, Status.FAILED, DriftStatus.STEP, Standing.NOTHING)
STATUS_KIND: dict[str, str] = {
    **dict.fromkeys(GOOD, "ok"),
    **dict.fromkeys(LOOK, "look"),
    **dict.fromkeys(BAD, "bad"),
}


@dataclass(frozen=True)
class Text:
    """A paragraph."""

    kind: ClassVar = "text"
    text: str


@dataclass(frozen=True)
class Notice:
    """A paragraph that must not be overlooked."""

    kind: ClassVar = "notice"
    text: str


@dataclass(frozen=True)
class Heading:
    """A heading below the section's."""

    kind: ClassVar = "heading"
    text: str


@dataclass(frozen=True)
class Column:
    """A table's column: its name, and "n" (numbers, to the right), "id", "wide", "nowrap" or nothing."""

    name: str
    kind: str = ""


@dataclass(frozen=True)
class Table:
    """A table whose first column names its rows. `more` says what was left out."""

    kind: ClassVar = "table"
    caption: str
    columns: Sequence[Column]
    rows: Sequence[Sequence[str]]
    more: str = ""


@dataclass(frozen=True)
class Plot:
    """A drawing with its caption."""

    kind: ClassVar = "figure"
    anchor: str
    svg: Markup
    caption: str


Simple = Text | Table | Plot


@dataclass(frozen=True)
class Folded:
    """Parts behind a line that opens them."""

    kind: ClassVar = "folded"
    summary: str
    parts: Sequence[Simple]


Part = Text | Notice | Heading | Table | Plot | Folded


@dataclass(frozen=True)
class Section:
    """A heading with its parts."""

    anchor: str
    heading: str
    parts: Sequence[Part]


@dataclass(frozen=True)
class Page:
    """A whole report. `up` is (address, text) of the page above it."""

    title: str
    lead: Sequence[str]
    facts: Sequence[tuple[str, str]]
    sections: Sequence[Section]
    footer: str = ""
    up: tuple[str, str] | None = field(default=None)


def html(page: Page) -> str:
    """The page as one file that needs nothing else."""
    return environment().get_template("report.html").render(**content(page), style=_style())


def content(page: Page) -> dict[str, object]:
    """What every template shows of a page."""
    return {
        "title": page.title,
        "lead": page.lead,
        "facts": page.facts,
        "sections": page.sections,
        "footer": page.footer,
        "up": None if page.up is None else {"href": page.up[0], "text": page.up[1]},
        "version": fieldcal.__version__,
    }


def badge(status: str | None, words: str | None = None) -> Markup:
    """A status as a coloured word, or in `words`."""
    word = status or "unknown"
    return Markup('<span class="badge {}">{}</span>').format(STATUS_KIND.get(word, "none"), printable(words or word))


def link(href: str, text: str) -> Markup:
    """A link; `href` is a relative address made of encoded ids."""
    return Markup('<a href="{}">{}</a>').format(href, printable(text))


@cache
def environment(*beside: str) -> Environment:
    """Templates of the reports, and of packages `beside`, whose own come first."""
    return Environment(
        loader=ChoiceLoader([PackageLoader(name) for name in (*beside, "fieldcal.report")]),
        autoescape=True,
        finalize=_shown,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )


def _shown(value: object) -> object:
    """What a template puts out: names from logs without what is invisible or turns the line around."""
    return printable(value, keep="\n\t") if isinstance(value, str) and not isinstance(value, Markup) else value


@cache
def _style() -> Markup:
    return Markup(resources.files("fieldcal.report").joinpath("templates/style.css").read_text(encoding="utf-8"))
