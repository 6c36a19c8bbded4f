"""What an autopilot flies with beside what the history says of its sensors, axis by axis, and what the difference does.

Both are told for the raw sensor in the axes and units in which the autopilot calibrates it, at the temperature of the
constants: a zero of what is loaded includes its compensation of temperature.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from fieldcal.config.flight_settings import STANDARD_GRAVITY_MPS2
from fieldcal.errors import FieldcalError
from fieldcal.exports.autopilots.affine import rotation_and_symmetric
from fieldcal.exports.autopilots.ardupilot_slot import ArduPilot
from fieldcal.exports.autopilots.loading import Loadable, Request, Slots, loadable, unchanged, without_constants
from fieldcal.exports.autopilots.px4_slot import Px4
from fieldcal.exports.autopilots.units import SHOWN_UNIT
from fieldcal.exports.calibration import Constants
from fieldcal.names import Sensor
from fieldcal.reason_codes import ReasonCode
from fieldcal.stages.tables import AXES
from fieldcal.words.numbers import number, with_sd

TARGETS: Mapping[str, Slots] = {"px4": Px4(), "ardupilot": ArduPilot()}
FIRST_LETTERS = {"px4": ("CAL_", "TC_"), "ardupilot": ("INS_", "COMPASS_")}
"""Of the parameters by which a file tells whose it is."""
DEAD_RECKONING_S = 60.0
FULL_TURN_DEG = 360.0
MATTERS = {"° in 60 s": 5.0, "° a turn": 3.0, "mg": 5.0, "° of heading": 1.0}
"""Effects from which on a difference is worth a change: of attitude by rates alone, in a full turn, of tilt and speed,
of course."""
SURE_SD = 2.0
"""And beyond so many standard deviations."""
ROUNDING = 1e-9
NONE = "–"
COLUMNS = ("sensor", "axis", "of", "flies with", "estimate", "difference", "which is", "parameter", "matters")


@dataclass(frozen=True)
class Compared:
    """One constant of one axis.

    Attributes
    ----------
    sensor, unit_id, axis : str
        Axis of the sensor as its autopilot calibrates it.
    parameter : {"zero", "scale"}
        Of z = scale (raw − zero); of a magnetometer the diagonal of its matrix.
    name : str or None
        The autopilot's parameter that would change; None where it has no place for it.
    flies_with, estimate, sd : float
        In `unit`; sd NaN where it is not known, both where there is no estimate.
    unit : str
    effect : float or None
        What the difference does, in `effect_unit`; None where that is not known.
    effect_unit : str
    matters : bool
        Whether it does more than `MATTERS`, surely.

    Examples
    --------
    >>> Compared("gyroscope", "b/1", "x", "zero", "CAL_GYRO0_XOFF", 0.0, 0.01, 1e-3, "rad/s", 34.4, "° in 60 s", True)
    ... # doctest: +ELLIPSIS
    Compared(sensor='gyroscope', ...)
    """

    sensor: str
    unit_id: str
    axis: str
    parameter: Literal["zero", "scale"]
    name: str | None
    flies_with: float
    estimate: float
    sd: float
    unit: str
    effect: float | None
    effect_unit: str
    matters: bool


def compared(constants: Constants, request: Request | None = None) -> tuple[list[Compared], tuple[str, ...]]:
    """Every constant of every unit whose autopilot's parameters are known, estimated or not; and what is to be said.

    Raises
    ------
    FieldcalError
        `not_loadable`: the parameters are neither in the log nor given.
    """
    asked = request or Request()
    target = TARGETS[_autopilot(constants, asked)]
    rows: list[Compared] = []
    found: list[Loadable] = []
    try:
        found, told = loadable(constants, target, asked)
    except FieldcalError as error:
        told = [error.sentence]
    for one in found:
        if not one.parameters:
            why = f"{one.sensor}: what it flies with is not known; give --params."
            raise FieldcalError(ReasonCode.NOT_LOADABLE, why)
        rows += _of_sensor(one, target)
    for one in without_constants(constants, target, asked, found):
        rows += _of_sensor(one, target, estimated=False)
    if not rows:
        raise FieldcalError(ReasonCode.NOT_LOADABLE, " ".join(told))
    return rows, tuple(told)


def lines(rows: Sequence[Compared]) -> list[list[str]]:
    """Cells of a table with `COLUMNS`."""
    return [
        [
            row.sensor,
            row.axis,
            f"{row.parameter}, {row.unit}" if row.unit else row.parameter,
            number(row.flies_with),
            with_sd(row.estimate, row.sd if np.isfinite(row.sd) else None) if np.isfinite(row.estimate) else NONE,
            number(_shown(row.estimate - row.flies_with), 3) if np.isfinite(row.estimate) else NONE,
            NONE if row.effect is None else f"{number(_shown(row.effect), 3)} {row.effect_unit}",
            row.name or "none",
            ("yes" if row.matters else "no") if np.isfinite(row.estimate) else NONE,
        ]
        for row in rows
    ]


def _shown(value: float) -> float:
    """Without what is rounding only."""
    return 0.0 if abs(value) < ROUNDING else value


def _autopilot(constants: Constants, request: Request) -> str:
    """Which autopilot is meant: the log's, else the one whose parameters are given."""
    for origin in constants.origins.values():
        if origin.loaded is not None:
            return origin.loaded.autopilot
    for name, first in FIRST_LETTERS.items():
        if any(parameter.startswith(first) for parameter in request.parameters or ()):
            return name
    raise FieldcalError(
        ReasonCode.NOT_LOADABLE,
        f"What {constants.vehicle_id} flies with is not in its logs; give --params, a file of PX4's or ArduPilot's"
        " parameters.",
    )


def _of_sensor(one: Loadable, target: Slots, *, estimated: bool = True) -> list[Compared]:
    as_it_is = unchanged(one.triad.unit, one.triad.temperature_degc)
    flown = target.raw(as_it_is, one.sensor, one.slot, one.parameters)
    scale, there = one.triad.scale, flown.scale
    if one.sensor == Sensor.MAGNETOMETER:
        scale = rotation_and_symmetric(scale)[1]
    rows: list[Compared] = []
    size = target.magnetic_unit if one.sensor == Sensor.MAGNETOMETER else 1.0
    for i, axis in enumerate(AXES):
        zero = size * one.triad.zero[i], size * flown.zero[i], size * one.triad.zero_sd[i]
        factor = scale[i, i], there[i, i], one.triad.scale_sd[i]
        for what, (estimate, loaded, sd), shown in (("zero", zero, SHOWN_UNIT[one.sensor]), ("scale", factor, "")):
            if what == "scale" and one.triad.scale_nominal:
                continue
            if not estimated:
                estimate, sd = np.nan, np.nan
            effect, effect_unit = _effect(one.sensor, what, abs(estimate - loaded), one.horizontal_field_g)
            sure = not np.isfinite(sd) or abs(estimate - loaded) > SURE_SD * sd
            if not np.isfinite(estimate):
                effect, effect_unit = None, ""
            rows.append(
                Compared(
                    str(one.sensor),
                    one.unit_id,
                    axis,
                    "zero" if what == "zero" else "scale",
                    target.parameter(one.sensor, one.slot, "zero" if what == "zero" else "scale", i),
                    float(loaded),
                    float(estimate),
                    float(sd),
                    shown,
                    effect,
                    effect_unit,
                    bool(sure and effect is not None and effect >= MATTERS[effect_unit]),
                )
            )
    return rows


def _effect(sensor: Sensor, what: str, difference: float, field_g: float | None) -> tuple[float | None, str]:
    """What a difference does: of a zero in rad/s, m/s² or G, of a scale as a share."""
    if sensor == Sensor.GYROSCOPE:
        if what == "zero":
            return float(np.rad2deg(difference) * DEAD_RECKONING_S), "° in 60 s"
        return difference * FULL_TURN_DEG, "° a turn"
    if sensor == Sensor.ACCELEROMETER:
        return 1e3 * (difference / STANDARD_GRAVITY_MPS2 if what == "zero" else difference), "mg"
    # A zero of one axis turns the field by at most so much; two axes' scales that differ by s turn it by s / 2.
    if what == "scale":
        return float(np.rad2deg(0.5 * difference)), "° of heading"
    return (None if not field_g else float(np.rad2deg(np.arctan2(difference, field_g)))), "° of heading"
