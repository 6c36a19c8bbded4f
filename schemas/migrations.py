"""What the versions of the history's tables changed, all of them since the first night."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TypeAlias

Filling: TypeAlias = str | bool | None
"""What older rows have in a column that was added: of a text, what the column of this name has; of None, null."""


@dataclass(frozen=True)
class Change:
    """What one version of a table changed.

    Columns that were added are filled by whoever reads an older file. One that was renamed cannot be read: `fieldcal
    upgrade` brings the file up to date, and converts types where nothing is lost. None was ever dropped: readers pass
    over such a column, and an upgrade leaves the file.

    Parameters
    ----------
    table : str
        Table of the history.
    version : int
        The version that brought it.
    added : mapping
        New columns with their filling.
    renamed : mapping
        Former names of columns, each with the name that it has since.
    """

    table: str
    version: int
    added: Mapping[str, Filling] = field(default_factory=dict)
    renamed: Mapping[str, str] = field(default_factory=dict)


_UNITS: Mapping[str, Filling] = {"unit_id": "imu_id", "is_primary": True}
"""A flight had one unit until then."""
_ORDER: Mapping[str, Filling] = {"dated_by": None, "sequence": None}

CHANGES: tuple[Change, ...] = (
    # No night wrote version 1 of drift.
    Change(
        "drift",
        3,
        dict.fromkeys(
            (
                "best_known_at",
                "borrowed_from",
                "curve_per_degc2",
                "curve_per_degc2_sd",
                "curve_per_degc3",
                "curve_per_degc3_sd",
            )
        ),
    ),
    *(Change(table, 2, _UNITS) for table in ("calibration", "fit", "sync", "run")),
    Change("drift", 4, {"unit_id": "imu_id"}),
    Change("flight", 2, _ORDER),
    # Some of version 2 have these already.
    *(Change(table, 3, _ORDER) for table in ("calibration", "fit", "sync", "run")),
    Change("pooled", 2, dict.fromkeys(("slope_per_day", "slope_per_day_sd", "last_z", "distances"))),
    Change(
        "pooled",
        3,
        dict.fromkeys(("curve_per_degc2", "curve_per_degc2_sd", "curve_with_value", "curve_with_slope")),
    ),
)
"""In the order in which they came."""


def fillings(table: str) -> dict[str, Filling]:
    """Columns of a table of the history that older files lack, with what their rows have there."""
    return {name: has for change in CHANGES if change.table == table for name, has in change.added.items()}


def name_today(table: str, version: int, column: str) -> str:
    """Name that a column of a file of this version has today."""
    for change in CHANGES:
        if change.table == table and change.version > version:
            column = change.renamed.get(column, column)
    return column
