"""What the joint estimate starts from: the readings of a flight, and constants to begin with."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from fieldcal.estimation.joint import initialise
from fieldcal.estimation.joint.problem import Readings
from fieldcal.geometry import sensor_model
from fieldcal.geometry.intervals import interval_of
from fieldcal.geometry.rotation import Array
from fieldcal.names import FIELD_ASSUMED, SENSORS, VECTOR_SENSORS, Method, Sensor
from fieldcal.stages.attitude import body_vectors, local_field, logged_constants, vector_constants
from fieldcal.stages.inputs import Tables, is_sound
from fieldcal.stages.tables import constants, matrix, seconds, triad

if TYPE_CHECKING:
    from fieldcal.config.stage_settings import JointSettings

SERIAL_METHODS: dict[Sensor, tuple[Method | None, ...]] = {
    Sensor.MAGNETOMETER: (None,),
    Sensor.ACCELEROMETER: (None,),
    Sensor.GYROSCOPE: (Method.OUTPUT_ERROR, Method.EQUATION_ERROR),
}
# A magnetometer's readings count as one each only where they are about as many as the gyroscope's.
SPARSE = 0.9
# Share of rows that bring a new value of a triad; with fewer its values are held.
LEAST_FRESH = 0.5


def readings_of(tables: Tables, s: JointSettings) -> Readings:
    """Logged readings of the used segments; a slow magnetometer's only at the samples nearest to its
    own stamps; none of a triad with a fatal fault."""
    samples = tables["samples"]
    t = seconds(samples["t_ns"], samples["t_ns"][0])
    segment = samples["segment"].to_numpy()
    logged: dict[str, Array] = {name: matrix(samples, triad(name)) for name in SENSORS}
    magnetometer = tables.get("magnetometer_log")
    if magnetometer is not None and len(magnetometer) < SPARSE * len(tables["imu"]):
        has_reading = np.zeros(len(t), dtype=bool)
        at = seconds(magnetometer["t_ns"], samples["t_ns"][0])
        before = interval_of(t, at, on_stamp="ends")
        nearest = np.where(at - t[before] < t[before + 1] - at, before, before + 1)
        has_reading[nearest[np.abs(t[nearest] - at) < 2.0 * float(np.median(np.diff(t)))]] = True
        logged["magnetometer"] = np.where(has_reading[:, None], logged["magnetometer"], np.nan)
    vectors = {name: each_once(x) for name, x in logged.items() if name != "gyroscope"}
    given = {name: x if is_sound(tables, name) and np.isfinite(x).any() else None for name, x in vectors.items()}
    return Readings(
        warmth=_warmth(tables, t),
        t=t,
        segment=segment,
        gyroscope=logged["gyroscope"],
        force=_force(tables, s, given["accelerometer"]),
        gravity_mps2=sensor_model.GRAVITY_SIGNS[s.gravity_sign] * s.gravity_mps2,
        field_ned=_field(tables, s, given),
        turning=initialise.turning(t, segment, logged["gyroscope"]),
        **given,
    )


def _field(tables: Tables, s: JointSettings, given: Mapping[str, Array | None]) -> Array:
    """The local field (3,), NED; of an unknown place with the dip that both triads show, where they can be
    calibrated."""
    if s.field_source != FIELD_ASSUMED:
        return np.asarray(s.field_ned, dtype=float)
    used = {name: vector_constants(tables, s, name)[0] for name in VECTOR_SENSORS if given[name] is not None}
    known = {name: found for name, found in used.items() if found is not None}
    if len(known) < len(VECTOR_SENSORS):
        return np.asarray(s.field_ned, dtype=float)
    return local_field(body_vectors(tables["samples"], known, s, prefix="smoothed_"), s)


def each_once(x: Array) -> Array:
    """Readings (n, 3) of a sensor whose values are held over most rows (it is slower than the log), each only where it
    came; as they are where most rows bring a new one."""
    fresh = np.r_[True, np.any(np.diff(x, axis=0) != 0.0, axis=1)]
    known = np.isfinite(x).all(axis=1)
    if not known.any() or fresh[known].mean() > LEAST_FRESH:
        return x
    return np.where(fresh[:, None], x, np.nan)


def _warmth(tables: Tables, t: Array) -> Array | None:
    """Temperature at the samples less its mean, °C (n,); None without one."""
    table = tables.get("temperature")
    if table is None or (table := table.drop_nulls()).is_empty():
        return None
    at = seconds(table["t_ns"], tables["samples"]["t_ns"][0])
    warm = np.interp(t, at, table["temperature_degc"].to_numpy())
    return np.asarray(warm - warm.mean())


def _force(tables: Tables, s: JointSettings, logged: Array | None) -> Array | None:
    """Specific force at the samples less its mean, m/s² (n, 3), sensor axes, by the serial chain's accelerometer or the
    logged unit; None where there is neither, or not at every sample."""
    name = Sensor.ACCELEROMETER
    if logged is None or not np.isfinite(logged).all():
        return None
    found = constants(tables[name], name, None) if name in tables else None
    found = found or logged_constants(s, name)
    if found is None:
        return None
    force = sensor_model.calibrate(logged, *found)
    return np.asarray(force - force.mean(axis=0))


def start_constants(tables: Tables, s: JointSettings, readings: Readings) -> dict[str, tuple[Array, Array] | None]:
    """The serial chain's constants where it has them, else what the logged unit says, else refused values, else an
    ellipsoid fit."""
    out: dict[str, tuple[Array, Array] | None] = {}
    magnitudes = {
        Sensor.MAGNETOMETER: float(np.linalg.norm(s.field_ned)),
        Sensor.ACCELEROMETER: s.gravity_mps2,
    }
    for name in SENSORS:
        found = None
        for method in SERIAL_METHODS[name]:
            if found is None and name in tables:
                found = constants(tables[name], name, method)
        found = found or logged_constants(s, name)
        out[name] = None if found is None else (np.diagonal(found[0]).copy(), found[1])
        logged = getattr(readings, name)
        if out[name] is None and name in magnitudes and logged is not None:
            polarity = np.array(s.polarity[name], dtype=np.float64)
            out[name] = initialise.start_of_triad(logged, magnitudes[name], polarity)
    return out
