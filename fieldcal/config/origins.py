"""Where each value of a vehicle comes from: the file's own table, its defaults, a profile, or fieldcal."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import cast

from pydantic.fields import FieldInfo

from fieldcal.config.configuration import Configuration, LocalField, VehicleTable
from fieldcal.config.mistakes import key_path
from fieldcal.config.parameters import PROFILES, Parameters
from fieldcal.config.values import DatedImu, Table
from fieldcal.names import Json, ProfileName

DEFAULT = "default"
Layers = Sequence[tuple[str, Table]]
"""Tables of the file by their names, the one that wins first."""


@dataclass(frozen=True)
class Entry:
    """One effective value as plain JSON; None: not configured. `source` is a table of the file, a profile or
    "default"."""

    keys: tuple[str, ...]
    value: Json
    source: str
    unit: str
    meaning: str


NOBODY = "\0"
"""Stands for a vehicle that no file names."""


def effective(configuration: Configuration, vehicle_id: str | None) -> list[Entry]:
    """Every value that holds for a vehicle; of None, for one that the file does not name."""
    document = configuration.document
    layers: list[tuple[str, Table]] = [("[defaults]", document.defaults)]
    if vehicle_id in document.vehicles:
        layers.insert(0, (f"[{key_path('vehicles', vehicle_id)}]", document.vehicles[vehicle_id]))
    vehicle = configuration.vehicle(vehicle_id or NOBODY)
    entries = _entries(vehicle, layers, (), vehicle.profile)
    return [entry for entry in entries if vehicle_id is not None or entry.keys != ("imu_id",)]


def _entries(table: Table, layers: Layers, above: tuple[str, ...], profile: ProfileName) -> Iterator[Entry]:
    fields = VehicleTable.model_fields if isinstance(table, VehicleTable) else type(table).model_fields
    for name, field in fields.items():
        value = getattr(table, name)
        if isinstance(table, LocalField) and _of_the_other_form(table, name):
            continue
        keys = (*above, name)
        setting = [(source, layer) for source, layer in layers if name in layer.model_fields_set]
        if isinstance(value, Table):
            inner = [(source, getattr(layer, name)) for source, layer in setting]
            # A local field is replaced whole.
            yield from _entries(value, inner[:1] if name == "field" else inner, keys, profile)
        elif isinstance(value, dict):
            for key, item in value.items():
                source = next((source for source, layer in setting if key in getattr(layer, name)), DEFAULT)
                yield _entry((*keys, str(key)), item, source, field)
        else:
            source = setting[0][0] if setting else DEFAULT
            if not setting and isinstance(table, Parameters) and name in PROFILES[profile]:
                source = f"profile {profile}"
            yield _entry(keys, value, source, field)


def _of_the_other_form(field: LocalField, name: str) -> bool:
    """Whether a key has no place beside what a local field is given by."""
    return name not in ("unit", "north_east_down") if field.north_east_down is not None else name == "north_east_down"


def _entry(keys: tuple[str, ...], value: object, source: str, field: FieldInfo) -> Entry:
    extra = field.json_schema_extra
    unit = extra.get("unit", "") if isinstance(extra, dict) else ""
    return Entry(keys, _plain(value), source, str(unit), field.description or "")


def _plain(value: object) -> Json:
    if isinstance(value, DatedImu):
        return value.table()
    if isinstance(value, tuple):
        return [_plain(item) for item in value]
    return str(value) if isinstance(value, str) else cast("float | None", value)
