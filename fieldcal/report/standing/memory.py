"""What a night said of the fleet, kept for who asks after it: the terminal, the site, the next night."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, cast

from fieldcal.config.configuration import Alerts, Tolerances
from fieldcal.names import Json, Standing
from fieldcal.report.fitness import Criteria, Fitness, fleet_fitness
from fieldcal.report.standing.reason import Reason
from fieldcal.warehouse import Warehouse
from fieldcal.warehouse.files import write_bytes
from fieldcal.warehouse.sealed import BrokenSeal, seal, unseal


def remembered(root: Path) -> Mapping[str, Json]:
    """What the last night kept; nothing where there was none, or it is damaged."""
    try:
        return unseal(_place(root).read_bytes())
    except (OSError, BrokenSeal):
        return {}


def remember(root: Path, fleet: Mapping[str, Fitness], criteria: Criteria, more: Mapping[str, Json]) -> None:
    """Keep what was said, by what it was judged, and what else the next night asks."""
    said = [asdict(one) for one in fleet.values()]
    by = {"alerts": criteria.alerts.model_dump(), "tolerances": criteria.tolerances.model_dump()}
    write_bytes(_place(root), seal({**more, **by, "fleet": said}), durable=False)


def remembered_criteria(root: Path) -> Criteria:
    """By what the last night judged; by default where there was none."""
    known = remembered(root)
    try:
        return Criteria(Alerts.model_validate(known["alerts"]), Tolerances.model_validate(known["tolerances"]))
    except (KeyError, ValueError):
        return Criteria()


def remembered_fleet(root: Path) -> dict[str, Fitness]:
    """What the last night said of each vehicle."""
    try:
        said = cast(list[dict[str, Any]], remembered(root)["fleet"])
        return {one["vehicle_id"]: _fitness(one) for one in said}
    except (KeyError, TypeError, ValueError):
        return {}


def following(root: Path, vehicles: Iterable[str]) -> dict[str, str] | None:
    """When to calibrate each of these vehicles again, by the history as it is and the last night's limits; None without
    limits."""
    criteria = remembered_criteria(root)
    if not criteria.tolerances.given:
        return None
    fleet = fleet_fitness(Warehouse(root), criteria, datetime.now(UTC), set(vehicles))
    return {one.vehicle_id: one.next for one in fleet.values() if one.next}


def _fitness(one: dict[str, Any]) -> Fitness:
    told, notes = (
        tuple(Reason(**{**own, "parameters": tuple(own["parameters"])}) for own in one[name])
        for name in ("told", "notes")
    )
    return Fitness(one["vehicle_id"], Standing(one["standing"]), told, notes, one["next"])


def _place(root: Path) -> Path:
    return root / "night" / "closing.json"
