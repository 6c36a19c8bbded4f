"""Plausibility of every triad's readings, by the limits of `estimation.faults`."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from fieldcal.estimation import faults
from fieldcal.estimation.faults import Fault
from fieldcal.estimation.gravity_seen import gravity_removed
from fieldcal.geometry.earth_field import UNIT_IN_TESLA
from fieldcal.geometry.rotation import Array
from fieldcal.names import Sensor
from fieldcal.reason_codes import ReasonCode
from fieldcal.stages.inputs import Tables
from fieldcal.stages.results import StageResult, fault_rows
from fieldcal.stages.tables import matrix, seconds, triad

if TYPE_CHECKING:
    from fieldcal.config.stage_settings import SanitySettings

TABLE_OF = {Sensor.GYROSCOPE: "imu", Sensor.ACCELEROMETER: "imu", Sensor.MAGNETOMETER: "magnetometer"}
"""In the order in which faults are reported."""


def check_sensors(tables: Tables, s: SanitySettings) -> StageResult:
    """imu, magnetometer → faults: what is wrong with a channel or triad, with the number that says so."""
    found: list[Fault] = []
    for sensor, table in TABLE_OF.items():
        if table not in tables:
            continue
        readings = matrix(tables[table], triad(sensor))
        valid = np.isfinite(readings).all(axis=1)
        if valid.sum() < faults.FEWEST_SAMPLES:
            continue
        stamps = tables[table]["t_ns"]
        triad_faults = _faults_of(sensor, seconds(stamps, stamps[0])[valid], readings[valid], s)
        if sensor == Sensor.ACCELEROMETER and (removed := _gravity_removed(tables, s)):
            triad_faults = [removed, *(f for f in triad_faults if f.code != ReasonCode.WRONG_UNIT)]
        found += triad_faults
    worst = next((f for f in sorted(found, key=lambda f: not f.fatal)), None)
    return StageResult(
        {"faults": fault_rows(found)},
        reason_code=worst.code if worst else None,
        reason=" ".join(f.sentence for f in found) or None,
        measured={"faults": [f.plain() for f in found]},
    )


def _faults_of(sensor: Sensor, t: Array, readings: Array, s: SanitySettings) -> list[Fault]:
    unit, nominal = s.units[sensor], s.nominal_scale[sensor]
    si_scale = None if unit == "counts" or nominal is None or sensor == Sensor.MAGNETOMETER else float(nominal[0])
    found = faults.channel_faults(sensor, t, readings, unit, si_scale)
    wrong: Fault | None = None
    if sensor == Sensor.MAGNETOMETER and unit in UNIT_IN_TESLA:
        length = float(np.linalg.norm(s.field_ned))
        field = length * UNIT_IN_TESLA[s.field_unit] if s.field_unit in UNIT_IN_TESLA else None
        wrong = faults.magnetometer_unit(readings, unit, UNIT_IN_TESLA[unit], field)
    elif sensor == Sensor.ACCELEROMETER and si_scale is not None:
        wrong = faults.accelerometer_unit(readings, unit, si_scale, s.gravity_mps2)
    elif sensor == Sensor.GYROSCOPE and si_scale is not None:
        wrong = faults.gyroscope_unit(readings, unit, si_scale)
    dead = any(f.code in (ReasonCode.ALL_ZERO, ReasonCode.STUCK) and f.fatal for f in found)
    coarse = [] if dead else faults.coarse_faults(sensor, readings, unit)
    return [*found, *coarse, *([wrong] if wrong and not dead else []), *faults.sampling_faults(sensor, t)]


def _gravity_removed(tables: Tables, s: SanitySettings) -> Fault | None:
    """Whether gravity was taken off the accelerometer's readings, where the units of it and the gyroscope are known."""
    factors = []
    for sensor in (Sensor.GYROSCOPE, Sensor.ACCELEROMETER):
        nominal = s.nominal_scale[sensor]
        if s.units[sensor] == "counts" or nominal is None:
            return None
        factors.append(float(nominal[0]))
    imu = tables["imu"]
    rate, force = (matrix(imu, triad(sensor)) for sensor in (Sensor.GYROSCOPE, Sensor.ACCELEROMETER))
    valid = np.isfinite(rate).all(axis=1) & np.isfinite(force).all(axis=1)
    if valid.sum() < faults.FEWEST_SAMPLES:
        return None
    t = seconds(imu["t_ns"], imu["t_ns"][0])[valid]
    return gravity_removed(t, rate[valid] * factors[0], force[valid] * factors[1], s.gravity_mps2)
