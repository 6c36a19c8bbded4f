"""When a vehicle is to be calibrated again: by how much its constants may be off (`[limits]`), how they drift, and how
well that is known.

What is loaded is what the autopilot's log says, else what was exported last, else the constants of the last flight. Its
error now is the estimate less that; from there it goes with the trend's slope, and twice the sd of both goes with it.
The date is the first day on which the two together pass the limit."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta

import numpy as np

from fieldcal.config.configuration import Tolerances
from fieldcal.config.flight_settings import STANDARD_GRAVITY_MPS2
from fieldcal.exports.autopilots.comparison import Compared
from fieldcal.geometry.earth_field import UNIT_IN_TESLA
from fieldcal.names import Sensor, exactness
from fieldcal.report.trend import DAY_S, predicted
from fieldcal.schemas.reference import ENOUGH_SESSIONS, REFERENCE_DEGC
from fieldcal.schemas.rows import DriftRow
from fieldcal.words.measures import measure
from fieldcal.words.numbers import number

SURE_SD = 2.0
FARTHEST_D = 3650
"""No trend is believed for longer."""
MONTH_D = 30.0
ZERO = "zero_bias"


@dataclass(frozen=True)
class Due:
    """Of one axis. `at`: from when it may be off by more than its limit; None where that is not before ten years, or
    not known yet. `sessions`: how many more tell; `passed`: at the moment asked about."""

    unit_id: str
    imu_id: str
    sensor: str
    axis: str
    at: datetime | None
    sessions: int
    passed: bool
    sentence: str


@dataclass(frozen=True)
class Flown:
    """What a vehicle flies with, as far as it is known: by unit and sensor when it was exported; constants that its
    autopilot has loaded beside the estimate; the horizontal field, gauss, and as a share of the field."""

    exported_at: Mapping[tuple[str, str], datetime]
    loaded: Sequence[Compared]
    horizontal_field_g: float | None
    horizontal_share: float | None = None


UNKNOWN = Flown({}, (), None)


@dataclass(frozen=True, order=True)
class Limit:
    """By how much a zero may be off, in its unit, and as it is told."""

    value: float
    told: str


def due_of(rows: Sequence[DriftRow], tolerances: Tolerances, flown: Flown, now: datetime) -> list[Due]:
    """Each axis that has a limit, the first to pass it first; rows of `drift` of the units on board."""
    best: dict[tuple[str, str, str], DriftRow] = {}
    for row in rows:
        place = row["unit_id"], row["sensor"], row["axis"]
        exact = place not in best or exactness(row["method"]) < exactness(best[place]["method"])
        if row["parameter"] == ZERO and exact:
            best[place] = row
    found = list(_loaded(flown, tolerances, now))
    for row in best.values():
        limit = limit_in(row["sensor"], row["unit"], tolerances, flown)
        if limit is not None and row["value_at_25degc"] is not None:
            found.append(_due(row, limit, flown, now))
    far = datetime.max.replace(tzinfo=now.tzinfo)
    return sorted(found, key=lambda one: (not one.passed, one.at or far, one.sessions, one.sensor, one.axis))


def next_sentence(found: Sequence[Due]) -> str:
    """When the vehicle is to be calibrated again, and what decides it; "" without limits."""
    if not found:
        return ""
    first = found[0]
    if first.passed:
        return f"Recalibrate now. {first.sentence}"
    if first.at is not None:
        return f"Recalibrate by {first.at:%Y-%m-%d}. {first.sentence}"
    wanting = [one for one in found if one.sessions]
    return wanting[0].sentence if wanting else "By its trends it stays within its limits for ten years."


def limit_in(sensor: str, unit: str, tolerances: Tolerances, flown: Flown = UNKNOWN) -> Limit | None:
    """The limit of a sensor's zero in a unit; None where there is none, or it cannot be told in that unit."""
    return min(_limits(sensor, unit, tolerances, flown), default=None)


def _limits(sensor: str, unit: str, tolerances: Tolerances, flown: Flown) -> Iterator[Limit]:
    if sensor == Sensor.GYROSCOPE and tolerances.gyroscope_degps is not None and unit == "rad/s":
        yield _limit(float(np.deg2rad(tolerances.gyroscope_degps)), unit)
    if sensor == Sensor.ACCELEROMETER and tolerances.accelerometer_mg is not None and unit in ("m/s^2", "m/s²"):
        yield _limit(1e-3 * STANDARD_GRAVITY_MPS2 * tolerances.accelerometer_mg, unit)
    if sensor == Sensor.MAGNETOMETER:
        yield from _magnetic_limits(unit, tolerances, flown)


def _magnetic_limits(unit: str, tolerances: Tolerances, flown: Flown) -> Iterator[Limit]:
    """In units of the local field ("norm") only what a zero does to the heading is known."""
    tesla = UNIT_IN_TESLA.get(unit)
    if tolerances.magnetometer_ut is not None and tesla is not None:
        yield _limit(tolerances.magnetometer_ut * UNIT_IN_TESLA["uT"] / tesla, unit)
    horizontal = flown.horizontal_share if unit == "norm" else None
    if tesla is not None and flown.horizontal_field_g is not None:
        horizontal = flown.horizontal_field_g * UNIT_IN_TESLA["G"] / tesla
    if tolerances.heading_deg is not None and horizontal:
        turn = tolerances.heading_deg
        yield Limit(float(np.tan(np.deg2rad(turn))) * horizontal, f"{number(turn)}° of heading")


def _limit(value: float, unit: str) -> Limit:
    return Limit(value, measure(value, None, unit))


def _loaded(flown: Flown, tolerances: Tolerances, now: datetime) -> Iterator[Due]:
    """Zeros that an autopilot has loaded and that are off by more than their limit, in its own axes."""
    for one in flown.loaded:
        limit = limit_in(one.sensor, one.unit, tolerances, flown)
        off = one.estimate - one.flies_with
        if one.parameter == "zero" and limit is not None and abs(off) > limit.value:
            sd = one.sd if np.isfinite(one.sd) else None
            told = (
                f"{one.sensor} {one.axis}: what is loaded is {measure(-off, sd, one.unit)} off what is estimated; the"
                f" limit is {limit.told}."
            )
            yield Due(one.unit_id, one.unit_id, one.sensor, one.axis, now, 0, True, told)


def _due(row: DriftRow, most: Limit, flown: Flown, now: datetime) -> Due:
    place = (row["unit_id"], row["imu_id"], row["sensor"], row["axis"])
    about, limit, allowed = f"{row['sensor']} {row['axis']}", most.value, most.told
    sd, more = row["sd"] or 0.0, max(ENOUGH_SESSIONS - (row["n_sessions"] or 0), 0)
    if sd * SURE_SD > limit:
        more = max(more, int(np.ceil((row["n_sessions"] or 1) * ((SURE_SD * sd / limit) ** 2 - 1.0))), 1)
        known = measure(sd * SURE_SD, None, row["unit"])
        told = f"{about} is known to {known} (2 sd) only; the limit is {allowed}. {_sessions(more)} would tell."
        return Due(*place, now, more, True, told)
    off, since = _off(row, flown)
    if abs(off) > limit:
        told = f"{about} is {measure(off, sd, row['unit'])} off what {since}; the limit is {allowed}."
        return Due(*place, now, 0, True, told)
    slope, slope_sd = row["slope_per_day"], row["slope_per_day_sd"]
    if slope is None or slope_sd is None or row["as_of"] is None:
        why = f"{_sessions(more)} would tell" if more else "its flights have no dates"
        return Due(*place, None, max(more, 1), False, f"When {about} passes {allowed} is not known yet: {why}.")
    days = np.arange(FARTHEST_D + 1.0)
    _, known_to = predicted(row, REFERENCE_DEGC, days)
    passing = np.flatnonzero(np.abs(off + slope * days) + SURE_SD * known_to > limit)
    if not len(passing):
        return Due(*place, None, 0, False, f"{about} stays within {allowed} for ten years.")
    at = row["as_of"] + timedelta(days=float(days[passing[0]]))
    moves = measure(MONTH_D * slope, MONTH_D * slope_sd, row["unit"])
    open_yet = ", which more sessions would narrow" if abs(slope) < SURE_SD * slope_sd else ""
    told = f"{about} moves by {moves} in 30 days{open_yet}: from then on it may be off what {since} by {allowed}."
    return Due(*place, at, 0, at <= now, told)


def _off(row: DriftRow, flown: Flown) -> tuple[float, str]:
    """(by how much it moved since what is flown was made, in the row's unit; what that is)."""
    exported = flown.exported_at.get((row["unit_id"], row["sensor"]))
    if exported is None or row["as_of"] is None or exported >= row["as_of"]:
        return 0.0, "was found last"
    stepped = row["change_size"] if row["change_at"] is not None and row["change_at"] > exported else None
    days = (row["as_of"] - exported).total_seconds() / DAY_S
    return (row["slope_per_day"] or 0.0) * days + (stepped or 0.0), f"was exported on {exported:%Y-%m-%d}"


def _sessions(more: int) -> str:
    return f"{more} more session{'' if more == 1 else 's'}"
