"""Are the sensors sane: the readings of every triad against the numbers of `sensor_sanity`."""

from __future__ import annotations

import numpy as np

from fieldcal import sensor_sanity
from fieldcal.frames import matrix, seconds, triad
from fieldcal.reference_field import UNIT_IN_TESLA
from fieldcal.results import StageResult, fault_rows
from fieldcal.rotation import Array
from fieldcal.sensor_sanity import Fault
from fieldcal.stages.inputs import Settings, Tables

SENSORS = {"gyroscope": "imu", "accelerometer": "imu", "magnetometer": "magnetometer"}


def check_sensors(tables: Tables, s: Settings) -> StageResult:
    """imu, magnetometer → faults: what is wrong with a channel or triad, with the number that says so."""
    faults: list[Fault] = []
    for sensor, table in SENSORS.items():
        if table not in tables:
            continue
        readings = matrix(tables[table], triad(sensor))
        known = np.isfinite(readings).all(axis=1)
        if known.sum() < sensor_sanity.TEN_SAMPLES:
            continue
        stamps = tables[table]["t_ns"]
        faults += _faults_of(sensor, seconds(stamps, stamps[0])[known], readings[known], s)
    worst = next((f for f in sorted(faults, key=lambda f: not f.fatal)), None)
    return StageResult(
        {"faults": fault_rows(faults)},
        reason_code=worst.code if worst else None,
        reason=" ".join(f.sentence for f in faults) or None,
        measured={"faults": [f.plain() for f in faults]},
    )


def _faults_of(sensor: str, t: Array, readings: Array, s: Settings) -> list[Fault]:
    unit, nominal = s["units"][sensor], s["nominal_scale"][sensor]
    si_scale = None if unit == "counts" or nominal is None or sensor == "magnetometer" else float(nominal[0])
    faults = sensor_sanity.channel_faults(sensor, t, readings, unit, si_scale)
    wrong: Fault | None = None
    if sensor == "magnetometer" and unit in UNIT_IN_TESLA:
        length = float(np.linalg.norm(s["field_ned"]))
        field = length * UNIT_IN_TESLA[s["field_unit"]] if s["field_unit"] in UNIT_IN_TESLA else None
        wrong = sensor_sanity.magnetometer_unit(readings, unit, UNIT_IN_TESLA[unit], field)
    elif sensor == "accelerometer" and si_scale is not None:
        wrong = sensor_sanity.accelerometer_unit(readings, unit, si_scale, s["gravity_mps2"])
    elif sensor == "gyroscope" and si_scale is not None:
        wrong = sensor_sanity.gyroscope_unit(readings, unit, si_scale)
    dead = any(f.code in ("all_zero", "stuck") and f.fatal for f in faults)
    return [*faults, *([wrong] if wrong and not dead else []), *sensor_sanity.sampling_faults(sensor, t)]
