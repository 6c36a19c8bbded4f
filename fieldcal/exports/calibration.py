"""The constants an aircraft flies with, and what they make of readings: the model that every export is a form of.

    z = Λ(T) (z_d − zero(T)),  Λ(T) = Λ + Λ' d,  zero(T) = zero + zero₁ d + zero₂ d² + zero₃ d³,  d = T − T0

Eq. 5 with its offset in logged units: autopilots subtract before they scale, and `zero` keeps a counts log's digits.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike

from fieldcal.config.loaded import Loaded
from fieldcal.geometry.rotation import Array
from fieldcal.geometry.sensor_model import through
from fieldcal.names import Rotation, Sensor
from fieldcal.stages.tables import AXES

NOT_TURNED: Rotation = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


def cubic_about(first: Array, second: Array, third: Array, by_degc: float) -> tuple[Array, Array, Array]:
    """Coefficients of d, d² and d³ of a cubic that had these about a point `by_degc` below: c(d + by) − c(by)."""
    return first + 2.0 * second * by_degc + 3.0 * third * by_degc**2, second + 3.0 * third * by_degc, third


@dataclass(frozen=True)
class Triad:
    """Constants of one triad at `temperature_degc` T0, sensor axes as logged: z = Λ(T)(z_d − zero(T)).

    Attributes
    ----------
    scale, scale_per_degc : (3, 3) array
        Λ in `unit` per `logged_unit`, and its slope per °C (0 where unknown).
    zero, zero_per_degc, zero_per_degc2, zero_per_degc3 : (3,) array
        In `logged_unit`, and its slope and bend per °C, °C² and °C³ (0 where unknown).
    scale_sd, zero_sd : (3,) array
        One standard deviation of Λ's diagonal and of zero; NaN where unknown.
    unit, logged_unit : str
        Of calibrated and of logged readings.
    temperature_degc : float
        T0, °C.
    flown_degc : (float, float) or None
        Lowest and highest temperature of the history, °C; None without a slope.
    why : tuple of str
        Where the numbers come from.
    zero_per_degc_sd : (3,) array
        One standard deviation of zero's slope; infinite where no slope is known, 0 where it is taken as it is.
    scale_nominal : bool
        Whether no flight tells Λ, so that it is 1, as the autopilot takes it.

    Examples
    --------
    >>> import numpy as np
    >>> nothing = np.zeros(3)
    >>> triad = Triad(np.diag([2.0, 2.0, 4.0]), np.ones(3), np.zeros((3, 3)), nothing, nothing, nothing, "deg/s",
    ...               "counts", 25.0, None, ())
    >>> triad.apply([[1.0, 2.0, 3.0]])
    array([[0., 2., 8.]])
    """

    scale: Array
    zero: Array
    scale_per_degc: Array
    zero_per_degc: Array
    scale_sd: Array
    zero_sd: Array
    unit: str
    logged_unit: str
    temperature_degc: float
    flown_degc: tuple[float, float] | None
    why: tuple[str, ...]
    zero_per_degc2: Array = field(default_factory=lambda: np.zeros(3))
    zero_per_degc3: Array = field(default_factory=lambda: np.zeros(3))
    zero_per_degc_sd: Array = field(default_factory=lambda: np.zeros(3))
    scale_nominal: bool = False

    @property
    def diagonal(self) -> bool:
        """Whether the axes are independent: no soft iron, no cross-axis terms."""
        return bool(np.array_equal(self.scale, np.diag(np.diagonal(self.scale))))

    @property
    def follows_temperature(self) -> bool:
        """Whether scale or zero has a slope on temperature."""
        return bool(np.any(self.scale_per_degc != 0.0) or np.any(self.zero_per_degc != 0.0))

    def turned(self, turn: Array) -> Triad:
        """The same constants in other axes: of readings and results that `turn`, (3, 3) orthogonal, was applied to.

        The standard deviation of Λ is that of its diagonal, as far as the diagonal as it was tells.
        """
        square = turn**2
        return replace(
            self,
            scale=turn @ self.scale @ turn.T,
            scale_per_degc=turn @ self.scale_per_degc @ turn.T,
            zero=turn @ self.zero,
            zero_per_degc=turn @ self.zero_per_degc,
            zero_per_degc2=turn @ self.zero_per_degc2,
            zero_per_degc3=turn @ self.zero_per_degc3,
            scale_sd=np.sqrt(through(square**2, self.scale_sd**2)),
            zero_sd=np.sqrt(through(square, self.zero_sd**2)),
            zero_per_degc_sd=np.sqrt(through(square, self.zero_per_degc_sd**2)),
        )

    def apply(self, logged: ArrayLike, temperature_degc: ArrayLike | None = None) -> Array:
        """z (n, 3) from readings (n, 3), at T0 or at a temperature (n,) for each; where it is NaN at T0."""
        z = np.asarray(logged, dtype=float)
        if temperature_degc is None:
            return np.asarray((z - self.zero) @ self.scale.T)
        warmer = np.asarray(temperature_degc, dtype=float) - self.temperature_degc
        warmer = np.where(np.isfinite(warmer), warmer, 0.0)[:, None]
        bend = self.zero_per_degc2 + warmer * self.zero_per_degc3
        off = z - self.zero - warmer * (self.zero_per_degc + warmer * bend)
        return np.asarray(off @ self.scale.T + warmer * (off @ self.scale_per_degc.T))


@dataclass(frozen=True)
class Origin:
    """Where a sensor's readings came from, as their log and fieldcal.toml tell: what has to be known before constants
    are put back there.

    Attributes
    ----------
    loaded : Loaded or None
        What the autopilot that wrote the log had loaded; the constants are those of the raw sensor. None: no autopilot
        wrote it, and whether one had corrected the readings is not known.
    body : {"frd", "flu"}
        Axes of the readings.
    gravity_sign : {"specific_force", "gravity"}
        What an accelerometer reads at rest.
    rotation_body_from_sensor : rows of a (3, 3) matrix
    temperature_degc : float or None
        Of the flight, °C: that of a zero whose slope is not known.
    horizontal_field_g : float or None
        North and east of the local field, gauss; None where its strength is not known.
    horizontal_share : float or None
        The same as a share of the field; None where its dip is not known either.

    Examples
    --------
    >>> Origin().body
    'frd'
    """

    loaded: Loaded | None = None
    body: str = "frd"
    gravity_sign: str = "specific_force"
    rotation_body_from_sensor: Rotation = NOT_TURNED
    temperature_degc: float | None = None
    horizontal_field_g: float | None = None
    horizontal_share: float | None = None


@dataclass(frozen=True)
class Constants:
    """What a vehicle flies with.

    Attributes
    ----------
    vehicle_id, imu_id : str
        Who.
    triads : mapping of str to Triad
        Sensor → its constants; a sensor without any is left out. Of a gyroscope in
        an autopilot's log its zeros are enough.
    as_of : str
        ISO 8601 of the latest flight that they come from; empty when its clock is unknown.
    unit_ids : mapping of str to str
        Sensor → the unit that its constants belong to; empty where that is not told.
    origins : mapping of str to Origin
        Sensor → where its readings came from, also of a sensor without constants; left out where that is not known.
    further : tuple of Constants
        Those of further units on board, for targets that have a place for each.
    imu_rate_hz : float or None
        Rate of the latest flight's readings.

    Examples
    --------
    >>> Constants("quad-1", "imu-7", {}, "2026-01-12").heading
    'fieldcal: quad-1, IMU imu-7, as of 2026-01-12'
    """

    vehicle_id: str
    imu_id: str
    triads: Mapping[str, Triad]
    as_of: str
    unit_ids: Mapping[str, str] = field(default_factory=dict)
    origins: Mapping[str, Origin] = field(default_factory=dict)
    further: tuple[Constants, ...] = ()
    imu_rate_hz: float | None = None

    @property
    def heading(self) -> str:
        """Who and when, on one line whatever the ids are."""
        return " ".join(f"fieldcal: {self.vehicle_id}, IMU {self.imu_id}, as of {self.as_of or 'unknown'}".split())


@dataclass(frozen=True)
class Written:
    """A number that was handed out to fly with.

    Attributes
    ----------
    unit_id, sensor : str
        Whose.
    name : str
        The autopilot's parameter; in other formats the constant and its axes, as zero_x or scale_xy.
    value : float
        As its target has it.

    Examples
    --------
    >>> Written("b/1", "gyroscope", "CAL_GYRO0_XOFF", 0.01).name
    'CAL_GYRO0_XOFF'
    """

    unit_id: str
    sensor: str
    name: str
    value: float


@dataclass(frozen=True)
class Export:
    """A text in somebody else's format, and what that format cannot hold.

    Attributes
    ----------
    text : str
    warnings : tuple of str
        What the target cannot hold, and what is left to do.
    written : tuple of Written
        The numbers that were handed out, sensor by sensor: an autopilot's parameters, of other formats the constants
        that they hold.

    Examples
    --------
    >>> import fieldcal
    >>> fieldcal.export(fieldcal.Constants("quad-1", "quad-1", {}, ""), "json").warnings
    ()
    """

    text: str
    warnings: tuple[str, ...]
    written: tuple[Written, ...] = ()


def written(constants: Constants, held: Mapping[Sensor, Sequence[str]]) -> tuple[Written, ...]:
    """The constants that a format other than an autopilot's is given: of each sensor those that it holds."""
    return tuple(
        Written(constants.unit_ids.get(sensor, ""), sensor, name, float(value))
        for sensor, triad in constants.triads.items()
        for name, value in (
            *((f"zero_{axis}", triad.zero[i]) for i, axis in enumerate(AXES)),
            *(
                (f"scale_{a}" if i == j else f"scale_{a}{b}", triad.scale[i, j])
                for i, a in enumerate(AXES)
                for j, b in enumerate(AXES)
                if i == j or not triad.diagonal
            ),
        )
        if name.partition("_")[0] in held.get(Sensor(sensor), ())
    )


def nominal_scales(constants: Constants) -> tuple[str, ...]:
    """What is to be said of sensors whose zeros alone are known."""
    return tuple(
        f"{sensor}: only its zeros are known; its scales, which no flight tells, are left at 1."
        for own in (constants, *constants.further)
        for sensor, triad in own.triads.items()
        if triad.scale_nominal
    )
