"""`fieldcal prune`: what of a warehouse may go; it says first what is lost."""

from __future__ import annotations

from datetime import UTC, datetime

import fieldcal
from fieldcal.cli.options import AsJson, Root, UnusedConfig
from fieldcal.reason_codes import ReasonCode


def prune(
    *,
    stages: bool = False,
    signals_before: str | None = None,
    vehicle: str | None = None,
    yes: bool = False,
    as_json: AsJson = False,
    warehouse: Root = None,
    config: UnusedConfig = None,
) -> int:
    """Make room: remove what no night or question needs. Without --yes it only says what would go, and what is lost.

    Of itself it removes results of stages by settings, code or logs of before, with which nothing is lost.

    Parameters
    ----------
    stages
        All results of stages: the next night runs them again.
    signals_before
        Readings of flights that started before this date, 2026-05-04: logs are read again where they are needed.
    vehicle
        All that is kept of this vehicle, its history too.
    yes
        Remove it.
    """
    from fieldcal.cli.show import print_json
    from fieldcal.warehouse.lock import fleet_lock
    from fieldcal.warehouse.questions import existing, moment_of
    from fieldcal.warehouse.upkeep.prune import all_results, former_results, of_vehicle, remove
    from fieldcal.warehouse.upkeep.prune import signals_before as old_signals

    root = existing(fieldcal.Warehouse(warehouse).root).root
    removable = [all_results(root) if stages else former_results(root)]
    if signals_before is not None:
        moment = moment_of("--signals-before", signals_before)
        if moment > datetime.now(UTC):
            told = f"--signals-before {signals_before} has not come yet."
            raise fieldcal.FieldcalError(ReasonCode.WRONG_OPTION, told)
        removable.append(old_signals(root, moment))
    if vehicle is not None:
        removable.append(of_vehicle(root, vehicle))
    told_of = [
        {"what": one.what, "lost": one.lost, "files": len(one.files), "bytes": one.size_bytes} for one in removable
    ]
    lines = [
        f"{one.what}: {len(one.files)} files, {one.size_bytes / 1e6:.1f} MB. Lost is {one.lost}." for one in removable
    ]
    if yes:
        with fleet_lock(root):
            for one in removable:
                remove(root, one)
    if as_json:
        print_json({"removed": yes, "what": told_of})
        return 0
    print("\n".join(lines))
    if not yes:
        print("Nothing was removed: fieldcal prune --yes with the same options does.")
    return 0
