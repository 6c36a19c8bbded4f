"""The estimate with a VPS (`use_vps`): gyroscope, clock and mounting by its attitude, then every vector triad by the
trajectory that this gives. What the vectors could add to the attitude is less than what their errors would spoil."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from fieldcal.errors import EstimationError, FieldcalError, UnusableFlight
from fieldcal.estimation.by_pose.accelerometer import fit_accelerometer
from fieldcal.estimation.by_pose.constant_vector import fit_constant_vector
from fieldcal.estimation.by_pose.gyroscope import fit_gyroscope, start_by_rates
from fieldcal.estimation.by_pose.level import mean_in_world, ned_from_world
from fieldcal.estimation.by_pose.triad import TriadByPose, body_axes
from fieldcal.estimation.joint.fit import JointFit
from fieldcal.estimation.joint.model_selection import SCORE_CHI2
from fieldcal.estimation.joint.problem import CROSS, Readings
from fieldcal.geometry import sensor_model
from fieldcal.geometry.earth_field import dip_rad
from fieldcal.geometry.intervals import interval_of
from fieldcal.geometry.rotation import Array, body_from_inertial, continuous, slerp, to_rotation_vector
from fieldcal.names import VECTOR_SENSORS, Json, Sensor
from fieldcal.reason_codes import ReasonCode
from fieldcal.stages.attitude import sensor_attitude
from fieldcal.stages.inputs import Tables
from fieldcal.stages.joint.judgement import MAX_DIP_DIFFERENCE_DEG
from fieldcal.stages.vps_poses import AdmittedPoses, admitted_poses, clock_of

if TYPE_CHECKING:
    from fieldcal.config.stage_settings import JointSettings

# A triad's delay is refined until it changes by less; one that is longer is none, but another motion.
CONVERGED_DELAY_S, LONGEST_DELAY_S, MOST_DELAY_ROUNDS = 1e-3, 0.5, 6


@dataclass(frozen=True)
class ByVps:
    """What the VPS determines: `fit` of the gyroscope, `close` of trajectory, clock and mounting; `triads` of the
    vector sensors in axes of the accelerometer's own (of the gyroscope's, without one), or why there is none; `world`
    (4,): from the VPS's world to NED; and the numbers."""

    fit: JointFit
    close: JointFit
    triads: Mapping[Sensor, TriadByPose | FieldcalError]
    world: Array
    measured: Mapping[str, Json]


def poses_of(tables: Tables, s: JointSettings) -> AdmittedPoses | None:
    """The log's VPS as far as it is admitted, unless `use_vps` is false or there is none. Outliers and repeats are told
    by stage `vps_sync`."""
    if s.use_vps is False or "vps" not in tables or tables["vps"].is_empty():
        return None
    first_ns, last_ns = (int(tables["samples"]["t_ns"][i]) for i in (0, -1))
    return admitted_poses(tables["vps"], first_ns, (last_ns - first_ns) * 1e-9, s)


def gyroscope_by_vps(readings: Readings, poses: AdmittedPoses, s: JointSettings) -> tuple[JointFit, JointFit]:
    """`fit_gyroscope` on a flight. Raises UnusableFlight, EstimationError."""
    nominal, polarity = s.nominal_scale[Sensor.GYROSCOPE], s.polarity[Sensor.GYROSCOPE]
    logged = readings.gyroscope
    # A unit has its zero at rest; counts have it near their median.
    zero = np.median(logged, axis=0) if nominal is None else np.zeros(3)
    unit = (np.ones(3) if nominal is None else np.asarray(nominal)) * np.asarray(polarity, dtype=float)
    q = continuous(sensor_attitude(poses.q, s))
    clock = clock_of(poses, readings.t, (logged - zero) * unit, q, s)
    scale, rotation = start_by_rates(clock.matrix / unit[:, None], polarity, nominal)
    start = scale, -scale * zero
    return fit_gyroscope(readings, poses.t, q, clock, start, rotation, max_gap_s=poses.max_gap_s)


def estimate_by_vps(readings: Readings, poses: AdmittedPoses, s: JointSettings) -> ByVps:
    """Everything that the VPS determines. Raises UnusableFlight, EstimationError where it can't give a gyroscope."""
    fit, close = gyroscope_by_vps(readings, poses, s)
    assert close.vps is not None
    at = close.vps.to_imu_clock(poses.t, close.state.values)
    i = interval_of(at, readings.t)
    known = (readings.t >= at[0]) & (readings.t <= at[-1]) & (at[i + 1] - at[i] <= poses.max_gap_s)
    triads: dict[Sensor, TriadByPose | FieldcalError] = {}
    measured = _measured(close, poses)
    own_axes: tuple[Array, Array] = np.eye(3), np.zeros((3, 3))
    in_world: dict[Sensor, Array] = {}
    for sensor in VECTOR_SENSORS[::-1]:  # the accelerometer first: the body axes are its own
        logged = readings.accelerometer if sensor == Sensor.ACCELEROMETER else readings.magnetometer
        if logged is None:
            continue
        try:
            found, numbers = _on_its_own_clock(sensor, logged, readings, close, poses, known, at, s)
        except (UnusableFlight, EstimationError) as error:
            triads[sensor] = error
            continue
        in_world[sensor] = mean_in_world(close.path.q[known], (logged @ found.matrix.T + found.bias)[known])
        if sensor == Sensor.ACCELEROMETER:
            found, rotation, uncertainty = body_axes(found, s.polarity[sensor])
            own_axes = rotation, uncertainty
        else:
            found = found.turned(*own_axes)
        test = found.cross_test(CROSS[sensor])
        full = test > SCORE_CHI2[len(CROSS[sensor])]
        if not full:
            found = found.square(np.nanmean(logged, axis=0), CROSS[sensor])
        triads[sensor] = found
        measured[f"{sensor}_by_vps"] = {**numbers, "cross_axis_test": test, "cross_axis_kept": full}
    down = in_world.get(Sensor.ACCELEROMETER)
    world = ned_from_world(
        None if down is None else np.sign(readings.gravity_mps2) * down,
        in_world.get(Sensor.MAGNETOMETER),
        readings.field_ned,
    )
    return ByVps(fit, close, triads, world, measured)


def _on_its_own_clock(
    sensor: Sensor,
    logged: Array,
    readings: Readings,
    fit: JointFit,
    poses: AdmittedPoses,
    known: np.ndarray,
    at: Array,
    s: JointSettings,
) -> tuple[TriadByPose, dict[str, Json]]:
    """`_vector_triad`, anew with the trajectory of when the triad sensed it, until its delay changes no more: the delay
    is linear only while the vehicle turns little within it."""
    late = 0.0
    for _ in range(MOST_DELAY_ROUNDS):
        then = replace(readings, t=readings.t - late)
        q = slerp(readings.t, fit.path.q, then.t) if late else fit.path.q
        found, numbers = _vector_triad(sensor, logged, then, q, fit, poses, known, at, s)
        late, before = late + found.delay_s, late
        if abs(late - before) < CONVERGED_DELAY_S or abs(late) > LONGEST_DELAY_S:
            break
    found = replace(found, delay_s=late)
    return found, {**numbers, "delay_s": late}


def _vector_triad(
    sensor: Sensor,
    logged: Array,
    readings: Readings,
    q: Array,
    fit: JointFit,
    poses: AdmittedPoses,
    known: np.ndarray,
    at: Array,
    s: JointSettings,
) -> tuple[TriadByPose, dict[str, Json]]:
    """One vector triad by attitudes q (n, 4) at the readings' stamps, and the numbers that stand for it."""
    assert fit.vps is not None
    by_position = sensor == Sensor.ACCELEROMETER and bool(np.isfinite(poses.position).any())
    numbers: dict[str, Json] = {"by": "attitude and position" if by_position else "attitude"}
    if by_position:
        turn = body_from_inertial(fit.vps.world_rotation(fit.state.values))
        found = fit_accelerometer(
            readings.t,
            readings.segment,
            logged,
            q,
            at,
            poses.position @ turn,
            gravity_mps2=readings.gravity_mps2,
            max_gap_s=poses.max_gap_s,
        )
        numbers |= _lever_arm(found, s)
    else:
        length = (
            abs(readings.gravity_mps2) if sensor == Sensor.ACCELEROMETER else float(np.linalg.norm(readings.field_ned))
        )
        found, vector, _ = fit_constant_vector(
            readings.t, readings.segment, logged, q, known, length=length, polarity=s.polarity[sensor]
        )
        down = float(np.degrees(dip_rad(vector)))
        expected = float(np.degrees(dip_rad(readings.field_ned)))
        if sensor == Sensor.MAGNETOMETER and abs(down - expected) > MAX_DIP_DIFFERENCE_DEG:
            raise UnusableFlight(
                ReasonCode.FIELD_CONTRADICTED,
                f"The field dips by {down:.0f}° below the VPS's horizon where {expected:.0f}° is configured: is the"
                " field's place (latitude and longitude), or its direction, the right one?",
                {"dip_deg": down, "dip_expected_deg": expected},
            )
        numbers["dip_deg" if sensor == Sensor.MAGNETOMETER else "gravity_below_level_deg"] = down
    numbers |= {
        "delay_s": found.delay_s,
        "delay_sd_s": found.delay_sd_s,
        "misfit": found.misfit,
        "colour": found.colour,
        "mean_robust_weight": float(found.weight.mean()),
    }
    return found, numbers


def _lever_arm(found: TriadByPose, s: JointSettings) -> dict[str, Json]:
    """From the VPS's point to the sensor, body axes."""
    if found.lever_arm_m is None or found.lever_arm_sd_m is None:
        return {}
    axes = sensor_model.frd_from_sensor(s.rotation_body_from_sensor, s.body)
    sd = np.sqrt(axes**2 @ found.lever_arm_sd_m**2)
    return {"lever_arm_m": (axes @ found.lever_arm_m).tolist(), "lever_arm_sd_m": sd.tolist()}


def _measured(fit: JointFit, poses: AdmittedPoses) -> dict[str, Json]:
    vps = fit.vps
    assert vps is not None
    lag, skew = vps.clock_of(fit.state.values)
    sd = np.sqrt(np.diagonal(fit.covariance)[fit.layout["vps_clock"]])
    residual, available = vps.residual(fit.model, fit.state)
    turned = to_rotation_vector(vps.mounting(fit.state.values))
    return {
        "use_vps": True,
        "vps_poses": int(available.sum()),
        "vps_poses_refused": int((~vps.used).sum()),
        "vps_residual_deg": float(np.degrees(np.sqrt(np.mean(np.sum(residual[available] ** 2, axis=1))))),
        "vps_lag_mid_s": lag - poses.base_s,
        "vps_lag_sd_s": float(sd[0]),
        "vps_skew_ppm": 1e6 * skew,
        "vps_skew_sd_ppm": float(1e6 * sd[1]),
        "vps_body_rotation_deg": float(np.degrees(np.linalg.norm(turned))),
    }


def not_used(error: Exception) -> dict[str, Json]:
    """Why the VPS was not used, for `measured`."""
    code = error.reason_code if isinstance(error, FieldcalError) else ReasonCode.UNUSABLE_READINGS
    return {"use_vps": False, "use_vps_reason": code, "use_vps_sentence": str(error)}
