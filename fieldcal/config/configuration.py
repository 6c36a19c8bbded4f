"""`fieldcal.toml`: what the night needs to know of the vehicles and the logs cannot say themselves.

One file for all vehicles. `[defaults]` may hold every key of a vehicle; `[vehicles."<id>"]` overrides, table by table
and key by key (a `field` is replaced whole: it comes in two forms). Everything is checked when the file is loaded, also
for vehicles that no log mentions, so that a misprint shows before the night and not in it.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Annotated, Literal, TypeVar

from pydantic import AfterValidator, Field, ValidationError
from pydantic.fields import FieldInfo

from fieldcal.config.mistakes import configuration_error
from fieldcal.config.parameters import PROFILES, Parameters
from fieldcal.config.values import (
    Character,
    ImuColumns,
    ImuFields,
    ImuIds,
    Methods,
    PerSensor,
    Positive,
    PositiveTriple,
    Rotation,
    Signs,
    Table,
    Text,
    Triple,
    Units,
    VpsColumns,
    shown,
    wrong,
)
from fieldcal.errors import ConfigurationError
from fieldcal.names import SENSORS, Approach, Body, CsvPreset, FieldUnit, GravitySign, Json, ProfileName, World
from fieldcal.reason_codes import ReasonCode

IDENTITY = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
CsvTimeUnit = Literal["s", "ms", "us", "ns", "iso8601", "time_of_day"]
VPS_ATTITUDES = ("quaternion_xyzw", "quaternion_wxyz", "roll_pitch_yaw")
FIELD_UNITS = ("norm", "T", "uT", "G")
AnyTable = TypeVar("AnyTable", bound=Table)


def _meaning(text: str, unit: str = "") -> FieldInfo:
    """What a key means, for people and for editors."""
    return Field(description=text, json_schema_extra={"unit": unit} if unit else None)


class LocalField(Table):
    """Local magnetic field: given as north, east, down in `unit`, or a place for the World Magnetic Model."""

    unit: FieldUnit = "uT"
    north_east_down: Annotated[Triple | None, _meaning("the field itself, in `unit`")] = None
    latitude_deg: Annotated[float | None, Field(ge=-90.0, le=90.0, json_schema_extra={"unit": "deg"})] = None
    longitude_deg: Annotated[float | None, Field(ge=-180.0, le=360.0, json_schema_extra={"unit": "deg"})] = None
    altitude_m: Annotated[float, Field(ge=-1e3, le=8.5e5, json_schema_extra={"unit": "m"})] = 0.0

    @classmethod
    def check_whole(cls, raw: Mapping[str, object]) -> None:
        """Either the field itself with its unit, or a place."""
        if "north_east_down" in raw:
            if others := sorted(raw.keys() - {"north_east_down", "unit"}):
                told = f"give either north_east_down or a place, not both (north_east_down and {others[0]})"
                wrong(ReasonCode.WRONG_VALUE, told)
            if "unit" not in raw:
                wrong(ReasonCode.WRONG_VALUE, f"north_east_down needs its unit, one of {', '.join(FIELD_UNITS)}")
            vector = raw["north_east_down"]
            if isinstance(vector, list | tuple) and len(vector) == 3 and not any(vector):
                wrong(ReasonCode.WRONG_VALUE, "the field cannot be zero", "north_east_down")
            return
        for key in ("latitude_deg", "longitude_deg"):
            if key not in raw:
                wrong(
                    ReasonCode.WRONG_VALUE,
                    f"{key} is missing; give north_east_down and unit, or latitude_deg and longitude_deg",
                )


class CsvMap(Table):
    """Where a vehicle's CSV logs differ from the default columns. `imu` and `vps` hold configured names only."""

    preset: Annotated[
        Literal["none", CsvPreset] | None, _meaning("the format by its name, or none; else it is recognised")
    ] = None
    time_unit: Annotated[CsvTimeUnit | None, _meaning("unit of the time column of the IMU's file")] = None
    vps_time_unit: Annotated[CsvTimeUnit | None, _meaning("unit of the VPS's time column, where it does not say")] = (
        None
    )
    rate_hz: Annotated[Positive | None, _meaning("rate of the rows, where no column tells time", "Hz")] = None
    clock_period_s: Annotated[
        Positive | None, _meaning("time after which the clock begins again at zero, where no known counter's", "s")
    ] = None
    imu: Annotated[ImuColumns, _meaning("names of the columns of the IMU; three for a sensor")] = {}
    vps: Annotated[VpsColumns, _meaning("names of the columns of the visual positioning system")] = {}
    vps_angle_unit: Annotated[Literal["deg", "rad"] | None, _meaning("unit of csv.vps.roll_pitch_yaw")] = None
    instance: Annotated[
        Text | None, _meaning("which of several IMUs in one file: what their column csv.imu.instance says")
    ] = None
    separator: Annotated[Character | None, _meaning("what separates the cells")] = None
    decimal: Annotated[Literal[".", ","] | None, _meaning("the decimal point")] = None

    @classmethod
    def check_whole(cls, raw: Mapping[str, object]) -> None:
        """No two keys contradict each other, no column is two things."""
        separator = raw.get("separator")
        if isinstance(separator, str) and (separator.isalnum() or separator in '+-."#'):
            wrong(ReasonCode.WRONG_VALUE, f"{shown(separator)} stands in numbers or words", "separator")
        attitudes = [key for key in VPS_ATTITUDES if key in _keys(raw.get("vps"))]
        if len(attitudes) > 1:
            wrong(ReasonCode.WRONG_VALUE, f"give one attitude, not both {attitudes[0]} and {attitudes[1]}", "vps")
        if "vps_angle_unit" in raw and "roll_pitch_yaw" not in attitudes:
            wrong(ReasonCode.WRONG_VALUE, "it needs csv.vps.roll_pitch_yaw, the angles", "vps_angle_unit")
        for table in ("imu", "vps"):
            taken: dict[object, str] = {}
            for key, named in _keys(raw.get(table)).items():
                for name in named if isinstance(named, list | tuple) else [named]:
                    if isinstance(name, str) and taken.setdefault(name, key) != key:
                        wrong(ReasonCode.WRONG_VALUE, f"{shown(name)} cannot be {taken[name]} and {key}", table)


def _keys(table: object) -> Mapping[str, object]:
    return table if isinstance(table, Mapping) else {}


class McapMap(Table):
    """Topics and fields of a vehicle's MCAP and ROS logs where message types alone do not decide."""

    imu: Text | None = None
    magnetometer: Text | None = None
    vps: Text | None = None
    vps_frame: Annotated[
        Text | None, _meaning("the vehicle's frame among transforms (/tf): its pose is the VPS; a child frame")
    ] = None
    vps_parent_frame: Annotated[Text | None, _meaning("the frame that vps_frame is given in, where several are")] = None
    temperature: Text | None = None
    power: Text | None = None
    position: Text | None = None
    gnss_velocity: Annotated[
        Text | None, _meaning("velocity of a satellite receiver: east, north, up, as ROS drivers have it")
    ] = None
    imu_fields: Annotated[ImuFields | None, _meaning("fields of the IMU's message: one vector, or three numbers")] = (
        None
    )
    frame_id: Annotated[
        Text | None, _meaning("the primary one of several IMUs on one topic: its messages' frame_id")
    ] = None
    further: Annotated[
        list[Text], _meaning("topics of further IMUs and magnetometers on board, calibrated beside the primary ones")
    ] = []
    time: Annotated[Literal["header", "log"], _meaning("the stamp used: the message's own, or the recorder's")] = (
        "header"
    )


class VehicleTable(Table):
    """What the file may say of a vehicle. None: the log decides."""

    imu_id: Annotated[
        ImuIds | None, _meaning("the IMU on board, or several with the day from which each is; else the vehicle's name")
    ] = None
    method: Annotated[Methods, _meaning("how sensors are calibrated; one name for all, or one for each")] = {}
    profile: Annotated[ProfileName, _meaning("presets of the stage parameters")] = "full"
    world: Annotated[World | None, _meaning("axes of the world that the VPS's attitudes refer to")] = None
    body: Annotated[Body | None, _meaning("axes of the body: nose-starboard-underside, or nose-port-up")] = None
    gravity_sign: Annotated[GravitySign | None, _meaning("what the accelerometer reads at rest")] = None
    gravity_mps2: Annotated[
        float, Field(ge=9.7, le=9.9, description="local gravity", json_schema_extra={"unit": "m/s^2"})
    ] = 9.80665
    field: Annotated[LocalField | None, _meaning("local magnetic field")] = None
    rotation_body_from_sensor: Annotated[Rotation, _meaning("turns sensor axes into body axes")] = IDENTITY
    lever_arm_m: Annotated[Triple | None, _meaning("from the centre of mass to the IMU, body axes", "m")] = None
    polarity: Annotated[PerSensor[Signs], _meaning("sign of each axis as wired")] = {}
    units: Annotated[Units, _meaning("units of the logged readings")] = {}
    nominal_scale: Annotated[PerSensor[PositiveTriple], _meaning("scale of the data sheet, one or three numbers")] = {}
    reference_reading: Annotated[PerSensor[Triple], _meaning("reading at which zero_bias is told")] = {}
    units_on_board: Annotated[
        Literal["all", "primary"], _meaning("which IMUs and magnetometers of a log with several are calibrated")
    ] = "all"
    simulated: Annotated[
        bool, _meaning("the vehicle is a simulation; else logs of simulated sensors are set aside")
    ] = False
    csv: CsvMap = CsvMap()
    mcap: McapMap = McapMap()
    parameters: Parameters = Parameters()


class Vehicle(VehicleTable):
    """All that is configured of one vehicle, defaults and profile worked in; method and polarity of every sensor."""

    vehicle_id: str
    imu_id: ImuIds

    @property
    def dated(self) -> bool:
        """Whether the configuration says which IMU was on board when, also in the past."""
        return not isinstance(self.imu_id, str)

    def imu_at(self, moment: datetime | None) -> str:
        """The IMU on board at a moment; of an unknown one, the last. Before the first, the vehicle's own name."""
        if isinstance(self.imu_id, str):
            return self.imu_id
        on_board = [
            one for one in sorted(self.imu_id, key=lambda one: one.since) if moment is None or one.since <= moment
        ]
        return on_board[-1].id if on_board else self.vehicle_id

    def settings(self) -> dict[str, Json]:
        """Plain JSON of everything that can change results; names of vehicle and IMU do not, nor does the profile's,
        nor what else on board is calibrated."""
        return self.model_dump(mode="json", exclude={"vehicle_id", "imu_id", "profile", "units_on_board"})


def _inside(glob: str) -> str:
    if Path(glob).is_absolute() or ".." in Path(glob).parts:
        wrong(ReasonCode.WRONG_VALUE, f"{shown(glob)} leaves the archive; give a glob relative to it")
    return glob


class LogsMap(Table):
    """Logs that do not lie as `<vehicle>/<session>/<log>`: a glob relative to the archive and what it stands for.

    `vehicle` and `session` may be None: then the folders' names decide.
    """

    glob: Annotated[Text, AfterValidator(_inside)]
    vehicle: Text | None = None
    session: Text | None = None

    @classmethod
    def check_whole(cls, raw: Mapping[str, object]) -> None:
        """The glob is needed."""
        if "glob" not in raw:
            wrong(ReasonCode.WRONG_VALUE, "glob is missing: the files this entry stands for")


class Archive(Table):
    """`[archive]`."""

    logs: list[LogsMap] = []


class Alerts(Table):
    """When to warn: days after which a sensor's latest calibration has expired, and a vehicle without a usable flight
    is idle. And whom to tell."""

    expires_days: Annotated[Positive, _meaning("age at which a calibration has expired", "d")] = 90.0
    idle_days: Annotated[Positive, _meaning("time without a usable flight after which a vehicle is idle", "d")] = 30.0
    to: Annotated[
        list[Text], _meaning("whom the night tells what is new: apprise's URLs, $NAME from the environment")
    ] = []
    link: Annotated[Text | None, _meaning("URL of the folder of reports, for links in messages")] = None
    metrics: Annotated[Text | None, _meaning("file that a night writes its metrics to, OpenMetrics text (.prom)")] = (
        None
    )


class Site(Table):
    """The site of linked pages."""

    write: Annotated[bool, _meaning("whether each night brings it up to the history; fieldcal site does so anyway")] = (
        True
    )


class Room(Table):
    """How large the warehouse may become."""

    largest_gb: Annotated[
        Positive | None,
        _meaning("size beyond which a night removes readings and results of stages of the oldest flights", "GB"),
    ] = None


class Limits(Table):
    """What one log may take of the machine in a night, reading and all stages together. Results do not depend on it."""

    seconds: Annotated[Positive, _meaning("time after which the work on a log is ended", "s")] = 7200.0
    cpu_seconds: Annotated[Positive, _meaning("time of the processor after which it is ended", "s")] = 3600.0
    memory_mb: Annotated[Positive, _meaning("memory of its process beyond which it is ended", "MB")] = 8192.0


class Tolerances(Table):
    """By how much the constants that a vehicle flies with may be off before it is to be calibrated again. Results do
    not depend on it; what is not given is not asked."""

    gyroscope_degps: Annotated[Positive | None, _meaning("of a gyroscope's zero", "deg/s")] = None
    accelerometer_mg: Annotated[Positive | None, _meaning("of an accelerometer's zero", "mg")] = None
    magnetometer_ut: Annotated[Positive | None, _meaning("of a magnetometer's zero", "uT")] = None
    heading_deg: Annotated[Positive | None, _meaning("of the heading by the magnetometer", "deg")] = None

    @property
    def given(self) -> bool:
        """Whether there is any."""
        return any(getattr(self, name) is not None for name in Tolerances.model_fields)


class LimitsTable(Limits, Tolerances):
    """`[limits]`: what one log may take of the machine in a night, and what a vehicle's constants may be off."""


class Document(Table):
    """The whole of `fieldcal.toml`."""

    defaults: Annotated[VehicleTable, _meaning("what holds for every vehicle that does not say otherwise")] = (
        VehicleTable()
    )
    vehicles: Annotated[dict[str, VehicleTable], _meaning("by the vehicle's folder")] = {}
    archive: Archive = Archive()
    alerts: Alerts = Alerts()
    limits: LimitsTable = LimitsTable()
    site: Site = Site()
    warehouse: Room = Room()


@dataclass(frozen=True)
class Configuration:
    """The loaded file. `vehicle` answers for any id; one that is not configured gets the defaults."""

    path: Path | None
    document: Document

    @property
    def vehicles(self) -> tuple[str, ...]:
        """Vehicles that the file names."""
        return tuple(self.document.vehicles)

    @property
    def logs(self) -> tuple[LogsMap, ...]:
        """Logs that do not lie in folders of vehicle and session."""
        return tuple(self.document.archive.logs)

    @property
    def alerts(self) -> Alerts:
        """When the report warns."""
        return self.document.alerts

    @property
    def largest_gb(self) -> float | None:
        """Size that nights hold the warehouse to; None for no limit."""
        return self.document.warehouse.largest_gb

    @property
    def writes_site(self) -> bool:
        """Whether each night writes the site."""
        return self.document.site.write

    @property
    def limits(self) -> Limits:
        """What one log may take of the machine."""
        return Limits(**{name: getattr(self.document.limits, name) for name in Limits.model_fields})

    @property
    def tolerances(self) -> Tolerances:
        """By how much constants may be off."""
        return Tolerances(**{name: getattr(self.document.limits, name) for name in Tolerances.model_fields})

    def vehicle(self, vehicle_id: str) -> Vehicle:
        """What is configured for `vehicle_id`."""
        table = _laid_over(self.document.defaults, self.document.vehicles.get(vehicle_id, VehicleTable()))
        given = {
            "imu_id": table.imu_id or vehicle_id,
            "method": dict.fromkeys(SENSORS, PROFILE_METHOD.get(table.profile, Approach.AUTO)) | table.method,
            "polarity": dict.fromkeys(SENSORS, (1, 1, 1)) | table.polarity,
            "parameters": _with_presets(table.parameters, table.profile),
        }
        return Vehicle(**{**dict(table), **given, "vehicle_id": vehicle_id})


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
        raise ConfigurationError(
            ReasonCode.CONFIG_NOT_READABLE, f"{path}: cannot be read ({error.strerror})."
        ) from error
    except UnicodeDecodeError as error:
        raise ConfigurationError(
            ReasonCode.CONFIG_SYNTAX, f"{path}: is not UTF-8 text (byte {error.start})."
        ) from error


def parse(text: str, path: Path | None) -> Configuration:
    """The same from the text of a file; `path` serves messages only."""
    file = str(path) if path else "fieldcal.toml"
    try:
        return Configuration(path, Document.model_validate(tomllib.loads(text)))
    except tomllib.TOMLDecodeError as error:
        raise ConfigurationError(ReasonCode.CONFIG_SYNTAX, f"{file}: is not TOML: {error}.") from error
    except ValidationError as error:
        raise configuration_error(file, Document, error) from error


def _laid_over(under: AnyTable, over: AnyTable) -> AnyTable:
    """`over` laid on `under`, tables key by key; a local field whole."""
    changes: dict[str, object] = {}
    for key in over.model_fields_set:
        below, above = getattr(under, key), getattr(over, key)
        if isinstance(above, dict) and isinstance(below, dict):
            changes[key] = {**below, **above}
        elif isinstance(above, Table) and isinstance(below, Table) and not isinstance(above, LocalField):
            changes[key] = _laid_over(below, above)
        else:
            changes[key] = above
    return under.model_copy(update=changes)


# What a profile other than "full" is: the paper's chain, or what runs on board of it.
PROFILE_METHOD: Mapping[ProfileName, Approach] = {"paper": Approach.SERIAL, "onboard": Approach.SERIAL}


def _with_presets(parameters: Parameters, profile: ProfileName) -> Parameters:
    """Parameters with a profile's presets where nothing is configured."""
    presets = {key: value for key, value in PROFILES[profile].items() if key not in parameters.model_fields_set}
    return parameters.model_copy(update=presets)
