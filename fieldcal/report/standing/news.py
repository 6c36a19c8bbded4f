"""What a night tells and the nights before did not: reasons for a look that are new, and those that are gone."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import TypedDict

from fieldcal.names import Standing
from fieldcal.report.fitness import Fitness
from fieldcal.report.standing.reason import KINDS, NO_NEWS, RECOVERED, STATUSES, Reason


class PlainChange(TypedDict):
    """A `Change` as plain JSON."""

    kind: str
    vehicle_id: str
    imu_id: str | None
    unit_id: str | None
    sensor: str | None
    axis: str | None
    parameters: list[str]
    sentence: str


@dataclass(frozen=True)
class Change:
    """One change to report, `sentence` for people."""

    kind: str
    vehicle_id: str
    imu_id: str | None
    unit_id: str | None
    sensor: str | None
    axis: str | None
    parameters: tuple[str, ...]
    sentence: str

    def row(self) -> PlainChange:
        """As a JSON object."""
        return {
            "kind": self.kind,
            "vehicle_id": self.vehicle_id,
            "imu_id": self.imu_id,
            "unit_id": self.unit_id,
            "sensor": self.sensor,
            "axis": self.axis,
            "parameters": list(self.parameters),
            "sentence": self.sentence,
        }


def news(fleet: Mapping[str, Fitness], former: Mapping[str, Fitness]) -> list[Change]:
    """What the fleet's fitness says that the former one did not, the gravest first. Logs are told by themselves."""
    found = [change for one in fleet.values() for change in _of_vehicle(one, former.get(one.vehicle_id))]
    return sorted(found, key=lambda c: (KINDS.index(c.kind), c.vehicle_id, c.sensor or "", c.axis or ""))


def _of_vehicle(one: Fitness, former: Fitness | None) -> Iterable[Change]:
    before = [] if former is None else _all(former)
    known = {reason.key for reason in before}
    for reason in _all(one):
        if reason.key not in known:
            yield _change(one.vehicle_id, reason)
    if one.standing in (Standing.NOTHING, Standing.TOO_FEW):
        return
    moving = {reason.place for reason in _all(one) if reason.kind in STATUSES}
    for reason in before:
        if reason.kind in STATUSES and reason.place not in moving:
            told = " ".join(filter(None, (reason.sensor, reason.axis))) + f": {reason.kind} no more."
            yield _change(one.vehicle_id, replace(reason, kind=RECOVERED, sentence=told))


def _all(one: Fitness) -> list[Reason]:
    return [reason for reason in (*one.told, *one.notes) if reason.kind not in NO_NEWS]


def _change(vehicle_id: str, reason: Reason) -> Change:
    unit = f", {reason.unit_id}" if reason.unit_id and reason.unit_id != vehicle_id else ""
    return Change(
        reason.kind,
        vehicle_id,
        reason.imu_id,
        reason.unit_id,
        reason.sensor,
        reason.axis,
        reason.parameters,
        f"{vehicle_id}{unit}: {reason.sentence}",
    )
