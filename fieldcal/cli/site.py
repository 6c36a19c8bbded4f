"""`fieldcal site`: the fleet as linked pages, brought up to the history."""

from __future__ import annotations

from fieldcal.cli.options import AsJson, Root, UnusedConfig


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

    root = existing(Warehouse(warehouse).root).root
    with fleet_lock(root):
        path = write_site(root)
    if as_json:
        print_json({"path": str(path)})
    else:
        print(path)
    return 0
