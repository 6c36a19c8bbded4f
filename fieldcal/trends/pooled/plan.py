"""What to fly next: which half a minute of motion would help most, by what all flights of a unit know together."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

import numpy as np
import polars as pl

from fieldcal.errors import EstimationError, FieldcalError, UnusableFlight
from fieldcal.estimation.joint import initialise
from fieldcal.estimation.joint.information import observed
from fieldcal.estimation.joint.ladder import fit_with_fallbacks
from fieldcal.estimation.joint.problem import PriorConstants, Readings
from fieldcal.estimation.normal_equations import NormalEquations
from fieldcal.estimation.pooled.chain import Estimate, Known
from fieldcal.estimation.pooled.unit import Flight, Pooled, state_of
from fieldcal.flight.threads import one_thread
from fieldcal.geometry import sensor_model
from fieldcal.geometry.rotation import Array
from fieldcal.names import SENSORS, Sensor
from fieldcal.reason_codes import ReasonCode
from fieldcal.schemas.columns import FLOWN_ORDER
from fieldcal.simulation.experiment import Experiment, simulate
from fieldcal.stages.composition import ORIGIN
from fieldcal.stages.tables import AXES
from fieldcal.trends.pooled.present import information_that_counts
from fieldcal.trends.pooled.rows import limit_of, strengths_told, words_of
from fieldcal.trends.pooled.table import near
from fieldcal.trends.pooled.units import HistoryUnit, by_unit, unit_of
from fieldcal.warehouse.questions import existing, known_vehicle

SECONDS, TURN_RAD = 30.0, np.pi / 3
TURNS = ("roll", "pitch", "turn the heading")
STILL_SHARE = 0.05
"""Of the turn, about the axes that a manoeuvre is not about."""
TRANSLATION_MPS2 = 0.2
USUAL_DIP_RAD = 1.0
NOISE = {Sensor.GYROSCOPE: 0.01, Sensor.ACCELEROMETER: 0.05, Sensor.MAGNETOMETER: 0.005}
"""White, of each sample at 185 Hz: rad/s, m/s², share of the field."""
PRIOR = {Sensor.GYROSCOPE: (0.03, 0.035), Sensor.ACCELEROMETER: (0.03, 0.3), Sensor.MAGNETOMETER: (0.1, 0.5)}
"""Sd of scales and zeros with which the synthetic flight is fitted; taken out of its information."""


@dataclass(frozen=True)
class Expected:
    """One constant now and after a manoeuvre: `sd_now`, `sd_after` and the largest, the `limit`, with which it is not
    refused, in `unit`; infinite where nothing is known."""

    constant: str
    sd_now: float
    sd_after: float
    limit: float
    unit: str


@dataclass(frozen=True)
class Manoeuvre:
    """Half a minute of motion, in `words`, and what it would do to each constant. `gain`: geometric mean of sd_now over
    sd_after, a constant that becomes known counting from its limit."""

    words: str
    expected: tuple[Expected, ...]
    gain: float

    @property
    def refused_after(self) -> int:
        """Constants still not known well enough."""
        return sum(not one.sd_after <= one.limit for one in self.expected)

    @property
    def refused_now(self) -> int:
        return sum(not one.sd_now <= one.limit for one in self.expected)


@dataclass(frozen=True)
class Plan:
    """Manoeuvres for a vehicle's unit, the one that helps most first."""

    vehicle_id: str
    unit_id: str
    manoeuvres: tuple[Manoeuvre, ...]


def plan(root: Path, vehicle_id: str) -> Plan:
    """What to fly next with a vehicle.

    Each candidate, 60° either way about one, two or three of the vehicle's axes, is flown in simulation with the
    sensors that the unit has, and fitted by the joint estimate: its information, as uncertain as a session, is added to
    what the unit's flights know already.

    Raises
    ------
    FieldcalError
        `not_found`, `no_calibration`: the history has no such vehicle, or no two flights of it with information.
    """
    warehouse = existing(root)
    known_vehicle(warehouse, vehicle_id)
    table = warehouse.scan("pooled", vehicle_id=vehicle_id).filter("is_primary").collect()
    if table.is_empty():
        raise FieldcalError(
            ReasonCode.NO_CALIBRATION,
            f"No two flights of {vehicle_id!r} have information yet: fly 60° either way about every axis.",
        )
    now = table.sort("started_at", "flight_id", nulls_last=False)["pooled_with"][-1]
    information, _ = information_that_counts(root)
    rows = information.filter(pl.col("unit_id") == now)
    one = unit_of(by_unit(rows)[0])
    with one_thread():
        found, _ = near(one, strengths_told(table.filter(pl.col("pooled_with") == now), one))
        axes = _axes(warehouse.scan("run", vehicle_id=vehicle_id))
        dip_rad = _dip(warehouse.scan("calibration", vehicle_id=vehicle_id))
        about = [turned for n in (1, 2, 3) for turned in combinations(range(3), n)]
        made = [_manoeuvre(one, found, turned, axes, dip_rad) for turned in about]
    order = sorted((m for m in made if m is not None), key=lambda m: (m.refused_after, -m.gain))
    return Plan(vehicle_id, str(now), tuple(order))


def _axes(runs: pl.LazyFrame) -> Array:
    """Which sensor axis lies along nose, starboard and underside, with its sign: a signed permutation (3, 3)."""
    own = runs.filter("is_primary", pl.col("stage") == "composition", pl.col("measured").is_not_null())
    told = own.sort(FLOWN_ORDER, nulls_last=False).select("measured").collect()["measured"].to_list()
    origins = [origin for text in told if (origin := json.loads(text).get(ORIGIN)) is not None]
    turn: Array = np.eye(3)
    if origins:
        turn = sensor_model.frd_from_sensor(origins[-1]["rotation_body_from_sensor"], origins[-1]["body"])
    out = np.zeros((3, 3))
    for i in range(3):
        j = int(np.argmax(np.abs(turn[i])))
        out[i, j] = np.sign(turn[i, j])
    return out


def _dip(calibration: pl.LazyFrame) -> float:
    """Of the field, as the vehicle's flights found it."""
    found = calibration.filter(pl.col("parameter") == "dip", pl.col("status") == "ok").select(pl.col("value").median())
    value = found.collect().item()
    return USUAL_DIP_RAD if value is None else float(value)


def _manoeuvre(
    one: HistoryUnit, found: Pooled, turned: tuple[int, ...], axes: Array, dip_rad: float
) -> Manoeuvre | None:
    """None where it does not even let the joint estimate run."""
    sensors = tuple(sensor for sensor in SENSORS if any(name[0] == sensor for name in found.names))
    try:
        flown = information_of_turns(turned, sensors, dip_rad)
    except (UnusableFlight, EstimationError):
        return None
    polarity = {
        name[::2]: float(gain) for name, gain in zip(found.names, found.at().state, strict=False) if name[1] == "gain"
    }
    flown = _in_sensor_axes(flown, axes, polarity)
    flown = flown.of([name for name in flown.names if name in found.names])
    warm = one.unit.flights[-1].warmth_degc
    own = state_of(Flight(flown, 0, warm), found.names, found.sloped, 0.0, found.drifting, bent=found.bent)
    now = found.chain.at(float(one.unit.day[-1]))
    after = now + Known(own.information, np.zeros(len(own.right))).loosened(found.scatter)
    before, later = now.estimate(), after.estimate()
    expected = tuple(
        Expected(
            words_of(name),
            _sd(found, before, place, warm) * scale,
            _sd(found, later, place, warm) * scale,
            limit * scale,
            unit,
        )
        for place, name in enumerate(found.names)
        for limit, scale, unit in (limit_of(one, name),)
        if limit is not None
    )
    ratios = [min(e.sd_now, e.limit) / min(e.sd_after, e.limit) for e in expected]
    return Manoeuvre(_words(turned), expected, float(np.exp(np.mean(np.log(ratios)))))


def _sd(found: Pooled, known: Estimate, place: int, warmth_degc: float | None) -> float:
    """Of a gain relative: over the axis' usual one it is 1, or −1."""
    return float(np.sqrt(known.of(found.combination(place, warmth_degc or 0.0))[1]))


def _words(turned: tuple[int, ...]) -> str:
    parts = [TURNS[i] for i in turned]
    text = parts[0] if len(parts) == 1 else f"{', '.join(parts[:-1])} and {parts[-1]}"
    order = "" if len(parts) == 1 else ", one after the other"
    return f"{text} by {np.degrees(TURN_RAD):.0f}° either way{order}, again and again for {SECONDS:.0f} s"


def information_of_turns(turned: tuple[int, ...], sensors: tuple[Sensor, ...], dip_rad: float) -> NormalEquations:
    """What half a minute of turns about these body axes (0 nose, 1 starboard, 2 underside) says of sensors along them.

    A synthetic flight with constants 1 and 0, white noise (`NOISE`) and some translation, fitted and linearised as any.
    Raises UnusableFlight, EstimationError."""
    share = tuple(1.0 if i in turned else STILL_SHARE for i in range(3))
    nominal = {str(sensor): (1.0, 1.0, 1.0) for sensor in SENSORS}, {str(sensor): (0.0, 0.0, 0.0) for sensor in SENSORS}
    flight = simulate(
        Experiment(
            seed=1, duration_s=SECONDS, sets=3, peak_rad=(TURN_RAD, TURN_RAD), dip_rad=dip_rad, cross_coupling=0.0,
            turned=(share[0], share[1], share[2]), translation_rms_mps2=TRANSLATION_MPS2, scale=nominal[0],
            bias=nominal[1], noise=False, quantisation=False, vps=False,
        )
    )  # fmt: skip
    rng = np.random.default_rng(1)
    logged = {s: flight.counts[s] + NOISE[s] * rng.normal(size=flight.counts[s].shape) for s in SENSORS}
    segment = np.zeros(len(flight.t), dtype=np.int64)
    gyroscope = logged[Sensor.GYROSCOPE]
    readings = Readings(
        flight.t,
        segment,
        gyroscope,
        logged[Sensor.ACCELEROMETER] if Sensor.ACCELEROMETER in sensors else None,
        logged[Sensor.MAGNETOMETER] if Sensor.MAGNETOMETER in sensors else None,
        flight.experiment.gravity_mps2,
        np.array([np.cos(dip_rad), 0.0, np.sin(dip_rad)]),
        initialise.turning(flight.t, segment, gyroscope),
    )
    priors = {
        str(s): PriorConstants(np.ones(3), np.zeros(3), np.diag(np.repeat(np.square(PRIOR[s]), 3))) for s in sensors
    }
    start = {s: (prior.scale, prior.bias) for s, prior in priors.items()}
    fit = fit_with_fallbacks(readings, start, priors).fit
    found = observed(fit, np.eye(3))
    return found.of([name for name in found.names if name[1] in ("gain", "zero")])


def _in_sensor_axes(found: NormalEquations, axes: Array, polarity: Mapping[tuple[str, str], float]) -> NormalEquations:
    """Of triads along the body's axes as of triads along the sensor's; `axes` (3, 3) a signed permutation, `polarity`
    by sensor and axis the sign of a gain. An axis that points the other way has another sign of its zero, one that
    reads the other way round of its gain too."""
    names, sign = [], []
    for sensor, parameter, axis in found.names:
        i = AXES.index(axis)
        j = int(np.argmax(np.abs(axes[i])))
        names.append((sensor, parameter, AXES[j]))
        reads = -1.0 if polarity.get((sensor, AXES[j]), 1.0) < 0.0 else 1.0
        sign.append(reads * (1.0 if parameter == "gain" else float(axes[i, j])))
    turned = np.array(sign)
    information = found.information * np.outer(turned, turned)
    return replace(found, names=tuple(names), information=information, right=found.right * turned)
