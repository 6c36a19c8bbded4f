"""Write ROOT/site: what changed and nothing else; what is gone from the history goes from the site."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path

from fieldcal.provenance.run_key import code_digest
from fieldcal.report.fitness import Criteria, Fitness, fleet_fitness
from fieldcal.report.links import Links, flight_name, vehicle_name
from fieldcal.report.standing.memory import remembered_criteria
from fieldcal.site.drawing import Due, draw
from fieldcal.site.fleet_pages import compare_page, fleet_data, fleet_page, flights_page
from fieldcal.site.ledger import Ledger, Written, vehicle_digest
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
    return write_pages(
        snapshot, fleet_fitness(snapshot, criteria or remembered_criteria(root), now or datetime.now(UTC))
    )


def write_pages(snapshot: Snapshot, fitness: Mapping[str, Fitness], workers: int = 1) -> Path:
    """The same, of what is judged already; `workers` processes share the vehicles where many pages are to be drawn."""
    root = snapshot.root
    prepare(root)
    flights = snapshot.scan("flight").select("vehicle_id", "flight_id").collect()
    names = {INDEX, *(vehicle_name(one) for one in fitness), *(flight_name(one) for one in flights["flight_id"])}
    links = Links(root / SITE, frozenset(names), INDEX)
    written = Written(root / SITE)
    ledgers = Ledger.all_of(root)
    code = code_digest()
    due = []
    for vehicle_id, one in fitness.items():
        ledger = ledgers.get(vehicle_id) or Ledger(root, vehicle_id)
        of = vehicle_digest(snapshot, one, code)
        if ledger.of != of or not all(written.has(files) for files in (ledger.files, *ledger.of_flights.values())):
            every = flights.filter(vehicle_id=vehicle_id)["flight_id"]
            own = (flight for flight in every if flight in ledger.of_flights or at_hand(root, flight))
            due.append(Due(one, tuple(own), of))
    draw(snapshot, due, links, code, workers)
    ledgers |= {one.fitness.vehicle_id: Ledger.of_vehicle(root, one.fitness.vehicle_id) for one in due}
    _fleet(snapshot, fitness, links, written)
    for vehicle_id, ledger in ledgers.items():
        if vehicle_id in fitness:
            written.keep(ledger)
        else:
            ledger.forget()
    written.remove_others()
    return root / SITE / INDEX


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
