"""Write ROOT/site: what changed and nothing else; what is gone from the history goes from the site."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path

from fieldcal.provenance.run_key import code_digest
from fieldcal.report.fitness import Criteria, Fitness, fleet_fitness
from fieldcal.report.links import Links, flight_name, vehicle_name
from fieldcal.report.standing.memory import remembered_criteria
from fieldcal.site.fleet_pages import compare_page, fleet_data, fleet_page, flights_page
from fieldcal.site.ledger import Ledger, Written, flight_digest, vehicle_digest
from fieldcal.site.pages import ASSETS, DATA, Frame, asset, html
from fieldcal.site.script_data import script
from fieldcal.site.snapshot import Snapshot
from fieldcal.site.vehicle_pages import flight_files, vehicle_files
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


def write_pages(snapshot: Snapshot, fitness: Mapping[str, Fitness]) -> Path:
    """The same, of what is judged already."""
    root = snapshot.root
    prepare(root)
    flights = snapshot.scan("flight").select("vehicle_id", "flight_id").collect()
    names = {INDEX, *(vehicle_name(one) for one in fitness), *(flight_name(one) for one in flights["flight_id"])}
    links = Links(root / SITE, frozenset(names), INDEX)
    written = Written(root / SITE)
    ledgers = Ledger.all_of(root)
    code = code_digest()
    for vehicle_id, one in fitness.items():
        ledger = ledgers.pop(vehicle_id, None) or Ledger(root, vehicle_id)
        every = flights.filter(vehicle_id=vehicle_id)["flight_id"]
        own = [flight for flight in every if flight in ledger.of_flights or at_hand(root, flight)]
        _vehicle(snapshot, one, own, links, ledger, written, code)
    _fleet(snapshot, fitness, links, written)
    for ledger in ledgers.values():
        ledger.forget()
    written.remove_others()
    return root / SITE / INDEX


def _vehicle(
    snapshot: Snapshot,
    one: Fitness,
    flights: list[str],
    links: Links,
    ledger: Ledger,
    written: Written,
    code: str,
) -> None:
    """The vehicle's pages and its flights', where what they show, or the code that makes them, is another."""
    of = vehicle_digest(snapshot, one, code)
    if ledger.of == of and all(written.has(files) for files in (ledger.files, *ledger.of_flights.values())):
        written.keep(ledger)
        return
    seen = {}
    for flight_id in flights:
        digest = flight_digest(snapshot, one.vehicle_id, flight_id, code)
        files = ledger.of_flights.get(flight_id, {})
        if ledger.flights.get(flight_id) != digest or not written.has(files):
            files = written.put(flight_files(snapshot, one.vehicle_id, flight_id, links), files)
        seen[flight_id] = (digest, files)
    files = written.put(vehicle_files(snapshot, one, links), ledger.files)
    ledger.remember(of, files, seen)
    written.keep(ledger)


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
