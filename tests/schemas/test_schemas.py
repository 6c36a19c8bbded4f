"""Tables: every column defined, with unit and meaning, and checked against what a file says."""

from __future__ import annotations

import hashlib
import subprocess
import sys

import pyarrow as pa
import pytest

from fieldcal import schemas
from fieldcal.schemas import columns
from fieldcal.schemas.column import Column


def all_columns() -> list[Column]:
    return [column for table in schemas.TABLES.values() for column in table.columns]


def test_every_numeric_column_has_a_unit_and_every_column_a_meaning() -> None:
    for column in all_columns():
        assert column.meaning, column.name
        assert bool(column.unit) == column.numeric, column.name


def test_a_column_name_means_one_thing() -> None:
    """Apart from the two pairs that say so: a name is one definition, wherever it stands."""
    definitions: dict[str, set[Column]] = {}
    for column in all_columns():
        definitions.setdefault(column.name, set()).add(column)
    assert {name for name, found in definitions.items() if len(found) > 1} == {
        "value",
        "magnetometer_x",
        "magnetometer_y",
        "magnetometer_z",
    }


def test_keys_are_columns_and_names_unique_within_a_table() -> None:
    for table in schemas.TABLES.values():
        assert set(table.key) <= set(table.column_names)
        assert len(set(table.column_names)) == len(table.columns)


def test_history_tables_lead_with_flight_vehicle_imu_session_and_start() -> None:
    lead = tuple(column.name for column in columns.LEAD)
    assert lead == ("flight_id", "vehicle_id", "imu_id", "session_id", "started_at", "dated_by", "sequence")
    for name in schemas.FLIGHT_TABLES:
        assert schemas.TABLES[name].column_names[:7] == lead


def test_arrow_schema_carries_units_meanings_and_facts() -> None:
    schema = schemas.arrow_schema(
        "imu", units={"gyroscope": "deg/s", "accelerometer_y": "g"}, metadata={"fieldcal.flight_id": "ab"}
    )
    unit = {field.name: field.metadata[b"unit"].decode() for field in schema}
    assert unit["gyroscope_x"] == "deg/s"
    assert unit["accelerometer_x"] == schemas.AS_LOGGED
    assert unit["accelerometer_y"] == "g"
    assert unit["t_ns"] == "ns"
    assert schema.metadata[b"fieldcal.table"] == b"imu"
    assert schema.metadata[b"fieldcal.schema_version"] == b"1"
    assert schema.metadata[b"fieldcal.flight_id"] == b"ab"
    assert (
        schemas.arrow_schema("segments", units={"gyroscope": "rad/s"}).field("rate_rms").metadata[b"unit"] == b"rad/s"
    )


def test_stage_level_tables_lack_lead_and_run_key() -> None:
    assert schemas.stage_columns("calibration") == (
        "sensor",
        "method",
        "parameter",
        "axis",
        "value",
        "sd",
        "unit",
        "temperature_degc",
        "status",
        "reason_code",
    )
    assert schemas.table_key("calibration", stage=True) == ("sensor", "method", "parameter", "axis")
    assert schemas.table_key("sync", stage=True) == ()
    with pytest.raises(KeyError, match="no stage writes"):
        schemas.stage_columns("run")


def test_unknown_table_names_the_known_ones() -> None:
    with pytest.raises(KeyError, match="calibration"):
        schemas.arrow_schema("calibrations")


def test_check_accepts_its_own_schema_in_any_column_order() -> None:
    for name in schemas.TABLES:
        schema = schemas.arrow_schema(name)
        schemas.check(schema, name)
        schemas.check(pa.schema(list(schema)[::-1]), name)
    schemas.check(schemas.arrow_schema("fit", stage=True), "fit", stage=True)


def test_check_names_every_difference() -> None:
    imu = schemas.arrow_schema("imu")
    with pytest.raises(schemas.SchemaMismatch, match="missing gyroscope_z"):
        schemas.check(imu.remove(imu.get_field_index("gyroscope_z")), "imu")
    with pytest.raises(schemas.SchemaMismatch, match="not in the table: surprise"):
        schemas.check(imu.append(pa.field("surprise", pa.int8())), "imu")
    with pytest.raises(schemas.SchemaMismatch, match="t_ns is double instead of int64"):
        schemas.check(imu.set(0, pa.field("t_ns", pa.float64())), "imu")
    with pytest.raises(schemas.SchemaMismatch, match="it says it is the table vps"):
        schemas.check(imu.with_metadata({"fieldcal.table": "vps"}), "imu")
    with pytest.raises(schemas.SchemaMismatch, match="schema version 99"):
        schemas.check(imu.with_metadata({"fieldcal.schema_version": "99"}), "imu")
    with pytest.raises(schemas.SchemaMismatch, match="twice"):
        schemas.check(pa.schema([*imu, imu.field(1)]), "imu")


def test_check_tells_what_an_older_file_lacks_and_a_row_can_do_without() -> None:
    drift = schemas.arrow_schema("drift")
    older = drift.with_metadata({"fieldcal.table": "drift", "fieldcal.schema_version": "2"})
    assert schemas.check(drift, "drift") == schemas.check(older, "drift") == ()
    lacking = older.remove(older.get_field_index("borrowed_from")).append(pa.field("former", pa.int8()))
    assert schemas.check(lacking, "drift") == ("borrowed_from",)
    with pytest.raises(schemas.SchemaMismatch, match=r"missing n_flights.*version 2, this release knows version 4"):
        schemas.check(lacking.remove(lacking.get_field_index("n_flights")), "drift")
    segments = schemas.arrow_schema("segments").with_metadata({"fieldcal.schema_version": "0"})
    with pytest.raises(schemas.SchemaMismatch, match="missing reason"):
        schemas.check(segments.remove(segments.get_field_index("reason")), "segments")


FORMS = {
    "imu": (1, "6b0ed5f0"),
    "magnetometer": (1, "a8d88f02"),
    "temperature": (1, "d66d7a93"),
    "vps": (1, "a8342131"),
    "position": (1, "af486156"),
    "power": (1, "8f471e07"),
    "gnss_velocity": (1, "a284e9ae"),
    "faults": (1, "a52b66de"),
    "segments": (1, "00bc3bfc"),
    "samples": (1, "ff1cc6e0"),
    "attitude": (1, "a7562912"),
    "trajectory": (1, "9dcde4d1"),
    "held_out": (1, "b3e93959"),
    "covariance": (1, "95bf049d"),
    "vps_aligned": (1, "8f8b1e84"),
    "flight": (2, "22477831"),
    "calibration": (3, "1829cb30"),
    "fit": (3, "1e14d746"),
    "sync": (3, "266ce3a5"),
    "moments": (1, "4079ca46"),
    "run": (3, "ac506f44"),
    "information": (1, "0f251e66"),
    "drift": (4, "e8fac4a1"),
    "pooled": (3, "12bb7db1"),
    "decision": (1, "ba9619df"),
    "export": (1, "a1abda15"),
}
"""Version of every table and digest of its columns: only by its version is an older file known for one."""


def test_a_table_of_other_columns_has_another_version() -> None:
    def form(table: str) -> str:
        columns = [(c.name, str(c.type), c.unit) for c in schemas.table_columns(table)]
        return hashlib.sha256(repr(columns).encode()).hexdigest()[:8]

    assert {name: (table.version, form(name)) for name, table in schemas.TABLES.items()} == FORMS


def test_data_dictionary_lists_every_column() -> None:
    text = subprocess.run([sys.executable, "-m", "fieldcal.schemas"], capture_output=True, text=True, check=True).stdout
    for table in schemas.TABLES.values():
        assert f"### {table.name} ({table.kind}, version {table.version})" in text
    for column in all_columns():
        assert column.meaning.replace("|", "\\|") in text
