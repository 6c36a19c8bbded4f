"""What a table is: every column once with type, unit, frame and meaning; tables list columns, key and version.

`arrow_schema` gives the Arrow schema that is written into every Parquet file, `check` compares a schema found on disk
with it, `python -m schemas` prints the data dictionary.
"""

if __name__ != "fieldcal.schemas":  # a checkout has this folder at its root too: two copies of every flow and enum
    raise ImportError("This package is fieldcal.schemas.")

from fieldcal.schemas.arrow import SchemaMismatch, arrow_schema, check, conform
from fieldcal.schemas.column import AS_LOGGED, Column, Table
from fieldcal.schemas.frames import fits
from fieldcal.schemas.tables import (
    FLEET_TABLES,
    FLIGHT_TABLES,
    HISTORY_TABLES,
    SIGNAL_TABLES,
    STAGE_TABLES,
    TABLES,
    signal_kind,
    stage_columns,
    table_columns,
    table_key,
)

__all__ = [
    "AS_LOGGED",
    "FLEET_TABLES",
    "FLIGHT_TABLES",
    "HISTORY_TABLES",
    "SIGNAL_TABLES",
    "STAGE_TABLES",
    "TABLES",
    "Column",
    "SchemaMismatch",
    "Table",
    "arrow_schema",
    "check",
    "conform",
    "fits",
    "signal_kind",
    "stage_columns",
    "table_columns",
    "table_key",
]
