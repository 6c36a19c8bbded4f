"""Constants as tables show them: which axis of which sensor, and those that one looks at first."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

from fieldcal.names import DriftStatus, Status, exactness
from fieldcal.schemas.rows import CalibrationRow, DriftRow
from fieldcal.trends.reasons import AGREEMENT

SHORT = {"gyroscope": "gyro", "accelerometer": "accel", "magnetometer": "mag", "vps": "VPS", "fit": "agreement"}
IMPLIED = ("zero", "bias")
"""What follows from `zero_bias` and `scale`."""
AnyRow = TypeVar("AnyRow", CalibrationRow, DriftRow)


def constant(sensor: str, axis: str, parameter: str) -> str:
    """Its name in a narrow column."""
    return " ".join(filter(None, (SHORT.get(sensor, sensor), axis, parameter.removeprefix("vps_").replace("_", " "))))


def counting(rows: Sequence[CalibrationRow]) -> list[CalibrationRow]:
    """Of several methods the one that counts, and of a constant that none gives the most exact that was refused."""
    best: dict[tuple[str, ...], CalibrationRow] = {}
    for row in rows:
        place = row["flight_id"], row["unit_id"], row["sensor"], row["parameter"], row["axis"]
        if place not in best or _rank(row) < _rank(best[place]):
            best[place] = row
    chosen = set(map(id, best.values()))
    return [row for row in rows if id(row) in chosen]


def _rank(row: CalibrationRow) -> tuple[bool, int]:
    return row["status"] != Status.OK, exactness(row["method"])


def telling(rows: Sequence[DriftRow]) -> list[DriftRow]:
    """Everything that is not steady; of the rest, of several methods the most exact, and no parameter that follows from
    others."""
    moving = [row for row in rows if row["status"] not in (DriftStatus.STABLE, DriftStatus.INSUFFICIENT)]
    alone = all(row["sensor"] == AGREEMENT for row in rows)
    best: dict[tuple[str, ...], DriftRow] = {}
    whole = {(row["unit_id"], row["sensor"], row["axis"]) for row in rows if row["parameter"] == "zero_bias"}
    for row in rows:
        place = row["unit_id"], row["sensor"], row["parameter"], row["axis"]
        if row["parameter"] in IMPLIED and (row["unit_id"], row["sensor"], row["axis"]) in whole:
            continue
        if row["sensor"] == AGREEMENT and not alone:
            continue
        if place not in best or exactness(row["method"]) < exactness(best[place]["method"]):
            best[place] = row
    chosen = set(map(id, [*moving, *best.values()]))
    return [row for row in rows if id(row) in chosen]
