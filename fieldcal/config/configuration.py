"""`fieldcal.toml`: what the night needs to know of the vehicles and the logs cannot say themselves.

One file for all vehicles. `[defaults]` may hold every key of a vehicle; `[vehicles."<id>"]` overrides, table by table
and key by key (a `field` is replaced whole: it comes in two forms). Everything is checked when the file is loaded, also
for vehicles that no log mentions, so that a misprint shows before the night and not in it.
"""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from fieldcal.config import toml_checks as check
from fieldcal.config.parameters import PARAMETERS, PROFILES, Value
from fieldcal.config.toml_checks import Place, Triple
from fieldcal.errors import ConfigurationError

SENSORS = ("magnetometer", "accelerometer", "gyroscope")
METHODS = ("serial", "joint")
UNITS = {
    "magnetometer": ("counts", "T", "uT", "G", "norm"),
    "accelerometer": ("counts", "m/s^2", "g"),
    "gyroscope": ("counts", "rad/s", "deg/s"),
}
FIELD_UNITS = ("norm", "T", "uT", "G")
TIME_UNITS = ("s", "ms", "us", "ns", "iso8601")
IDENTITY: tuple[Triple, Triple, Triple] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))

Paths = str | tuple[str, ...]


@dataclass(frozen=True)
class Field:
    """Local magnetic field: given as north, east, down in `unit`, or a place for the World Magnetic Model."""

    unit: str
    north_east_down: Triple | None = None
    latitude_deg: float | None = None
    longitude_deg: float | None = None
    altitude_m: float = 0.0


@dataclass(frozen=True)
class CsvMap:
    """Where a vehicle's CSV logs differ from the default columns. `imu` and `vps` hold configured names only.

    Keys of `imu`: t, gyroscope, accelerometer, magnetometer (three names each), temperature, current, throttle;
    of `vps`: t, quaternion_xyzw (four names), position (three). Both empty: the default names are meant.
    """

    time_unit: str | None = None
    rate_hz: float | None = None
    imu: dict[str, Paths] = field(default_factory=dict)
    vps: dict[str, Paths] = field(default_factory=dict)
    separator: str | None = None
    decimal: str | None = None


@dataclass(frozen=True)
class McapMap:
    """Topics and fields of a vehicle's MCAP logs where message types alone do not decide; `time`: the stamp used."""

    imu: str | None = None
    magnetometer: str | None = None
    vps: str | None = None
    temperature: str | None = None
    power: str | None = None
    position: str | None = None
    imu_fields: dict[str, Paths] | None = None
    time: str = "header"


@dataclass(frozen=True)
class Vehicle:
    """All that is configured of one vehicle, defaults and profile worked in. None: the log decides.

    `method` is one name for all sensors, or sensor → name where they differ.
    """

    vehicle_id: str
    imu_id: str
    method: str | dict[str, str]
    profile: str
    world: str | None
    body: str | None
    gravity_sign: str | None
    gravity_mps2: float
    field: Field | None
    rotation_body_from_sensor: tuple[Triple, Triple, Triple]
    lever_arm_m: Triple | None
    polarity: dict[str, tuple[int, int, int]]
    units: dict[str, str]
    nominal_scale: dict[str, Triple]
    reference_reading: dict[str, Triple]
    csv: CsvMap
    mcap: McapMap
    parameters: dict[str, Value]

    def settings(self) -> dict[str, Any]:
        """Plain JSON of everything that can change results; names of vehicle and IMU do not, nor does the profile's."""
        plain = _plain(asdict(self))
        return {key: plain[key] for key in sorted(plain) if key not in ("vehicle_id", "imu_id", "profile")}


@dataclass(frozen=True)
class LogsMap:
    """Logs that do not lie as `<vehicle>/<session>/<log>`: a glob relative to the archive and what it stands for.

    `vehicle` and `session` may be None: then the folders' names decide.
    """

    glob: str
    vehicle: str | None = None
    session: str | None = None


@dataclass(frozen=True)
class Alerts:
    """Days after which a sensor's latest calibration has expired, and a vehicle without a usable flight is idle."""

    expires_days: float = 90.0
    idle_days: float = 30.0


@dataclass(frozen=True)
class Configuration:
    """The loaded file. `vehicle` answers for any id; one that is not configured gets the defaults."""

    path: Path | None
    vehicles: dict[str, Vehicle]
    logs: tuple[LogsMap, ...]
    alerts: Alerts
    _defaults: Vehicle

    def vehicle(self, vehicle_id: str) -> Vehicle:
        """What is configured for `vehicle_id`."""
        if vehicle_id in self.vehicles:
            return self.vehicles[vehicle_id]
        imu_id = self._defaults.imu_id or vehicle_id
        return Vehicle(**{**_fields(self._defaults), "vehicle_id": vehicle_id, "imu_id": imu_id})


def load(path: Path | None) -> Configuration:
    """Load and check a configuration file; None gives the defaults alone.

    Raises
    ------
    ConfigurationError
        The file cannot be read or is not TOML, a key is unknown (the nearest known one is named), or a value has the
        wrong type or is not allowed.
    """
    if path is None:
        return parse("", None)
    try:
        return parse(path.read_bytes().decode("utf-8-sig"), path)
    except OSError as error:
        raise ConfigurationError("config_not_readable", f"{path}: cannot be read ({error.strerror}).") from error
    except UnicodeDecodeError as error:
        raise ConfigurationError("config_syntax", f"{path}: is not UTF-8 text (byte {error.start}).") from error


def parse(document: str, path: Path | None) -> Configuration:
    """The same from the text of a file; `path` serves messages only."""
    root = Place(str(path) if path else "fieldcal.toml")
    try:
        content = tomllib.loads(document)
    except tomllib.TOMLDecodeError as error:
        raise ConfigurationError("config_syntax", f"{root}: is not TOML: {error}.") from error
    check.table(content, root, ("defaults", "vehicles", "archive", "alerts"))
    defaults = _raw(content.get("defaults", {}), root / "defaults")
    vehicles = {}
    for vehicle_id, raw in check.table(content.get("vehicles", {}), root / "vehicles").items():
        place = root / "vehicles" / vehicle_id
        vehicles[vehicle_id] = _vehicle(vehicle_id, _merged(defaults, _raw(raw, place)))
    logs = _logs(content.get("archive", {}), root / "archive")
    alerts = _alerts(content.get("alerts", {}), root / "alerts")
    return Configuration(path, vehicles, logs, alerts, _vehicle("", defaults))


def _alerts(value: Any, place: Place) -> Alerts:
    raw = check.table(value, place, ("expires_days", "idle_days"))
    return Alerts(**{key: check.positive(days, place / key) for key, days in raw.items()})


# --- one function a key: raw TOML value -> checked value


def _per_sensor(one: Callable[[Any, Place], Any], value: Any, place: Place) -> dict[str, Any]:
    return {sensor: one(item, place / sensor) for sensor, item in check.table(value, place, SENSORS).items()}


def _method(value: Any, place: Place) -> dict[str, str]:
    """One name for all sensors, or a table of them."""
    if isinstance(value, dict):
        return _per_sensor(partial(check.choice, allowed=METHODS), value, place)
    return dict.fromkeys(SENSORS, check.choice(value, place, METHODS))


def _one_method(named: Mapping[str, str]) -> str | dict[str, str]:
    every = {sensor: named.get(sensor, METHODS[0]) for sensor in SENSORS}
    return every[SENSORS[0]] if len(set(every.values())) == 1 else every


def _units(value: Any, place: Place) -> dict[str, str]:
    raw = check.table(value, place, SENSORS)
    return {sensor: check.choice(unit, place / sensor, UNITS[sensor]) for sensor, unit in raw.items()}


def _field(value: Any, place: Place) -> Field:
    raw = check.table(value, place, ("north_east_down", "unit", "latitude_deg", "longitude_deg", "altitude_m"))
    if "north_east_down" in raw:
        if others := sorted(raw.keys() - {"north_east_down", "unit"}):
            place.fail(
                "wrong_value", f"give either north_east_down or a place, not both (north_east_down and {others[0]})"
            )
        if "unit" not in raw:
            place.fail("wrong_value", f"north_east_down needs its unit, one of {', '.join(FIELD_UNITS)}")
        vector = check.triple(raw["north_east_down"], place / "north_east_down")
        if not any(vector):
            (place / "north_east_down").fail("wrong_value", "the field cannot be zero")
        return Field(check.choice(raw["unit"], place / "unit", FIELD_UNITS), vector)
    for key in ("latitude_deg", "longitude_deg"):
        if key not in raw:
            place.fail(
                "wrong_value", f"{key} is missing; give north_east_down and unit, or latitude_deg and longitude_deg"
            )
    return Field(
        check.choice(raw.get("unit", "uT"), place / "unit", FIELD_UNITS),
        None,
        check.number(raw["latitude_deg"], place / "latitude_deg", -90.0, 90.0),
        check.number(raw["longitude_deg"], place / "longitude_deg", -180.0, 360.0),
        check.number(raw.get("altitude_m", 0.0), place / "altitude_m", -1e3, 8.5e5),
    )


def _csv_imu(value: Any, place: Place) -> dict[str, Paths]:
    raw = check.table(value, place, ("t", *SENSORS, "temperature", "current", "throttle"))
    return {k: check.texts(v, place / k, 3) if k in SENSORS else check.text(v, place / k) for k, v in raw.items()}


def _csv_vps(value: Any, place: Place) -> dict[str, Paths]:
    counts = {"quaternion_xyzw": 4, "position": 3}
    raw = check.table(value, place, ("t", *counts))
    return {
        k: check.texts(v, place / k, counts[k]) if k in counts else check.text(v, place / k) for k, v in raw.items()
    }


def _imu_fields(value: Any, place: Place) -> dict[str, Paths]:
    raw = check.table(value, place, (*SENSORS, "temperature"))
    return {
        key: check.texts(item, place / key, 3)
        if isinstance(item, list) and key in SENSORS
        else check.text(item, place / key)
        for key, item in raw.items()
    }


def _parameters(value: Any, place: Place) -> dict[str, Value]:
    return {key: _parameter(key, item, place / key) for key, item in check.table(value, place, PARAMETERS).items()}


def _parameter(key: str, value: Any, place: Place) -> Value:
    parameter = PARAMETERS[key]
    if parameter.choices:
        return check.choice(value, place, parameter.choices)
    if isinstance(parameter.default, bool):
        return check.flag(value, place)
    result = check.number(value, place, *(parameter.bounds or ()))
    if isinstance(parameter.default, int):
        if result != int(result):
            place.fail("wrong_type", f"a whole number is needed here, not {value}")
        return int(result)
    return result


def _keys(checks: Mapping[str, Callable[[Any, Place], Any]], value: Any, place: Place) -> dict[str, Any]:
    """A table whose keys are those of `checks`, each value checked; what comes out holds configured keys only."""
    return {key: checks[key](item, place / key) for key, item in check.table(value, place, checks).items()}


_CSV_KEYS: dict[str, Callable[[Any, Place], Any]] = {
    "time_unit": partial(check.choice, allowed=TIME_UNITS),
    "rate_hz": check.positive,
    "imu": _csv_imu,
    "vps": _csv_vps,
    "separator": check.character,
    "decimal": partial(check.choice, allowed=(".", ",")),
}
_MCAP_KEYS: dict[str, Callable[[Any, Place], Any]] = {
    **dict.fromkeys(("imu", "magnetometer", "vps", "temperature", "power", "position"), check.text),
    "imu_fields": _imu_fields,
    "time": partial(check.choice, allowed=("header", "log")),
}
_VEHICLE_KEYS: dict[str, Callable[[Any, Place], Any]] = {
    "imu_id": check.text,
    "method": _method,
    "profile": partial(check.choice, allowed=PROFILES),
    "world": partial(check.choice, allowed=("ned", "enu")),
    "body": partial(check.choice, allowed=("frd", "flu")),
    "gravity_sign": partial(check.choice, allowed=("gravity", "specific_force")),
    "gravity_mps2": partial(check.number, lowest=9.7, highest=9.9),
    "field": _field,
    "rotation_body_from_sensor": check.rotation,
    "lever_arm_m": check.triple,
    "polarity": partial(_per_sensor, check.signs),
    "units": _units,
    "nominal_scale": partial(_per_sensor, check.positive_triple),
    "reference_reading": partial(_per_sensor, check.triple),
    "csv": partial(_keys, _CSV_KEYS),
    "mcap": partial(_keys, _MCAP_KEYS),
    "parameters": _parameters,
}


def _raw(value: Any, place: Place) -> dict[str, Any]:
    return _keys(_VEHICLE_KEYS, value, place)


def _merged(under: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """`over` laid on `under`, tables key by key."""
    result = dict(under)
    for key, value in over.items():
        below = result.get(key)
        result[key] = _merged(below, value) if isinstance(value, dict) and isinstance(below, dict) else value
    return result


def _vehicle(vehicle_id: str, raw: Mapping[str, Any]) -> Vehicle:
    profile = raw.get("profile", "full")
    defaults = {name: parameter.default for name, parameter in PARAMETERS.items()}
    return Vehicle(
        vehicle_id=vehicle_id,
        imu_id=raw.get("imu_id", vehicle_id),
        method=_one_method(raw.get("method", {})),
        profile=profile,
        world=raw.get("world"),
        body=raw.get("body"),
        gravity_sign=raw.get("gravity_sign"),
        gravity_mps2=raw.get("gravity_mps2", 9.80665),
        field=raw.get("field"),
        rotation_body_from_sensor=raw.get("rotation_body_from_sensor", IDENTITY),
        lever_arm_m=raw.get("lever_arm_m"),
        polarity=dict.fromkeys(SENSORS, (1, 1, 1)) | raw.get("polarity", {}),
        units=raw.get("units", {}),
        nominal_scale=raw.get("nominal_scale", {}),
        reference_reading=raw.get("reference_reading", {}),
        csv=CsvMap(**raw.get("csv", {})),
        mcap=McapMap(**raw.get("mcap", {})),
        parameters={**defaults, **PROFILES[profile], **raw.get("parameters", {})},
    )


def _logs(value: Any, place: Place) -> tuple[LogsMap, ...]:
    entries = check.table(value, place, ("logs",)).get("logs", [])
    if not isinstance(entries, list):
        (place / "logs").fail("wrong_type", "a list of tables is needed here")
    return tuple(LogsMap(**_log(entry, place / "logs" / str(number))) for number, entry in enumerate(entries))


def _log(value: Any, place: Place) -> dict[str, str]:
    raw = _keys(dict.fromkeys(("glob", "vehicle", "session"), check.text), value, place)
    if "glob" not in raw:
        place.fail("wrong_value", "glob is missing: the files this entry stands for")
    if Path(raw["glob"]).is_absolute() or ".." in Path(raw["glob"]).parts:
        (place / "glob").fail("wrong_value", f'"{raw["glob"]}" leaves the archive; give a glob relative to it')
    return raw


def _fields(vehicle: Vehicle) -> dict[str, Any]:
    return {name: getattr(vehicle, name) for name in vehicle.__dataclass_fields__}


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _plain(value[key]) for key in sorted(value)}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return value
