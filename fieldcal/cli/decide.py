"""`fieldcal withdraw` and `fieldcal accept`: what people decide about flights, and the history remembers."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Annotated, Literal

from cyclopts import Parameter

import fieldcal
from fieldcal.cli.options import AsJson, Root, UnusedConfig


@Parameter(name="*")
@dataclass(frozen=True)
class Meant:
    """What of the target is meant; else all of it.

    Parameters
    ----------
    session
        Only flights of this session.
    unit
        Only constants of this unit, by its unit_id.
    sensor
        Only this sensor's.
    parameter
        Only this parameter: scale, zero, bias, ...
    axis
        Only this axis.
    """

    session: str | None = None
    unit: str | None = None
    sensor: Literal["magnetometer", "accelerometer", "gyroscope"] | None = None
    parameter: str | None = None
    axis: str | None = None


ALL = Meant()
Reason = Annotated[str, Parameter(help="Why, for who reads it later.")]
Author = Annotated[str | None, Parameter(help="Who decides; else the user who runs this.")]


def withdraw(
    target: str,
    /,
    *,
    reason: Reason,
    meant: Meant = ALL,
    author: Author = None,
    as_json: AsJson = False,
    warehouse: Root = None,
    config: UnusedConfig = None,
) -> int:
    """Let a flight, or a part of it, count nowhere: trends, constants to fly with and exports go on without it. It
    stays in the history as withdrawn, also when a night reads its log again; `fieldcal accept` takes that back.

    Parameters
    ----------
    target
        A flight: its id, the beginning of it, or its log as the history names it. Or a vehicle: all its flights that
        are in the history today.
    """
    decided = fieldcal.Warehouse(warehouse).withdraw(target, reason=reason, author=author, **_part(meant))
    return _told(decided, "withdrawn", as_json)


def accept(
    target: str,
    /,
    *,
    reason: Reason,
    meant: Meant = ALL,
    author: Author = None,
    as_json: AsJson = False,
    warehouse: Root = None,
    config: UnusedConfig = None,
) -> int:
    """Let what was withdrawn count again; of what counts, note that somebody looked at it. What was refused stays so.

    Parameters
    ----------
    target
        As for `fieldcal withdraw`: a flight, or a vehicle.
    """
    decided = fieldcal.Warehouse(warehouse).accept(target, reason=reason, author=author, **_part(meant))
    return _told(decided, "accepted", as_json)


def _part(meant: Meant) -> fieldcal.Part:
    return {
        "session": meant.session,
        "unit": meant.unit,
        "sensor": meant.sensor,
        "parameter": meant.parameter,
        "axis": meant.axis,
    }


def _told(decided: fieldcal.Decided, done: str, as_json: bool) -> int:
    from fieldcal.cli.show import print_json

    if as_json:
        print_json(asdict(decided))
        return 0
    n, trends = len(decided.flight_ids), len(decided.trends)
    print(f"{n} flight{'' if n == 1 else 's'} {done}; of {decided.constants} constants it changed whether they count.")
    if trends:
        print(
            f"Trends were made anew, those of {', '.join(decided.trends)} are others."
            " Reports follow with the next night, the site already has it."
        )
    return 0
