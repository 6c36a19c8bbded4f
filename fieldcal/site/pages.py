"""Pages of the site as files: the reports' pages in the site's frame, and those of the whole fleet."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import resources
from urllib.parse import quote

from markupsafe import Markup

from fieldcal.report.page import Page, content, environment

ASSETS = (
    "site.css",
    "site.js",
    "charts.js",
    "fleet.js",
    "compare.js",
    "uplot/uPlot.iife.min.js",
    "uplot/uPlot.min.css",
    "uplot/LICENSE",
)
DATA = "data"


@dataclass(frozen=True)
class Frame:
    """What a page has around it. `name`: its file without the ending; `scripts`: which assets run on it; `data`: names
    of the data that it loads, with their bytes; `download`: the file of what its figures show."""

    name: str
    scripts: Sequence[str] = ("site.js",)
    data: Mapping[str, bytes] | None = None
    download: str = ""
    here: str = ""


@cache
def asset(name: str) -> bytes:
    """A file that every page shares."""
    if name == "site.css":
        own = resources.files("fieldcal.report").joinpath("templates/style.css").read_bytes()
        return own + resources.files("fieldcal.site").joinpath("assets/site.css").read_bytes()
    return resources.files("fieldcal.site").joinpath("assets", name).read_bytes()


def html(page: Page, frame: Frame) -> bytes:
    """A page of the site."""
    charted = "charts.js" in frame.scripts
    scripts = (["uplot/uPlot.iife.min.js"] if charted else []) + list(frame.scripts)
    data = [f"{DATA}/{quote(name)}.js?v={_digest(text)}" for name, text in (frame.data or {}).items()]
    text = (
        environment("fieldcal.site")
        .get_template("site.html")
        .render(
            **content(page),
            styles=[address(name) for name in (["uplot/uPlot.min.css"] if charted else []) + ["site.css"]],
            scripts=[address(name) for name in scripts],
            data=data,
            name=frame.name,
            here=frame.here,
            download=Markup(quote(frame.download)),
        )
    )
    return text.encode()


def address(name: str) -> str:
    """Where a page finds an asset: its digest keeps browsers from showing an older one."""
    return f"assets/{name}?v={_digest(asset(name))}"


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:10]
