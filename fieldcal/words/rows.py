"""Rows of a table as objects."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, TypeVar, cast

from fieldcal.reason_codes import ReasonCode

if TYPE_CHECKING:
    import polars as pl

BESIDE = {
    "lever_arm": "lever arm (from the point it turns about)",
    "vps_lever_arm": "lever arm (from the VPS's point)",
    "gnss_lag": "lag (of the satellite receiver)",
    "gnss_lever_arm": "lever arm (to the receiver's antenna)",
    "delay": "delay",
    "dip": "dip of the field",
    "g_sensitivity": "sensitivity to specific force",
    "field_per_current": "field of the motors' current",
    "field_per_throttle": "field of the motors at full throttle",
}
"""Parameters beside scale and zero, in words."""

NESTED = ("measured", "versions", "findings")

Row = TypeVar("Row")
"""A typed dictionary of `schemas.rows`, or one like it."""


def typed(rows: Iterable[Mapping[str, object]], kind: type[Row]) -> list[Row]:
    """The same rows to the type check, as those of a table (`schemas.rows`): polars gives what its schema says."""
    return cast(list[Row], list(rows))


def rows_of(frame: pl.DataFrame) -> list[dict[str, object]]:
    """Rows as objects; what is not a finite number is null."""
    return [{name: _finite(value) for name, value in row.items()} for row in frame.iter_rows(named=True)]


def unfolded(row: Mapping[str, object]) -> dict[str, object]:
    """A row whose JSON texts (`measured`, `versions`, `findings`) are objects."""
    return {k: json.loads(v) if k in NESTED and isinstance(v, str) else v for k, v in row.items()}


def standing(status: str, reason_code: str | None) -> str:
    """What a row is good for, in words: "ok", "not chosen" where another method counts, else refused and why."""
    if reason_code == ReasonCode.OTHER_METHOD_CHOSEN:
        return "not chosen"
    return status if reason_code is None else f"{status}: {reason_code}"


def _finite(value: object) -> object:
    return None if isinstance(value, float) and (value != value or value in (float("inf"), float("-inf"))) else value
