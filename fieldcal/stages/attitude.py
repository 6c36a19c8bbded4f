"""Attitude from the two vector triads, and what else is made of their calibrated vectors."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
import polars as pl

from fieldcal.estimation import wahba
from fieldcal.estimation.faults import Fault
from fieldcal.geometry import sensor_model
from fieldcal.geometry.rotation import Array, from_matrix, multiply
from fieldcal.names import FIELD_ASSUMED, VECTOR_SENSORS, Json, Sensor, Status
from fieldcal.reason_codes import ReasonCode
from fieldcal.stages.inputs import Tables, spread_of
from fieldcal.stages.results import StageResult, fault_rows
from fieldcal.stages.tables import QUATERNION, columns_of, constants, matrix, triad

if TYPE_CHECKING:
    from fieldcal.config.stage_settings import (
        AttitudeSettings,
        Axes,
        BodyVectors,
        FieldOrigin,
        LoggedValues,
        VectorConstants,
    )

# The weight of an attitude halves where a measured length is off by this share of gravity, or of the local field.
TRUST_ACCELERATION, TRUST_FIELD = 0.01, 0.01


# The angle between field and gravity is one number: if a tenth of the samples that motion and magnets disturb least
# is further off than this, an axis or sign is wrong. Not the median: at rest every polarity gives one angle. Right
# ones show 0.3° simulated and up to 2.5° in real recordings, wrong ones 5° (no dip, one axis) to 50°.
MAX_DIP_SCATTER_DEG = 4.0
# TASTE is χ²₁ where the noise explains the angle between field and gravity: median 0.45, and 0.3 to 1.3 in simulated
# and real recordings; soft iron of 8 % or axes 1° out of square make it 9 and more.
MAX_MEDIAN_TASTE = 9.0
# From this dip on a mirrored one, within so much of it, tells gravity's sign.
LEAST_DIP_DEG, SAME_DIP_DEG = 20.0, 15.0


TRUSTED_SHARE = 0.2


def logged_constants(s: LoggedValues, name: Sensor) -> tuple[Array, Array] | None:
    """Scale from the logged unit alone, with the configured polarity, and bias 0; None for counts."""
    nominal = s.nominal_scale[name]
    if nominal is None:
        return None
    return np.diag(np.array(nominal) * np.array(s.polarity[name], dtype=np.float64)), np.zeros(3)


def vector_constants(tables: Tables, s: VectorConstants, name: Sensor) -> tuple[tuple[Array, Array] | None, bool]:
    """Constants that calibrate a vector triad, and whether they are its fit's.

    Without a fit they are the logged unit's; a magnetometer in a physical unit where the local field is only "norm" is
    scaled to the median length, since attitude needs directions only. None: counts without a fit."""
    fitted_constants = constants(tables[name], name) if name in tables else None
    if fitted_constants is not None:
        return fitted_constants, True
    if s.nominal_scale[name] is None and s.units[name] != "counts":
        length = float(np.nanmedian(np.linalg.norm(matrix(tables["samples"], triad(name, "smoothed_")), axis=1)))
        scale = float(np.linalg.norm(s.field_ned)) / length * np.array(s.polarity[name], dtype=np.float64)
        return (np.diag(scale), np.zeros(3)), False
    return logged_constants(s, name), False


def known_vectors(tables: Tables, s: VectorConstants) -> dict[Sensor, tuple[Array, Array]]:
    """Constants of both vector triads, as the attitude stage used them; call only where it gave an attitude."""
    found = {name: vector_constants(tables, s, name)[0] for name in VECTOR_SENSORS}
    return {name: vector for name, vector in found.items() if vector is not None}


def body_vectors(
    samples: pl.DataFrame, used: Mapping[Sensor, tuple[Array, Array]], s: BodyVectors, *, prefix: str
) -> Array:
    """Calibrated magnetic field and gravity-signed acceleration in body axes, (n, 2, 3)."""
    axes = sensor_model.frd_from_sensor(s.rotation_body_from_sensor, s.body)
    field = sensor_model.calibrate(matrix(samples, triad("magnetometer", prefix)), *used[Sensor.MAGNETOMETER]) @ axes.T
    gravity = (
        sensor_model.calibrate(matrix(samples, triad("accelerometer", prefix)), *used[Sensor.ACCELEROMETER]) @ axes.T
    )
    return np.stack([field, sensor_model.GRAVITY_SIGNS[s.gravity_sign] * gravity], axis=1)


def local_field(vectors: Array, s: FieldOrigin) -> Array:
    """The local field (3,), NED. Where nobody said where that is, its dip is the one that calibrated vectors
    (n, 2, 3), field and gravity in body axes, have to each other."""
    if s.field_source != FIELD_ASSUMED:
        return np.asarray(s.field_ned, dtype=float)
    dip = np.radians(np.nanmedian(_dip_deg(vectors)))
    return float(np.linalg.norm(s.field_ned)) * np.array([np.cos(dip), 0.0, np.sin(dip)])


def reference_vectors(vectors: Array, s: FieldOrigin) -> tuple[Array, float]:
    """What calibrated vectors (n, 2, 3) are compared with: field and vertical (2, 3), NED, and the declination, rad."""
    field = local_field(vectors, s)
    return np.array([field, [0.0, 0.0, 1.0]]), float(np.arctan2(field[1], field[0]))


def estimate_attitude(tables: Tables, s: AttitudeSettings) -> StageResult:
    """samples and both triads' constants → attitude (Eq. 9), weighted by the errors of the measured lengths.

    Where the ellipsoid fit of a log in SI units was refused the logged values are used, with a reason code; counts
    without a fit end in a refusal."""
    used: dict[Sensor, tuple[Array, Array]] = {}
    fallback = []
    for name in VECTOR_SENSORS:
        if tables["samples"][f"{name}_x"].null_count() == len(tables["samples"]):
            return StageResult(
                status=Status.REFUSED, reason_code=ReasonCode(f"no_{name}"), reason=f"Attitude needs a {name}."
            )
        triad_constants, fitted = vector_constants(tables, s, name)
        if not fitted:
            fallback.append(name)
        if triad_constants is None:
            return StageResult(
                status=Status.REFUSED,
                reason_code=ReasonCode(f"{name}_refused"),
                reason=f"Attitude needs a calibrated {name}; its fit was refused, and counts give no direction.",
            )
        used[name] = triad_constants
    vectors = body_vectors(tables["samples"], used, s, prefix="smoothed_")
    strength, gravity = float(np.linalg.norm(s.field_ned)), s.gravity_mps2
    field_excess = np.linalg.norm(vectors[:, 0], axis=1) / strength - 1.0
    acceleration_excess = np.linalg.norm(vectors[:, 1], axis=1) / gravity - 1.0
    sigma = np.array([spread_of(field_excess), spread_of(acceleration_excess)])
    reference, declination = reference_vectors(vectors, s)
    fit = wahba.attitudes(vectors, reference, sigma, method=s.attitude, declination=declination)
    weight = 1.0 / (1.0 + (acceleration_excess / TRUST_ACCELERATION) ** 2 + (field_excess / TRUST_FIELD) ** 2)
    dip = _dip_deg(vectors)[weight >= np.quantile(weight, 1.0 - TRUSTED_SHARE)]
    scatter = float(np.percentile(np.abs(dip - np.median(dip)), 90))
    expected_dip = float(np.degrees(np.arcsin(np.clip(reference[0, 2] / strength, -1, 1))))
    dip_deg = float(np.median(dip))
    measured: dict[str, Json] = {
        "logged_values_used": fallback,
        "direction_sd_rad": {"magnetometer": float(sigma[0]), "accelerometer": float(sigma[1])},
        "dip_deg": dip_deg,
        "dip_expected_deg": expected_dip,
        "dip_scatter_deg": scatter,
        "field": s.field_source,
        "taste_median": float(np.median(fit.taste)),
    }
    if scatter > MAX_DIP_SCATTER_DEG:
        return _contradiction(
            ReasonCode.VECTORS_CONTRADICT,
            scatter,
            MAX_DIP_SCATTER_DEG,
            f"The angle between magnetic field and gravity scatters by {scatter:.1f}° where it should be one"
            " number: a wrong polarity, swapped axes, or a magnet on board.",
            measured,
        )
    upside_down = abs(expected_dip) > LEAST_DIP_DEG and abs(dip_deg + expected_dip) < SAME_DIP_DEG
    taste = float(np.median(fit.taste))
    if taste > MAX_MEDIAN_TASTE and not upside_down:
        return _contradiction(
            ReasonCode.VECTORS_CONTRADICT,
            taste,
            MAX_MEDIAN_TASTE,
            f"The angle between magnetic field and gravity ({dip_deg:.1f}° of dip, {expected_dip:.1f}° expected) is off"
            f" by {np.sqrt(taste):.0f} times what the readings' noise allows: soft iron, axes that are not square, a"
            " magnet on board, or another place than the configured one. Method joint can do with it.",
            measured,
        )
    if upside_down:
        return _contradiction(
            ReasonCode.GRAVITY_SIGN_CONTRADICTION,
            dip_deg,
            expected_dip,
            f"The measured field dips by {dip_deg:.0f}° where {expected_dip:.0f}° is configured:"
            f' gravity_sign "{s.gravity_sign}" (or the polarity of a whole triad) is the wrong way round.',
            measured,
        )
    table = pl.DataFrame(
        {
            "t_ns": tables["samples"]["t_ns"],
            "segment": tables["samples"]["segment"],
            **columns_of(fit.q, QUATERNION),
            "attitude_sd_rad": fit.sd,
            "taste": fit.taste,
            "acceleration_excess_mps2": acceleration_excess * gravity,
            "field_excess": field_excess,
            "weight": weight,
        }
    )
    code = ReasonCode.LOGGED_VALUES_USED if fallback else None
    reason = f"Logged values stand in for the refused {' and '.join(fallback)}." if fallback else None
    return StageResult({"attitude": table}, Status.OK, code, reason, measured)


def _contradiction(
    code: ReasonCode, number: float, limit: float, reason: str, measured: dict[str, Json]
) -> StageResult:
    """A refusal with a fatal fault of both vector triads: which of them is wrong cannot be told."""
    rows = [Fault(name, "", code, number, limit, True, reason) for name in VECTOR_SENSORS]
    return StageResult({"faults": fault_rows(rows)}, Status.REFUSED, code, reason, measured)


def _dip_deg(vectors: Array) -> Array:
    """Dip: angle of the measured field below the plane normal to measured gravity, degrees, (n,)."""
    unit = vectors / np.linalg.norm(vectors, axis=2, keepdims=True)
    return np.asarray(np.degrees(np.arcsin(np.clip(np.einsum("ni,ni->n", unit[:, 0], unit[:, 1]), -1.0, 1.0))))


def sensor_attitude(q: Array, s: Axes) -> Array:
    """Attitude of the sensor axes (n, 4) from that of the body: gyroscope constants are in sensor axes."""
    axes = sensor_model.frd_from_sensor(s.rotation_body_from_sensor, s.body)
    return multiply(q, from_matrix(axes.T))
