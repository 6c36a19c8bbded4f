"""Write reports below ROOT/reports: whole, atomically, and only where something changed."""

from __future__ import annotations

import hashlib
from collections.abc import Collection
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from fieldcal.report.links import FLEET, Links, flight_name, vehicle_name
from fieldcal.report.page import Page, html
from fieldcal.warehouse.checksums import problem, recording
from fieldcal.warehouse.files import write_bytes
from fieldcal.warehouse.layout import SITE, prepare

if TYPE_CHECKING:
    from fieldcal.flight.calibrate import CalibratedLog
    from fieldcal.report.flight_data import FlightData

FOLDER = "reports"


def write_fleet_report(root: Path, *, as_of: datetime | None = None) -> Path:
    """Write the fleet's page; its path. `as_of` is the moment that ages count to, by default the newest flight's start.

    Raises
    ------
    FieldcalError
        `no_warehouse`.
    """
    return fleet_report(root, _place(root, FLEET), as_of=as_of)


def write_vehicle_report(root: Path, vehicle_id: str, *, as_of: datetime | None = None) -> Path:
    """Write a vehicle's page; its path.

    Raises
    ------
    FieldcalError
        `no_warehouse`; `not_found`: there is no such vehicle, the nearest known ones are told.
    """
    return vehicle_report(root, vehicle_id, _place(root, vehicle_name(vehicle_id)), as_of=as_of)


def write_flight_report(root: Path, flight_id: str) -> Path:
    """Write a flight's page; its path. `flight_id` may be cut short while it stays unique, or be the log's `log_uri`.

    Raises
    ------
    FieldcalError
        `no_warehouse`; `not_found`: there is no such flight, or more than one.
    """
    return flight_report(root, flight_id)


def write_night_reports(
    root: Path, vehicles: Collection[str], on_site: Collection[str] = (), *, as_of: datetime | None = None
) -> list[Path]:
    """Write the pages of `vehicles` and the fleet's, linked to each other and to pages of vehicles `on_site`; paths,
    the fleet's first."""
    expected = frozenset({FLEET, *(vehicle_name(vehicle) for vehicle in vehicles)})
    own = [
        vehicle_report(root, vehicle, _place(root, vehicle_name(vehicle)), as_of=as_of, expected=expected)
        for vehicle in sorted(vehicles)
    ]
    beside = frozenset(map(vehicle_name, on_site))
    return [fleet_report(root, _place(root, FLEET), as_of=as_of, expected=expected, on_site=beside), *own]


def fleet_report(
    root: Path,
    path: Path | None,
    *,
    as_of: datetime | None = None,
    expected: frozenset[str] = frozenset(),
    on_site: frozenset[str] | None = None,
) -> Path:
    """The fleet's page in the file `path` (default below ROOT/reports, where it links to the site)."""
    from fieldcal.report.fleet import fleet_page

    path = path or _place(root, FLEET)
    if on_site is None:
        there = (root / SITE).glob("vehicle-*.html") if path == _place(root, FLEET) else ()
        on_site = frozenset(page.name for page in there)
    return _write(path, fleet_page(root, Links(path.parent, expected, on_site=on_site), as_of))


def vehicle_report(
    root: Path,
    vehicle_id: str,
    path: Path | None,
    *,
    as_of: datetime | None = None,
    expected: frozenset[str] = frozenset(),
) -> Path:
    """A vehicle's page in the file `path` (default below ROOT/reports)."""
    from fieldcal.report.plot import page_style
    from fieldcal.report.vehicle import vehicle_page

    path = path or _place(root, vehicle_name(vehicle_id))
    with page_style():
        page = vehicle_page(root, vehicle_id, Links(path.parent, expected), as_of)
    return _write(path, page)


def flight_report(root: Path, flight_id: str, path: Path | None = None) -> Path:
    """A flight's page in the file `path` (default below ROOT/reports)."""
    from fieldcal.report.flight_data import read_flight

    data = read_flight(root, flight_id)
    return _flight(data, path or _place(root, flight_name(data.flight["flight_id"])))


def log_report(log: CalibratedLog, path: Path) -> Path:
    """The page of a log calibrated in memory, in the file `path`."""
    from fieldcal.report.flight_data import of_log

    return _flight(of_log(log), path)


def _flight(data: FlightData, path: Path) -> Path:
    from fieldcal.report.flight import flight_page
    from fieldcal.report.plot import page_style

    with page_style():
        page = flight_page(data, Links(path.parent))
    return _write(path, page)


def _place(root: Path, name: str) -> Path:
    return root / FOLDER / name


def _write(path: Path, page: Page) -> Path:
    data = html(page).encode("utf-8")
    recorded, wrong = None, None
    if path.parent.name == FOLDER:
        root = path.parent.parent
        prepare(root)
        recorded = partial(recording, root, path, dispensable=True)
        wrong = problem(root, path, hashlib.sha256(data).hexdigest())
    if wrong is not None or not path.is_file() or path.read_bytes() != data:
        write_bytes(path, data, recorded)
    return path
