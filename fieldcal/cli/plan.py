"""`fieldcal plan`: which half a minute of motion would tell most of a vehicle's constants."""

from __future__ import annotations

import fieldcal
from fieldcal.cli.options import AsJson, Root, UnusedConfig

SHOWN = 6
"""Constants beside the best manoeuvre, those that it helps most first."""


def plan(vehicle: str, /, *, as_json: AsJson = False, warehouse: Root = None, config: UnusedConfig = None) -> int:
    """What to fly next: the manoeuvre that would help most, and the standard deviations to expect after it.

    Parameters
    ----------
    vehicle
        The vehicle: its primary unit, by what all its flights know together (fieldcal pooled).
    """
    from dataclasses import asdict

    from fieldcal.cli.show import print_json

    found = fieldcal.Warehouse(warehouse).plan(vehicle)
    if as_json:
        print_json(asdict(found))
        return 0
    best = found.manoeuvres[0]
    print(f"{found.vehicle_id} ({found.unit_id}): {best.words}.")
    print(f"Constants not known well enough: {best.refused_now} now, {best.refused_after} after it.")
    for one in sorted(best.expected, key=lambda e: -(min(e.sd_now, 1e9) / e.sd_after))[:SHOWN]:
        now = "not known" if one.sd_now == float("inf") else f"sd {one.sd_now:.2g} {one.unit}"
        after = "not known" if one.sd_after == float("inf") else f"{one.sd_after:.2g} {one.unit}"
        print(f"  {one.constant}: {now} → {after} (limit {one.limit:.2g} {one.unit})")
    for other in found.manoeuvres[1:]:
        print(f"Or {other.words}: {other.refused_after} not known well enough, sd smaller by {other.gain:.2f}.")
    return 0
