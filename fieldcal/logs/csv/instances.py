"""Several IMUs in one CSV file, a column telling them apart: one is chosen as the primary one, or the file is
refused."""

from __future__ import annotations

import numpy as np
import polars as pl
from numpy.typing import NDArray

from fieldcal.errors import UnreadableLog
from fieldcal.reason_codes import ReasonCode

DEFAULT_NAMES = ("i", "instance", "imu_instance", "imu_id", "imu", "sensor_id", "sensor", "device_id", "frame_id")
"""Names, in lower case, of columns that may tell several IMUs apart."""
MOST_UNITS = 8
LEAST_ROWS = 20
INTERLEAVED_SHARE = 0.2
"""Where the value changes from row to row so often, it tells rows of different IMUs apart, and no mode of one."""


def instance_column(names: tuple[str, ...], taken: set[int]) -> int | None:
    """Position of a column that may tell IMUs apart, none of those that are `taken`."""
    for wanted in DEFAULT_NAMES:
        for place, name in enumerate(names):
            if name.strip().lower() == wanted and place not in taken:
                return place
    return None


def interleaved(cells: pl.Series) -> list[str]:
    """The names of the IMUs whose rows alternate, by the cells of the column that tells them apart; else none."""
    present = cells.str.strip_chars().drop_nulls()
    values = present.unique().to_list()
    if len(present) < LEAST_ROWS or not 2 <= len(values) <= MOST_UNITS:
        return []
    switches = int((present != present.shift(1)).sum())
    return sorted(values) if switches > INTERLEAVED_SHARE * len(present) else []


def names_in(cells: pl.Series) -> list[str]:
    """The names of the IMUs of some rows."""
    return sorted(cells.str.strip_chars().drop_nulls().unique().to_list())[:MOST_UNITS]


def rows_of(cells: pl.Series, instance: str) -> NDArray[np.bool_]:
    """Which rows are of one IMU."""
    return (cells.str.strip_chars() == instance).fill_null(False).to_numpy()


def several_units(name: str, column: str, values: list[str]) -> UnreadableLog:
    """The refusal of a file with rows of several IMUs of which none is chosen."""
    return UnreadableLog(
        ReasonCode.SEVERAL_UNITS,
        f"{name} holds rows of several IMUs, told apart by column {column!r}: {', '.join(values)}. Choose the primary "
        f"one: set csv.instance to {' or '.join(repr(value) for value in values)}; the others are calibrated as "
        "further units.",
    )


def absent_unit(name: str, column: str, cells: pl.Series, instance: str) -> UnreadableLog:
    """The refusal of a file in which the chosen IMU is not to be found."""
    there = names_in(cells)
    return UnreadableLog(
        ReasonCode.SEVERAL_UNITS,
        f"No row of {name} says {instance!r} in column {column!r}, which csv.instance asks for; there are "
        f"{', '.join(there) or 'none'}. Correct csv.instance.",
    )
