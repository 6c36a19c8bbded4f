"""Pages: `fieldcal report`, of fleet, vehicle or flight, one offline HTML file; `fieldcal site`, all of them linked."""

from __future__ import annotations

from fieldcal.cli.options import AsJson, Output, Root, UnusedConfig
from fieldcal.reason_codes import ReasonCode


def report(
    *,
    vehicle: str | None = None,
    flight: str | None = None,
    output: Output = None,
    as_of: str | None = None,
    as_json: AsJson = False,
    warehouse: Root = None,
    config: UnusedConfig = None,
) -> int:
    """Write a report as one HTML file that needs no network: the fleet, or one vehicle, or one flight.

    Parameters
    ----------
    vehicle
        The page of this vehicle.
    flight
        The page of this flight: its id, the start of it, or its log's path in the archive.
    output
        File to write; else in the data root's folder reports.
    as_of
        Ages count to this moment, 2026-05-04 or 2026-05-04T12:00; else to the newest flight.
    """
    from fieldcal.cli.show import print_json
    from fieldcal.errors import FieldcalError
    from fieldcal.report import fleet_report, flight_report, vehicle_report
    from fieldcal.warehouse import Warehouse
    from fieldcal.warehouse.questions import moment_of

    if vehicle is not None and flight is not None:
        raise FieldcalError(ReasonCode.WRONG_OPTION, "Give --vehicle or --flight, not both: a report is of one thing.")
    root = Warehouse(warehouse).root
    moment = None if as_of is None else moment_of("--as-of", as_of)
    if flight is not None:
        path = flight_report(root, flight, output)
    elif vehicle is not None:
        path = vehicle_report(root, vehicle, output, as_of=moment)
    else:
        path = fleet_report(root, output, as_of=moment)
    if as_json:
        print_json({"path": str(path)})
    else:
        print(path)
    return 0


def site(*, as_json: AsJson = False, warehouse: Root = None, config: UnusedConfig = None) -> int:
    """Bring the site up to the history, as each night does: pages of the fleet, every vehicle and every flight, below
    the data root's folder site. They need no network, and open from a disk or from any web server. Only what changed is
    written; prints the first page's path.
    """
    from fieldcal.cli.show import print_json
    from fieldcal.site import write_site
    from fieldcal.warehouse import Warehouse
    from fieldcal.warehouse.lock import fleet_lock
    from fieldcal.warehouse.questions import existing
    from fieldcal.warehouse.remote.share import share

    root = existing(Warehouse(warehouse).root).root
    with fleet_lock(root):
        path = write_site(root)
        share(root)
    if as_json:
        print_json({"path": str(path)})
    else:
        print(path)
    return 0
