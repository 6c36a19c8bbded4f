"""The files of one vehicle, and of one flight: page, data for its figures, and what is there to take away."""

from __future__ import annotations

from collections.abc import Callable
from urllib.parse import quote

import polars as pl

from fieldcal.errors import FieldcalError
from fieldcal.names import Json
from fieldcal.report.fitness import Fitness
from fieldcal.report.flight import flight_page
from fieldcal.report.flight_data import read_flight
from fieldcal.report.links import Links, flight_name, vehicle_name
from fieldcal.report.page import Notice, Page, Section, link
from fieldcal.report.vehicle import vehicle_page
from fieldcal.site.charts import Charts
from fieldcal.site.downloads import constants_files, figures_file
from fieldcal.site.fleet_pages import FOOTER, constants_data, with_standing
from fieldcal.site.flight_charts import SIGNALS, sections, wanted
from fieldcal.site.pages import DATA, Frame, html
from fieldcal.site.script_data import packed_script, shown
from fieldcal.site.snapshot import Snapshot
from fieldcal.site.vehicle_charts import on_site
from fieldcal.warehouse.questions import units_flown
from fieldcal.words.talk import say

SCRIPTS = ("site.js", "charts.js")


def vehicle_files(snapshot: Snapshot, one: Fitness, links: Links) -> dict[str, bytes]:
    """By their names below the site."""
    title, name = f"Vehicle {one.vehicle_id}", vehicle_name(one.vehicle_id)
    return _made(lambda: _vehicle(snapshot, one, links), title, name, links)


def flight_files(snapshot: Snapshot, vehicle_id: str, flight_id: str, links: Links) -> dict[str, bytes]:
    """By their names below the site."""
    title, name = f"Flight {flight_id} of {vehicle_id}", flight_name(flight_id)
    return _made(lambda: _flight(snapshot, vehicle_id, flight_id, links), title, name, links)


def _made(make: Callable[[], dict[str, bytes]], title: str, name: str, links: Links) -> dict[str, bytes]:
    """What is made; where a mistake of ours keeps a page from being made, a page that says so: nights go on."""
    try:
        return make()
    except FieldcalError:
        raise
    except Exception as error:
        told = f"This page could not be made ({type(error).__name__}: {error}). The history itself is whole."
        say(f"{title}: {told}")
        page = Page(title, [], [], [Section("failed", "Not made", [Notice(told)])], FOOTER, links.up())
        return _files(name.removesuffix(".html"), page, Charts(), [])


def _vehicle(snapshot: Snapshot, one: Fitness, links: Links) -> dict[str, bytes]:
    stem = vehicle_name(one.vehicle_id).removesuffix(".html")
    charts = Charts()
    page = vehicle_page(snapshot.root, one.vehicle_id, links, None, snapshot, on_site(charts))
    page = with_standing(page, one, f"compare.html#a={quote(stem, safe='')}")
    files, section = constants_files(snapshot, one.vehicle_id, stem)
    at_fly = next((i for i, own in enumerate(page.sections) if own.anchor == "fly"), 0) + 1
    whole = Page(
        page.title,
        page.lead,
        page.facts,
        [*page.sections[:at_fly], section, *page.sections[at_fly:]],
        page.footer,
        page.up,
    )
    flown = units_flown(snapshot, one.vehicle_id)
    latest = snapshot.sql("SELECT * FROM latest_calibration").join(flown, on=["unit_id", "sensor"], how="semi")
    told = constants_data(latest, "value_at_25degc")
    return files | _files(stem, whole, charts, told)


def _flight(snapshot: Snapshot, vehicle_id: str, flight_id: str, links: Links) -> dict[str, bytes]:
    stem = flight_name(flight_id).removesuffix(".html")
    charts = Charts()
    runs = snapshot.scan("run", vehicle_id=vehicle_id, flight_id=flight_id).filter("is_primary").collect()
    there = runs.filter(pl.col("status") == "ok")["stage"].to_list()
    data = read_flight(snapshot.root, flight_id, snapshot, wanted(there), SIGNALS)
    page = flight_page(data, links, lambda own: sections(own, charts))
    compare = link(f"compare.html#a={quote(stem, safe='')}", "compare")
    page = Page(page.title, page.lead, [*page.facts, ("beside others", compare)], page.sections, FOOTER, page.up)
    return _files(stem, page, charts, constants_data(data.calibration, "value"))


def _files(stem: str, page: Page, charts: Charts, constants: list[Json]) -> dict[str, bytes]:
    data = packed_script(stem, {"title": shown(page.title), "constants": constants, "charts": charts.plain()})
    figures = figures_file(charts)
    download = f"{DATA}/{stem}.parquet"
    files = {f"{DATA}/{stem}.js": data} | ({} if figures is None else {download: figures})
    frame = Frame(stem, SCRIPTS, {stem: data}, "" if figures is None else download)
    return {f"{stem}.html": html(page, frame), **files}
