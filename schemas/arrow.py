"""Tables as Arrow schemas, and the check of a schema found in a file against what it should be."""

from __future__ import annotations

from collections.abc import Mapping

import pyarrow as pa

from fieldcal.schemas.column import AS_LOGGED
from fieldcal.schemas.tables import TABLES, table_columns, table_key

TABLE_KEY = "fieldcal.table"
VERSION_KEY = "fieldcal.schema_version"


class SchemaMismatch(ValueError):
    """A schema is not that of its table: missing, additional or wrongly typed columns, or another version."""


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


def check(schema: pa.Schema, table: str, *, stage: bool = False) -> None:
    """Raise `SchemaMismatch` unless `schema` has exactly the columns, types and version of `table` (in any order)."""
    wanted = {column.name: column.type for column in table_columns(table, stage=stage)}
    found = {field.name: field.type for field in schema}
    differences = []
    if len(found) != len(schema):
        differences.append("a column name occurs twice")
    if missing := [name for name in wanted if name not in found]:
        differences.append(f"missing {', '.join(missing)}")
    if extra := [name for name in found if name not in wanted]:
        differences.append(f"not in the table: {', '.join(extra)}")
    differences += [
        f"{name} is {found[name]} instead of {kind}"
        for name, kind in wanted.items()
        if name in found and found[name] != kind
    ]
    facts = {key.decode(): value.decode() for key, value in (schema.metadata or {}).items()}
    if TABLE_KEY in facts and facts[TABLE_KEY] != table:
        differences.append(f"it says it is the table {facts[TABLE_KEY]}")
    if VERSION_KEY in facts and facts[VERSION_KEY] != str(TABLES[table].version):
        differences.append(f"schema version {facts[VERSION_KEY]}, this release knows version {TABLES[table].version}")
    if differences:
        raise SchemaMismatch(f"this is not the table {table}: {'; '.join(differences)}")


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
