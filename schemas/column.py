"""What a column and a table are."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import pyarrow as pa

Kind = Literal["signal", "stage", "history"]

AS_LOGGED = "as logged"
"""Unit of a column whose unit only the log (or the configuration) knows; `arrow_schema(units=...)` fills it in."""


@dataclass(frozen=True)
class Column:
    """One column: its name, Arrow type, unit and meaning.

    `unit` is "" only for text, flags and dates; "1" says dimensionless. `sensor` names the sensor whose logged unit
    the column carries. `stages.run_key` marks columns that say how a result came to be rather than what it is: they do
    not enter the content hash.
    """

    name: str
    type: pa.DataType
    unit: str
    meaning: str
    sensor: str = ""
    provenance: bool = False

    @property
    def numeric(self) -> bool:
        kind = self.type.value_type if pa.types.is_list(self.type) else self.type
        return bool(pa.types.is_integer(kind) or pa.types.is_floating(kind))


@dataclass(frozen=True)
class Table:
    """One table: its columns in order, the columns that identify a row, and its version.

    The version grows whenever a column is added, removed or changes its type or unit; another meaning is another name.
    What an older version wrote is read as long as no row needs what it lacks (`arrow.check`).
    """

    name: str
    kind: Kind
    version: int
    meaning: str
    columns: tuple[Column, ...]
    key: tuple[str, ...]

    @property
    def column_names(self) -> tuple[str, ...]:
        return tuple(column.name for column in self.columns)
