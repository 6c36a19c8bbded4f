"""Kinds of values in `fieldcal.toml`: tables with known keys only, and what several numbers or texts mean together.

Plain numbers, texts and choices are pydantic's own; here stands what it has no word for. Every check names what is
allowed; `mistakes` adds the file and the key.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from datetime import UTC, date, datetime, time
from typing import Annotated, ClassVar, NoReturn, TypeVar

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, WithJsonSchema, model_validator
from pydantic_core import PydanticCustomError

from fieldcal import names
from fieldcal.names import SENSORS, Approach, Sensor
from fieldcal.reason_codes import ReasonCode

T = TypeVar("T")
Paths = str | tuple[str, ...]


def wrong(reason_code: ReasonCode, problem: str, *at: str) -> NoReturn:
    """Refuse a value, or what stands in it under the keys `at`."""
    raise PydanticCustomError(reason_code.value, "{problem}", {"problem": problem, "at": at})


def shown(value: object) -> str:
    """A value as a sentence names it."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, Mapping):
        return "a table"
    text = f'"{value}"' if isinstance(value, str) else str(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def require_keys(value: object, known: Iterable[str], *at: str) -> Mapping[str, object]:
    """A table, all of whose keys are known."""
    if not isinstance(value, Mapping):
        wrong(ReasonCode.WRONG_TYPE, f"a table is needed here, not {shown(value)}", *at)
    allowed = [str(key) for key in known]
    for key in value:
        if key not in allowed:
            nearest = difflib.get_close_matches(key.lower(), allowed, n=1, cutoff=0.0)
            close = difflib.get_close_matches(key.lower(), allowed, n=1, cutoff=0.6)
            hint = f'did you mean "{nearest[0]}"?' + ("" if close else f" Known here: {', '.join(allowed)}")
            wrong(ReasonCode.UNKNOWN_KEY, f'there is no key "{key}"; {hint}', *at)
    return value


class Table(BaseModel):
    """A table of the file. What is configured of it stands in `model_fields_set`."""

    model_config: ClassVar[ConfigDict] = ConfigDict(strict=True, frozen=True, extra="forbid", allow_inf_nan=False)

    @model_validator(mode="before")
    @classmethod
    def _known_keys(cls, value: object) -> object:
        if not isinstance(value, cls):
            cls.check_whole(require_keys(value, cls.model_fields))
        return value

    @classmethod
    def check_whole(cls, raw: Mapping[str, object]) -> None:
        """What the keys of a table owe each other; `wrong` refuses."""


def _listed(count: int, kind: str) -> BeforeValidator:
    return BeforeValidator(lambda value: _items(value, count, kind))


def _items(value: object, count: int, kind: str) -> tuple[object, ...]:
    if not isinstance(value, list | tuple) or len(value) != count:
        wrong(ReasonCode.WRONG_TYPE, f"a list of {count} {kind} is needed here, not {shown(value)}")
    return tuple(value)


def _one_or_three(value: object) -> tuple[object, ...]:
    return _items(value, 3, "numbers") if isinstance(value, list | tuple) else (value,) * 3


def _signs(value: object) -> tuple[object, ...]:
    items = _items(value, 3, "signs")
    if any(isinstance(item, bool) or item not in (1, -1) for item in items):
        wrong(ReasonCode.WRONG_VALUE, f"{shown(value)} is not allowed; each of the three must be 1 or -1")
    return tuple(1 if item == 1 else -1 for item in items)


def _orthonormal(rows: names.Rotation, tolerance: float = 1e-6) -> names.Rotation:
    """Refuse what is no rotation: rows orthonormal within `tolerance`, determinant +1."""
    off = max(abs(sum(p * q for p, q in zip(u, v, strict=True)) - (u is v)) for u in rows for v in rows)
    if off > tolerance:
        wrong(ReasonCode.WRONG_VALUE, f"the rows are not orthogonal unit vectors (off by {off:.3g}): not a rotation")
    a, b, c = rows
    determinant = (
        a[0] * (b[1] * c[2] - b[2] * c[1]) - a[1] * (b[0] * c[2] - b[2] * c[0]) + a[2] * (b[0] * c[1] - b[1] * c[0])
    )
    if determinant < 0:
        wrong(ReasonCode.WRONG_VALUE, "the determinant is -1: a reflection, not a rotation; swap or negate one axis")
    return rows


def _text(value: object, *at: str) -> str:
    if not isinstance(value, str) or not value:
        wrong(ReasonCode.WRONG_TYPE, f"a text is needed here, not {shown(value)}", *at)
    return value


def _columns(counts: Mapping[str, int], *, one_for_all: bool = False) -> Callable[[object], dict[str, Paths]]:
    """A check of a table of names: so many different texts under each key. `one_for_all`: or one text for them all."""

    def check(value: object) -> dict[str, Paths]:
        found: dict[str, Paths] = {}
        for key, item in require_keys(value, counts).items():
            if counts[key] == 1 or (one_for_all and not isinstance(item, list | tuple)):
                found[key] = _text(item, key)
                continue
            if not isinstance(item, list | tuple) or len(item) != counts[key]:
                wrong(ReasonCode.WRONG_TYPE, f"a list of {counts[key]} texts is needed here, not {shown(item)}", key)
            texts = tuple(_text(text, key) for text in item)
            if len(set(texts)) != len(texts):
                wrong(ReasonCode.WRONG_VALUE, f"{shown(item)} names one thing twice", key)
            found[key] = texts
        return found

    return check


def _columns_schema(counts: Mapping[str, int], *, one_for_all: bool = False) -> WithJsonSchema:
    text = {"type": "string", "minLength": 1}

    def kind(count: int) -> dict[str, object]:
        several = {"type": "array", "items": text, "minItems": count, "maxItems": count, "uniqueItems": True}
        return text if count == 1 else {"anyOf": [text, several]} if one_for_all else several

    properties = {key: kind(count) for key, count in counts.items()}
    return WithJsonSchema({"type": "object", "properties": properties, "additionalProperties": False})


def _by_sensor(value: object) -> dict[Sensor, object]:
    return {Sensor(key): item for key, item in require_keys(value, SENSORS).items()}


@dataclass(frozen=True)
class DatedImu:
    """An IMU that a vehicle carries from a moment on, UTC; `from_` as it stands in the file, None since ever."""

    id: str
    from_: date | None = None

    @property
    def since(self) -> datetime:
        """The moment."""
        if self.from_ is None:
            return datetime.min.replace(tzinfo=UTC)
        moment = self.from_ if isinstance(self.from_, datetime) else datetime.combine(self.from_, time())
        return moment if moment.tzinfo is not None else moment.replace(tzinfo=UTC)

    def table(self) -> dict[str, names.Json]:
        """As the file has it."""
        return {"id": self.id, **({} if self.from_ is None else {"from": self.from_.isoformat()})}


def _imu_ids(value: object) -> object:
    """One name, or a list of names each with the day from which it holds."""
    if isinstance(value, tuple) or (isinstance(value, str) and value):  # a tuple was checked before
        return value
    if not isinstance(value, list) or not value:
        wrong(ReasonCode.WRONG_TYPE, f"a text is needed here, or a list of tables with id and from, not {shown(value)}")
    return tuple(_dated_imu(item, str(place)) for place, item in enumerate(value))


def _dated_imu(value: object, place: str) -> DatedImu:
    table = require_keys(value, ("id", "from"), place)
    moment = table.get("from")
    if moment is not None and not isinstance(moment, date):
        wrong(ReasonCode.WRONG_TYPE, f"a date such as 2026-05-04 is needed here, not {shown(moment)}", place, "from")
    return DatedImu(_text(table.get("id"), place, "id"), moment)


def require_choice(value: object, allowed: Iterable[str], *at: str) -> str:
    """One of the allowed texts."""
    listed = list(allowed)
    if not isinstance(value, str) or value not in listed:
        wrong(ReasonCode.WRONG_VALUE, f"{shown(value)} is not one of {', '.join(listed)}", *at)
    return value


def _methods(value: object) -> dict[Sensor, Approach]:
    """One name for all sensors, or a table of them."""
    if not isinstance(value, Mapping):
        return dict.fromkeys(SENSORS, Approach(require_choice(value, Approach)))
    return {sensor: Approach(require_choice(item, Approach, sensor)) for sensor, item in _by_sensor(value).items()}


def _units(value: object) -> dict[Sensor, str]:
    return {sensor: require_choice(unit, UNITS[sensor], sensor) for sensor, unit in _by_sensor(value).items()}


def _table_of_choices(allowed: Mapping[Sensor, Iterable[str]]) -> dict[str, object]:
    properties = {str(sensor): {"enum": [str(choice) for choice in choices]} for sensor, choices in allowed.items()}
    return {"type": "object", "properties": properties, "additionalProperties": False}


UNITS = {
    Sensor.MAGNETOMETER: ("counts", "T", "uT", "G", "norm"),
    Sensor.ACCELEROMETER: ("counts", "m/s^2", "g"),
    Sensor.GYROSCOPE: ("counts", "rad/s", "deg/s"),
}
_IMU_COLUMNS = {
    "t": 1,
    **{str(sensor): 3 for sensor in SENSORS},
    **{"temperature": 1, "current": 1, "throttle": 1, "instance": 1},
    **{"gnss_velocity": 3, "gnss_velocity_sd": 1},
}
_VPS_COLUMNS = {"t": 1, "quaternion_xyzw": 4, "quaternion_wxyz": 4, "roll_pitch_yaw": 3, "position": 3}
_IMU_FIELDS = {**{str(sensor): 3 for sensor in SENSORS}, "temperature": 1}
_ONE_NUMBER = {"type": "number", "exclusiveMinimum": 0}
_THREE_NUMBERS = {"type": "array", "items": _ONE_NUMBER, "minItems": 3, "maxItems": 3}

Text = Annotated[str, Field(min_length=1)]
Character = Annotated[str, Field(min_length=1, max_length=1)]
Positive = Annotated[float, Field(gt=0)]
Triple = Annotated[names.Triple, _listed(3, "numbers")]
PositiveTriple = Annotated[
    tuple[Positive, Positive, Positive],
    BeforeValidator(_one_or_three),
    WithJsonSchema({"anyOf": [_ONE_NUMBER, _THREE_NUMBERS]}),
]
ImuIds = Annotated[
    str | tuple[DatedImu, ...],
    BeforeValidator(_imu_ids),
    WithJsonSchema(
        {
            "anyOf": [
                {"type": "string"},
                {
                    "type": "array",
                    "items": {
                        "type": "object",
                        "properties": {"id": {"type": "string"}, "from": {"type": "string", "format": "date"}},
                        "required": ["id"],
                        "additionalProperties": False,
                    },
                },
            ]
        }
    ),
]
Signs = Annotated[
    names.Signs,
    BeforeValidator(_signs),
    WithJsonSchema({"type": "array", "items": {"enum": [1, -1]}, "minItems": 3, "maxItems": 3}),
]
Rotation = Annotated[tuple[Triple, Triple, Triple], _listed(3, "rows of three numbers"), AfterValidator(_orthonormal)]
PerSensor = Annotated[dict[Sensor, T], BeforeValidator(_by_sensor)]
Methods = Annotated[
    dict[Sensor, Approach],
    BeforeValidator(_methods),
    WithJsonSchema(
        {"anyOf": [{"enum": [str(name) for name in Approach]}, _table_of_choices(dict.fromkeys(SENSORS, Approach))]}
    ),
]
Units = Annotated[dict[Sensor, str], BeforeValidator(_units), WithJsonSchema(_table_of_choices(UNITS))]
ImuColumns = Annotated[dict[str, Paths], BeforeValidator(_columns(_IMU_COLUMNS)), _columns_schema(_IMU_COLUMNS)]
VpsColumns = Annotated[dict[str, Paths], BeforeValidator(_columns(_VPS_COLUMNS)), _columns_schema(_VPS_COLUMNS)]
ImuFields = Annotated[
    dict[str, Paths],
    BeforeValidator(_columns(_IMU_FIELDS, one_for_all=True)),
    _columns_schema(_IMU_FIELDS, one_for_all=True),
]
