"""What each stage takes of a flight's settings: one class a stage, put together from what several have in common.

A stage's class is all it can read, and all of it enters its run key: a field that no line of the stage reads runs it
again for nothing. Meaning and limits of the parameters stand in `fieldcal.config.parameters`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, is_dataclass
from typing import TypeVar, cast

from pydantic import TypeAdapter, ValidationError

from fieldcal.config.flight_settings import FlightSettings
from fieldcal.config.loaded import Loaded
from fieldcal.names import (
    Approach,
    AttitudeFit,
    EllipsoidFit,
    Equations,
    InitialAttitude,
    Json,
    Rotation,
    SegmentEnds,
    Sensor,
    Signs,
    Triple,
    UseVps,
)

# --- what several stages have in common


@dataclass(frozen=True, kw_only=True)
class StageSettings:
    """Base of them all."""


@dataclass(frozen=True, kw_only=True)
class Axes(StageSettings):
    """From sensor axes to the paper's body axes."""

    rotation_body_from_sensor: Rotation
    body: str


@dataclass(frozen=True, kw_only=True)
class Units(StageSettings):
    """Units of the logged readings."""

    units: Mapping[Sensor, str]


@dataclass(frozen=True, kw_only=True)
class Polarity(StageSettings):
    """Signs of the axes as wired."""

    polarity: Mapping[Sensor, Signs]


@dataclass(frozen=True, kw_only=True)
class NominalScale(StageSettings):
    """|scale| from logged to calibrated unit, None where nobody knows it."""

    nominal_scale: Mapping[Sensor, Triple | None]


@dataclass(frozen=True, kw_only=True)
class LoggedValues(Polarity, NominalScale):
    """What makes a vector of readings that no fit has calibrated."""


@dataclass(frozen=True, kw_only=True)
class ReferenceReading(Units):
    """d0 of `zero_bias`."""

    reference_reading: Mapping[Sensor, Triple | None]


@dataclass(frozen=True, kw_only=True)
class FieldStrength(StageSettings):
    """Local magnetic field, in a unit that does not matter here."""

    field_ned: Triple


@dataclass(frozen=True, kw_only=True)
class FieldOrigin(FieldStrength):
    """The same, and where it is known from."""

    field_source: str


@dataclass(frozen=True, kw_only=True)
class LocalField(FieldStrength):
    """Local magnetic field and its unit."""

    field_unit: str


@dataclass(frozen=True, kw_only=True)
class Gravity(StageSettings):
    """Local gravity, m/s²."""

    gravity_mps2: float


@dataclass(frozen=True, kw_only=True)
class GravitySign(StageSettings):
    """What the accelerometer reads at rest."""

    gravity_sign: str


@dataclass(frozen=True, kw_only=True)
class Differentiation(StageSettings):
    """Window of the local smoothed differentiation, s."""

    differentiation_window_s: float


@dataclass(frozen=True, kw_only=True)
class VectorConstants(LoggedValues, Units, FieldStrength):
    """What the constants of both vector triads are made of."""


@dataclass(frozen=True, kw_only=True)
class BodyVectors(VectorConstants, Axes, GravitySign):
    """What calibrated vectors in body axes are made of."""


@dataclass(frozen=True, kw_only=True)
class VpsAttitude(StageSettings):
    """Axes of the visual positioning system's attitudes."""

    world: str
    body: str


@dataclass(frozen=True, kw_only=True)
class VpsClock(StageSettings):
    """Limits of the synchronisation."""

    vps_max_lag_s: float
    vps_min_peak: float
    vps_max_gap_s: float


@dataclass(frozen=True, kw_only=True)
class VpsPoses(VpsAttitude, VpsClock, Polarity):
    """What decides which poses of the VPS are admitted, and on which clock."""


@dataclass(frozen=True, kw_only=True)
class EllipsoidSettings(LoggedValues, ReferenceReading):
    """An ellipsoid fit and the limits behind which it is refused."""

    ellipsoid: EllipsoidFit
    ellipsoid_max_condition: float
    ellipsoid_max_scale_sd: float
    ellipsoid_max_residual: float


@dataclass(frozen=True, kw_only=True)
class GyroSettings(LoggedValues, ReferenceReading, Axes):
    """How a gyroscope's fit is judged."""

    gyro_max_scale_sd: float


# --- one a stage


@dataclass(frozen=True, kw_only=True)
class SanitySettings(NominalScale, Units, LocalField, Gravity):
    """Stage `sanity`."""


@dataclass(frozen=True, kw_only=True)
class ManoeuvreSettings(NominalScale):
    """Stage `manoeuvre`."""

    manoeuvre_window_s: float
    manoeuvre_pad_s: float
    manoeuvre_rest_s: float
    manoeuvre_min_s: float
    manoeuvre_max_gap_s: float
    manoeuvre_excited_ratio: float


@dataclass(frozen=True, kw_only=True)
class SmoothingSettings(StageSettings):
    """Stage `smoothing`."""

    smoothing_cutoff_hz: float
    smoothing_ends: SegmentEnds
    smoothing_side_s: float


@dataclass(frozen=True, kw_only=True)
class MagnetometerSettings(EllipsoidSettings, LocalField):
    """Stage `magnetometer`."""


@dataclass(frozen=True, kw_only=True)
class AccelerometerSettings(EllipsoidSettings, Gravity):
    """Stage `accelerometer`."""


@dataclass(frozen=True, kw_only=True)
class AttitudeSettings(BodyVectors, Gravity, FieldOrigin):
    """Stages `attitude` and `attitude_pass2`."""

    attitude: AttitudeFit


@dataclass(frozen=True, kw_only=True)
class GyroEquationSettings(GyroSettings, Differentiation):
    """Stage `gyro_equation`."""

    equations: Equations
    smoothing_cutoff_hz: float
    smoothing_side_s: float


@dataclass(frozen=True, kw_only=True)
class GatedAccelerometerSettings(AccelerometerSettings, Axes, GravitySign, Differentiation):
    """Stage `accelerometer_pass2`."""

    lever_arm_m: Triple | None
    gate_norm: float
    gate_rate_radps: float


@dataclass(frozen=True, kw_only=True)
class VectorsSettings(Polarity, LocalField):
    """Stage `vectors`."""


@dataclass(frozen=True, kw_only=True)
class TriadUncertainty(BodyVectors, Gravity):
    """What carries the vector triads' uncertainty into the gyroscope's."""


@dataclass(frozen=True, kw_only=True)
class GyroEquationPass2Settings(GyroEquationSettings, TriadUncertainty):
    """Stage `gyro_equation_pass2`."""


@dataclass(frozen=True, kw_only=True)
class GyroOutputSettings(GyroSettings, TriadUncertainty):
    """Stage `gyro_output`."""

    gyro_output: bool
    initial_attitude: InitialAttitude
    shooting_s: float


@dataclass(frozen=True, kw_only=True)
class MomentsSettings(BodyVectors, LocalField, FieldOrigin, Gravity):
    """Stage `moments`."""


@dataclass(frozen=True, kw_only=True)
class WarmUpSettings(Units):
    """Stage `warm_up`."""

    manoeuvre_max_gap_s: float


@dataclass(frozen=True, kw_only=True)
class VpsReference(VpsPoses, Axes):
    """The VPS as a measurement of the joint estimate."""

    use_vps: UseVps


@dataclass(frozen=True, kw_only=True)
class JointSettings(BodyVectors, ReferenceReading, LocalField, FieldOrigin, Gravity, VpsReference):
    """Stage `joint`."""

    method: Mapping[Sensor, Approach]
    use_velocity: bool
    lever_arm_m: Triple | None
    ellipsoid_max_scale_sd: float
    ellipsoid_max_residual: float
    gyro_max_scale_sd: float
    prior_scale_sd: float
    prior_magnetometer_scale_sd: float
    prior_gyroscope_zero_dps: float
    prior_accelerometer_zero_mps2: float
    prior_magnetometer_zero: float


@dataclass(frozen=True, kw_only=True)
class VpsSyncSettings(LoggedValues, Axes, VpsPoses):
    """Stage `vps_sync`."""


@dataclass(frozen=True, kw_only=True)
class VerifySettings(BodyVectors, FieldOrigin, Gravity, SmoothingSettings, Differentiation):
    """Stage `verify`."""

    attitude: AttitudeFit
    initial_attitude: InitialAttitude


@dataclass(frozen=True, kw_only=True)
class ChoiceSettings(Axes, NominalScale):
    """Stage `choice`."""

    method: Mapping[Sensor, Approach]
    field_ned: Triple
    prior_scale_sd: float


@dataclass(frozen=True, kw_only=True)
class CompositionSettings(Axes, LocalField, FieldOrigin):
    """Stage `composition`."""

    applied_matrix: Mapping[Sensor, Rotation | None]
    applied_offset: Mapping[Sensor, Triple | None]
    applied_known: Mapping[Sensor, bool | None]
    applied_matrix_sd: Mapping[Sensor, float | None]
    applied_offset_sd: Mapping[Sensor, Triple | None]
    applied_offset_per_degc: Mapping[Sensor, Triple | None]
    gravity_sign: str
    loaded: Mapping[Sensor, Loaded | None]
    own_sensors: tuple[Sensor, ...]


# --- from a flight's settings, and to and from the plain JSON of a record

S = TypeVar("S", bound=StageSettings)


def names_of(kind: type[StageSettings]) -> tuple[str, ...]:
    """Names of the settings that a class takes."""
    return tuple(field.name for field in fields(kind))


def taken_from(flight: FlightSettings, kind: type[S]) -> S:
    """A stage's part of the flight's settings."""
    given = {**dict(flight.parameters), **vars(flight)}
    return kind(**{name: given[name] for name in names_of(kind)})


def as_json(settings: StageSettings) -> dict[str, Json]:
    """A stage's settings as plain JSON, as they enter its run key and its record."""
    return {field.name: _json(getattr(settings, field.name)) for field in fields(settings)}


def from_json(plain: Mapping[str, object], kind: type[S]) -> S | None:
    """The settings of a class from the plain JSON of one record or more; None where something is missing."""
    try:
        return TypeAdapter(kind).validate_python({name: plain[name] for name in names_of(kind) if name in plain})
    except ValidationError:
        return None


def _json(value: object) -> Json:
    if isinstance(value, Mapping):
        return {str(key): _json(item) for key, item in value.items()}
    if isinstance(value, tuple):
        return [_json(item) for item in value]
    if is_dataclass(value):
        return {field.name: _json(getattr(value, field.name)) for field in fields(value)}
    return str(value) if isinstance(value, str) else cast("float | None", value)
