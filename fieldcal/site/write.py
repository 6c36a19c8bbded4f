"""Write ROOT/site: what changed and nothing else; what is gone from the history goes from the site."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path

import polars as pl

from fieldcal.provenance.run_key import code_digest
from fieldcal.report.fitness import Criteria, Fitness, fleet_fitness
from fieldcal.report.links import Links, flight_name, vehicle_name
from fieldcal.report.standing.memory import remembered_criteria
from fieldcal.site.drawing import Drawing, Due
from fieldcal.site.fleet_pages import compare_page, fleet_data, fleet_page, flights_page
from fieldcal.site.ledger import Ledger, Written, flights_digest, vehicle_digest
from fieldcal.site.pages import ASSETS, DATA, Frame, asset, html
from fieldcal.site.script_data import script
from fieldcal.site.snapshot import Snapshot
from fieldcal.warehouse.layout import SITE, prepare
from fieldcal.warehouse.questions import existing
from fieldcal.warehouse.remote.pages import at_hand

INDEX = "index.html"
ALWAYS = f"{DATA}/fleet.js"


def write_site(root: Path, criteria: Criteria | None = None, *, now: datetime | None = None) -> Path:
    """Bring the site up to the history; the path of its first page. The caller holds the fleet's lock.

    Parameters
    ----------
    criteria
        By what vehicles are judged; else as in the last night.
    now
        Ages count to this moment.

    Raises
    ------
    WarehouseError
        `no_warehouse`; `damaged_file`; the disk's refusal.
    """
    existing(root)
    snapshot = Snapshot(root)
    fitness = fleet_fitness(snapshot, criteria or remembered_criteria(root), now or datetime.now(UTC))
    with Drawing(root, 1) as drawing:
        return write_pages(snapshot, fitness, drawing)


def draw_ahead(root: Path, drawing: Drawing) -> None:
    """Begin with the pages of flights that the history has news of: they show nothing of the fleet's trends."""
    prepare(root)
    flights, ledgers, code = _flights(Snapshot(root)), Ledger.all_of(root), code_digest()
    due = []
    for vehicle_id in sorted(flights["vehicle_id"].unique()):
        ledger = ledgers.get(vehicle_id) or Ledger(root, vehicle_id)
        drawn = _drawn(ledger, flights)
        if ledger.drawn_of != flights_digest(root, vehicle_id, drawn, code):
            due.append(Due(vehicle_id, drawn))
    drawing.begin(due, _links(root, flights), code)


def write_pages(snapshot: Snapshot, fitness: Mapping[str, Fitness], drawing: Drawing) -> Path:
    """The same as `write_site`, of what is judged already."""
    root = snapshot.root
    prepare(root)
    flights, ledgers, code = _flights(snapshot), Ledger.all_of(root), code_digest()
    links = _links(root, flights)
    written = Written(root / SITE)
    due = []
    for vehicle_id, one in fitness.items():
        ledger = ledgers.get(vehicle_id) or Ledger(root, vehicle_id)
        of = vehicle_digest(snapshot, one, code)
        if ledger.of != of or not all(written.has(files) for files in (ledger.files, *ledger.of_flights.values())):
            due.append(Due(vehicle_id, _drawn(ledger, flights), one, of))
    drawing.draw(snapshot, due, links, code)
    ledgers |= {one.vehicle_id: Ledger.of_vehicle(root, one.vehicle_id) for one in due}
    _fleet(snapshot, fitness, links, written)
    for vehicle_id, ledger in ledgers.items():
        if vehicle_id in fitness:
            written.keep(ledger)
        else:
            ledger.forget()
    written.remove_others()
    return root / SITE / INDEX


def _flights(snapshot: Snapshot) -> pl.DataFrame:
    return snapshot.scan("flight").select("vehicle_id", "flight_id").collect()


def _links(root: Path, flights: pl.DataFrame) -> Links:
    """Pages of every vehicle that flew, and of its flights."""
    vehicles = (vehicle_name(one) for one in flights["vehicle_id"].unique())
    names = {INDEX, *vehicles, *(flight_name(one) for one in flights["flight_id"])}
    return Links(root / SITE, frozenset(names), INDEX)


def _drawn(ledger: Ledger, flights: pl.DataFrame) -> tuple[str, ...]:
    """Flights of a vehicle that have pages: of others what they show lies elsewhere, or is gone."""
    every = flights.filter(vehicle_id=ledger.vehicle_id)["flight_id"]
    return tuple(flight for flight in every if flight in ledger.of_flights or at_hand(ledger.root, flight))


def _fleet(snapshot: Snapshot, fitness: Mapping[str, Fitness], links: Links, written: Written) -> None:
    """Pages of the whole fleet, and what all pages share: compared with what is there."""
    data = script("fleet", fleet_data(snapshot, fitness))
    fleet = {"fleet": data}
    charted = ("site.js", "charts.js", "compare.js")
    files = {
        INDEX: html(fleet_page(snapshot, fitness, links), Frame("index", here=INDEX)),
        "flights.html": html(
            flights_page(links), Frame("flights", ("site.js", "fleet.js"), {"fleet": data}, here="flights.html")
        ),
        "compare.html": html(compare_page(links), Frame("compare", charted, fleet, here="compare.html")),
        ALWAYS: data,
        **{f"assets/{name}": asset(name) for name in ASSETS},
    }
    written.compare(files)
