"""A pooled unit as rows of the table `pooled`: scale and zero instead of gain and zero, judged, in words."""

from __future__ import annotations

from datetime import datetime, timedelta
from operator import itemgetter

import numpy as np
import polars as pl

from fieldcal.config.parameters import Parameters
from fieldcal.estimation.normal_equations import Name
from fieldcal.estimation.pooled.chain import Estimate
from fieldcal.estimation.pooled.strengths import Strengths
from fieldcal.estimation.pooled.unit import Kinds, Pooled
from fieldcal.geometry.earth_field import UNIT_IN_TESLA
from fieldcal.geometry.rotation import Array
from fieldcal.names import DriftStatus, Sensor, Status
from fieldcal.reason_codes import ReasonCode
from fieldcal.schemas.columns import LEAD
from fieldcal.schemas.reference import REFERENCE_DEGC
from fieldcal.trends.pooled.units import DAY, EPOCH, HistoryUnit

INFORMED_SHARE = 0.5
"""Of what is known of a zero before any flight: one that is not known better is refused, as a flight's is."""
TELLS = 1e-3
"""Share of what is known of a constant from which on a flight is one of those that tell it: others do so by what they
know of other constants."""
SOUGHT = 9
"""Temperatures among those flown at which it is asked how well a bent zero is known."""
FIELD_T = 5e-5
"""The earth's field, about."""
TURN = "Turn it 60° either way about the sensor's {axis} axis, several times."
TILT = "Turn it over, so that the sensor's {axis} axis points up, down and level."
Row = dict[str, object]
NO_CURVE: Row = dict.fromkeys(("curve_per_degc2", "curve_per_degc2_sd", "curve_with_value", "curve_with_slope"))


def rows_of_unit(one: HistoryUnit, found: Pooled, distance: Array, kinds: Kinds, day: float | None = None) -> list[Row]:
    """Rows of each constant, at the last session unless a `day` since EPOCH is given; of a unit whose flights say
    nothing none. `distance` (n,): of each flight's reference point from the pooled one, over that up to which its
    equations hold."""
    if not any(own.information.any() for own in found.raw):
        return []
    now = found.at(day)
    out = {left.flight for left in found.left_out}
    sessions = {flight.session for k, flight in enumerate(found.unit.flights) if k not in out}
    unconfirmed = bool(out) and len(found.unit.day) - 1 not in sessions
    left_out = [one.flight_ids[k] for k in sorted(out)]
    shares, rates, last_z = found.contributions(), found.rates(), found.last_z()
    factor, value, covariance = _in_history(one, found, now)
    degc = _best_degc(found, now, one.temperatures_degc)
    rows: list[Row] = []
    for place, name in enumerate(found.names):
        strength = kinds[name[:2]]
        size = abs(factor[place])
        refusal = _refusal(found, now, place, name, degc[place], one)
        status, code, reason = Status.OK.value, None, _sentence(found, now, place, shares[:, place], left_out)
        if reason and (far := int(np.sum(distance > 1.0))):
            reason += (
                f" {far} left out: made at scales up to {distance.max():.1f} times as far from these as they hold. "
                "Calibrate their logs again."
            )
        step = next((s for s in reversed(found.steps) if s.name == name), None)
        if refusal:
            status, code, reason = Status.REFUSED.value, ReasonCode.SCALE_UNCERTAIN.value, refusal
        elif unconfirmed:
            status = DriftStatus.INSUFFICIENT.value
            reason = (
                "The last session contradicts those before it and was left out: spoiled, or the first after a step. "
                "Another session tells."
            )
        elif step is not None:
            status = DriftStatus.STEP.value
        elif place in found.drifting:
            status = DriftStatus.DRIFTING.value
        rate = rates[place] if one.last["started_at"] is not None else None
        slope = found.sloped.index(place) + len(found.names) if place in found.sloped else None
        known = bool(np.isfinite(now.covariance[place, place]))
        bend, curve = found.bend_at(place), NO_CURVE
        if slope is not None and bend is not None and known:
            curve = _curve(now, factor[place], place, slope, bend)
        sloped = slope is not None and bool(np.isfinite(now.covariance[slope, slope]))
        own = {
            **{column.name: one.last[column.name] for column in LEAD},
            "unit_id": one.sensor_unit_ids[name[0]],
            "is_primary": one.last["is_primary"],
            "sensor": name[0],
            "parameter": _parameter(name),
            "axis": name[2],
            "unit": _unit(one, name),
            "value_at_25degc": float(value[place]) if known else None,
            "sd": float(np.sqrt(covariance[place, place])) if known else None,
            "slope_per_degc": float(factor[place] * now.state[slope]) if sloped and known else None,
            "slope_per_degc_sd": float(size * np.sqrt(now.covariance[slope, slope])) if sloped and known else None,
            "slope_per_day": float(factor[place] * rate.value) if rate is not None and known else None,
            "slope_per_day_sd": float(size * rate.sd) if rate is not None and known else None,
            "last_z": float(np.sign(factor[place]) * last_z[place]) if np.isfinite(last_z[place]) else None,
            "best_known_degc": degc[place] if known else None,
            "temperature_min_degc": None if one.temperatures_degc is None else one.temperatures_degc[0],
            "temperature_max_degc": None if one.temperatures_degc is None else one.temperatures_degc[1],
            "session_sd": size * float(np.sqrt(strength.scatter)) if known else None,
            "walk_per_sqrt_day": size * float(np.sqrt(strength.walk)) if known else None,
            "slope_spread": size * float(np.sqrt(strength.slope)) if sloped and known else None,
            "n_innovations": float(strength.freedom),
            "n_flights": int(np.sum(shares[:, place] > TELLS)),
            "n_sessions": len({f.session for k, f in enumerate(found.unit.flights) if shares[k, place] > TELLS}),
            "change_at": None if step is None else _moment(found.unit.day[step.after], one),
            "change_size": None if step is None else float(factor[place] * step.size),
            "change_size_sd": None if step is None else float(size * step.sd),
            "pooled_with": one.pooled_with,
            "place": place,
            "covariance": [float(v) for v in np.nan_to_num(covariance[place, : place + 1])] if known else None,
            "flights": list(one.flight_ids),
            "shares": [float(v) for v in shares[:, place]],
            "left_out": left_out,
            "distances": [float(v) for v in distance],
            "status": status,
            "reason_code": code,
            "reason": reason,
            **curve,
        }
        rows.append(own)
    return rows


def _curve(now: Estimate, factor: float, place: int, slope: int, bend: int) -> Row:
    """A constant's bend as the history has it, by where the state has its value, slope and bend."""
    with_value, with_slope, own = factor**2 * now.covariance[bend, [place, slope, bend]]
    return {
        "curve_per_degc2": float(factor * now.state[bend]),
        "curve_per_degc2_sd": float(np.sqrt(own)),
        "curve_with_value": float(with_value),
        "curve_with_slope": float(with_slope),
    }


def strengths_told(table: pl.DataFrame, one: HistoryUnit) -> Kinds:
    """The strengths that a unit's rows of the table were made with."""
    kinds: dict[tuple[str, str], Strengths] = {}
    for row in table.iter_rows(named=True):
        parameter = "gain" if row["parameter"] == "scale" else row["parameter"]
        if row["session_sd"] is None or (row["sensor"], parameter) in kinds:
            continue
        size = one.per[row["sensor"], parameter, row["axis"]] * (
            row["value_at_25degc"] ** 2 if parameter == "gain" else 1.0
        )
        walk, scatter, slope = (
            ((row[c] or 0.0) / size) ** 2 for c in ("walk_per_sqrt_day", "session_sd", "slope_spread")
        )
        kinds[row["sensor"], parameter] = Strengths(walk, scatter, slope, row["n_innovations"])
    return {name[:2]: kinds.get(name[:2], Strengths(0.0, 0.0, 0.0)) for name in one.unit.names}


def _parameter(name: Name) -> str:
    return "scale" if name[1] == "gain" else name[1]


def _unit(one: HistoryUnit, name: Name) -> str:
    """As in `calibration`: a scale's is the calibrated unit over the logged one."""
    unit = one.units[name]
    if name[1] != "gain" or unit == "1":
        return unit
    logged = one.units.get((name[0], "zero", name[2]), "")
    calibrated = unit.removeprefix(logged).removeprefix("/").strip("()")
    return f"{calibrated}/({logged})" if "/" in logged else f"{calibrated}/{logged}"


def _in_history(one: HistoryUnit, found: Pooled, now: Estimate) -> tuple[Array, Array, Array]:
    """(derivative by the pooled constant (p,), value (p,), covariance (p, p)) of what the history calls it."""
    p = len(found.names)
    factor, value = np.zeros(p), np.zeros(p)
    for place, name in enumerate(found.names):
        own = now.state[place] * one.per[name]
        value[place], factor[place] = own, one.per[name]
        if name[1] == "gain" and own != 0.0:
            value[place], factor[place] = 1.0 / own, -one.per[name] / own**2
    with np.errstate(invalid="ignore"):
        covariance = now.covariance[:p, :p] * np.outer(factor, factor)
    return factor, value, covariance


def _best_degc(found: Pooled, now: Estimate, flown: tuple[float, float] | None) -> list[float]:
    """Temperature at which each constant's value and slope are independent: a straight one is known best there."""
    out = []
    for place in range(len(found.names)):
        degc = REFERENCE_DEGC
        if place in found.sloped and flown is not None:
            slope = found.sloped.index(place) + len(found.names)
            variance = now.covariance[slope, slope]
            if np.isfinite(variance) and variance > 0.0:
                degc -= float(now.covariance[place, slope] / variance)
        out.append(degc)
    return out


def _refusal(found: Pooled, now: Estimate, place: int, name: Name, best: float, one: HistoryUnit) -> str | None:
    """Why a constant is not known well enough, with the motion that would show it; None where it is.

    Judged at the temperature, of those flown, at which it is known best."""
    limit, scale, unit = limit_of(one, name)
    if limit is None:
        return None if np.isfinite(now.covariance[place, place]) else f"No flight shows {words_of(name)}."
    flown = [best] if one.temperatures_degc is None else [float(np.clip(best, *one.temperatures_degc))]
    if one.temperatures_degc is not None and place in found.bent:
        flown = [*flown, *np.linspace(*one.temperatures_degc, SOUGHT)]
    value, variance = min((now.of(found.combination(place, at - REFERENCE_DEGC)) for at in flown), key=itemgetter(1))
    sd = np.sqrt(variance) / (abs(value) if name[1] == "gain" else 1.0)
    if sd <= limit:
        return None
    motion = (TURN if name[0] == Sensor.GYROSCOPE and name[1] == "gain" else TILT).format(axis=name[2])
    told = (
        f"{len(found.raw)} flights together do not show {words_of(name)} at all."
        if not np.isfinite(sd)
        else f"The sd of {words_of(name)} is {sd * scale:.2g} {unit}; the limit is {limit * scale:.2g} {unit}."
    )
    return f"{told} {motion}"


def limit_of(one: HistoryUnit, name: Name) -> tuple[float | None, float, str]:
    """(largest sd, of a gain relative, of a zero in its calibrated unit; that in the shown unit; the shown unit)."""
    p = Parameters()
    if name[1] == "gain":
        return (p.gyro_max_scale_sd if name[0] == Sensor.GYROSCOPE else p.ellipsoid_max_scale_sd), 100.0, "%"
    if name[1] != "zero":
        return None, 1.0, ""
    if name[0] == Sensor.GYROSCOPE:
        return INFORMED_SHARE * float(np.radians(p.prior_gyroscope_zero_dps)), float(np.degrees(1.0)), "deg/s"
    if name[0] == Sensor.ACCELEROMETER:
        return INFORMED_SHARE * p.prior_accelerometer_zero_mps2, 1.0, "m/s^2"
    calibrated = _unit(one, (name[0], "gain", name[2])).split("/")[0] if (name[0], "gain", name[2]) in one.units else ""
    calibrated = one.units[name] if calibrated == "1" else calibrated
    field = FIELD_T / UNIT_IN_TESLA[calibrated] if calibrated in UNIT_IN_TESLA else 1.0
    return INFORMED_SHARE * p.prior_magnetometer_zero * field, 1.0, calibrated


def words_of(name: Name) -> str:
    """A constant in words."""
    parameter = "scale" if name[1] == "gain" else name[1].replace("_", " ")
    return f"the {name[0]}'s {name[2]} {parameter}".replace("  ", " ")


def _sentence(found: Pooled, now: Estimate, place: int, shares: Array, left_out: list[str]) -> str:
    """What the value is from."""
    flights = int(np.sum(shares > TELLS))
    sessions = len({flight.session for k, flight in enumerate(found.unit.flights) if shares[k] > TELLS})
    text = f"What {flights} flights in {sessions} sessions know together."
    if left_out:
        text += f" {len(left_out)} that contradict the others are left out."
    for step in found.steps:
        if step.name == found.names[place]:
            text += f" It stepped by {abs(step.z):.0f} sd; earlier flights tell no more of it."
    if place in found.drifting and (rate := found.rates()[place]) is not None:
        text += f" It drifts steadily, {abs(rate.z):.0f} sd from not at all."
    if (bend := found.bend_at(place)) is not None:
        value, variance = now.state[bend], now.covariance[bend, bend]
        text += f" It bends with temperature, {abs(value) / np.sqrt(variance):.0f} sd from not at all."
    return text


def _moment(day: float, one: HistoryUnit) -> datetime | None:
    if one.last["started_at"] is None:
        return None
    return EPOCH + timedelta(microseconds=round(float(day) * (DAY / timedelta(microseconds=1))))
