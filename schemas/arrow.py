"""Tables as Arrow schemas, and the check of a schema found in a file against what it should be."""

from __future__ import annotations

from collections.abc import Mapping

import pyarrow as pa

from fieldcal.schemas.column import AS_LOGGED
from fieldcal.schemas.migrations import fillings
from fieldcal.schemas.rows import may_be_null
from fieldcal.schemas.tables import TABLES, table_columns, table_key

TABLE_KEY = "fieldcal.table"
VERSION_KEY = "fieldcal.schema_version"

_UPGRADE = (
    "An older fieldcal wrote it: run `fieldcal upgrade`; move away a file that it leaves, and run the night: it is "
    "made anew from the archive's logs"
)
_UPDATE = "A newer fieldcal wrote it: update fieldcal"


class SchemaMismatch(ValueError):
    """A schema is not that of its table: missing, additional or wrongly typed columns, or a version not to be read."""


def arrow_schema(
    table: str,
    *,
    stage: bool = False,
    units: Mapping[str, str] | None = None,
    metadata: Mapping[str, str] | None = None,
) -> pa.Schema:
    """Arrow schema of `table` with unit and meaning in every field's metadata.

    Parameters
    ----------
    table : str
        Name of the table.
    stage : bool
        The table as a stage writes it: without the lead columns and the run key.
    units : mapping, optional
        Real units of columns whose unit is "as logged", by sensor (`gyroscope`) or by column (`gyroscope_x`: it wins).
    metadata : mapping, optional
        Further facts for the schema's metadata (of the flight, of the log).

    Raises
    ------
    KeyError
        There is no such table.
    """
    units = units or {}
    fields = []
    for column in table_columns(table, stage=stage):
        unit = column.unit
        if unit == AS_LOGGED:
            unit = units.get(column.name, units.get(column.sensor, AS_LOGGED))
        fields.append(pa.field(column.name, column.type, metadata={"unit": unit, "meaning": column.meaning}))
    facts = {**(metadata or {}), TABLE_KEY: table, VERSION_KEY: str(TABLES[table].version)}
    return pa.schema(fields, metadata=dict(sorted(facts.items())))


def check(schema: pa.Schema, table: str, *, stage: bool = False) -> tuple[str, ...]:
    """Columns that a file lacks because an older version wrote it. What its rows have there:
    `migrations.fillings`.

    Raises
    ------
    SchemaMismatch
        It has not exactly the columns, types and version of `table` (in any order); or an older version wrote it, and
        it lacks a column that no row can do without, or has one in another type or unit.
    """
    wanted = {field.name: field for field in arrow_schema(table, stage=stage)}
    found = {field.name: field for field in schema}
    facts = {key.decode(): value.decode() for key, value in (schema.metadata or {}).items()}
    known = TABLES[table].version
    version = int(facts.get(VERSION_KEY, known))
    older = version < known
    absent = tuple(name for name in wanted if name not in found)
    differences = []
    if len(found) != len(schema):
        differences.append("a column name occurs twice")
    if missing := [name for name in absent if not (older and name in _dispensable(table))]:
        differences.append(f"missing {', '.join(missing)}")
    if (extra := [name for name in found if name not in wanted]) and not older:
        differences.append(f"not in the table: {', '.join(extra)}")
    both = [(name, found[name], wanted[name]) for name in wanted if name in found]
    differences += [f"{name} is {f.type} instead of {w.type}" for name, f, w in both if f.type != w.type]
    if older:
        units = [(name, _unit(f), _unit(w)) for name, f, w in both if _unit(w) != AS_LOGGED]
        differences += [f"{name} is in {f} instead of {w}" for name, f, w in units if f != w]
    if TABLE_KEY in facts and facts[TABLE_KEY] != table:
        differences.append(f"it says it is the table {facts[TABLE_KEY]}")
    if version > known or (older and differences):
        differences.append(f"schema version {version}, this release knows version {known}")
    if not differences:
        return absent
    remedy = ""
    if version != known:
        remedy = f". {_UPDATE if version > known else _UPGRADE}"
    raise SchemaMismatch(f"this is not the table {table}: {'; '.join(differences)}{remedy}")


def _dispensable(table: str) -> frozenset[str]:
    """Columns that rows of an older version may lack. A stage's own tables are made anew with its code."""
    definition = TABLES[table]
    if definition.kind == "history":
        return may_be_null(table) | fillings(table).keys()
    return frozenset(definition.column_names) - {*definition.key} if definition.kind == "signal" else frozenset()


def _unit(field: pa.Field) -> str:
    return str((field.metadata or {}).get(b"unit", b"").decode())


def conform(rows: pa.Table, table: str, schema: pa.Schema | None = None, *, stage: bool = False) -> pa.Table:
    """`rows` with exactly the columns and types of `schema` (default: those of `table`).

    Integers and texts of another width are converted.

    Raises
    ------
    SchemaMismatch
        Columns are missing or additional, a conversion would lose something, or a column of the key holds nulls.
    """
    schema = arrow_schema(table, stage=stage) if schema is None else schema
    missing = [name for name in schema.names if name not in rows.column_names]
    extra = [name for name in rows.column_names if name not in schema.names]
    if missing or extra:
        raise SchemaMismatch(
            f"these rows are not of the table {table}: missing {', '.join(missing) or 'nothing'}; "
            f"not in the table: {', '.join(extra) or 'nothing'}"
        )
    columns = []
    for field in schema:
        column = rows.column(field.name)
        if pa.types.is_integer(field.type) and pa.types.is_floating(column.type):
            raise SchemaMismatch(f"column {field.name} of {table} must be whole numbers, not {column.type}")
        try:
            columns.append(column if column.type == field.type else column.cast(field.type))
        except pa.ArrowException as error:
            raise SchemaMismatch(f"column {field.name} of {table} cannot be {field.type}: {error}") from error
    result = pa.Table.from_arrays(columns, schema=schema)
    for name in table_key(table, stage=stage):
        if nulls := result.column(name).null_count:
            raise SchemaMismatch(f"column {name} of {table} identifies a row, yet {nulls} rows have none")
    return result
