"""The joint estimate once more with the VPS in it (`use_vps`): prepare the poses, fit, report what was used."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from fieldcal.errors import EstimationError, UnusableFlight
from fieldcal.estimation.clock_sync import by_rates
from fieldcal.estimation.joint.fit import JointFit, fit_joint
from fieldcal.estimation.joint.pose_measurement import VpsRecord
from fieldcal.geometry import sensor_model
from fieldcal.geometry.rotation import Array, continuous, to_rotation_vector
from fieldcal.names import Json
from fieldcal.reason_codes import ReasonCode
from fieldcal.stages.attitude import sensor_attitude
from fieldcal.stages.inputs import Tables
from fieldcal.stages.tables import QUATERNION, matrix, seconds
from fieldcal.stages.vps import vps_attitude

if TYPE_CHECKING:
    from fieldcal.config.stage_settings import VpsReference


@dataclass(frozen=True)
class Poses:
    """VPS stamps (m,), s from the first sample (its epoch `base_s` taken off), and attitudes (m, 4) of the sensor
    axes, outliers masked."""

    t: Array
    q: Array
    base_s: float
    max_gap_s: float


def poses_of(tables: Tables, s: VpsReference) -> Poses | None:
    """The log's VPS where `use_vps` asks for it and there is one."""
    if not s.use_vps or "vps" not in tables or tables["vps"].is_empty():
        return None
    origin, stamps = int(tables["samples"]["t_ns"][0]), tables["vps"]["t_ns"]
    base_ns = int(stamps[0]) - origin
    length_s = (int(tables["samples"]["t_ns"][-1]) - origin) * 1e-9
    if abs(base_ns) * 1e-9 <= s.vps_max_lag_s + length_s:
        base_ns = 0
    t, q = seconds(stamps, origin + base_ns), vps_attitude(matrix(tables["vps"], QUATERNION), s)
    keep = by_rates.mask_outliers(t, q)
    return Poses(t[keep], continuous(sensor_attitude(q[keep], s)), base_ns * 1e-9, s.vps_max_gap_s)


def with_poses(fit: JointFit, poses: Poses | None, s: VpsReference) -> tuple[JointFit, dict[str, Json]]:
    """The fit with the VPS in it, and what was used; as it was, with the reason, where the VPS cannot be used."""
    if poses is None:
        return fit, {"use_vps": False} if s.use_vps else {}
    readings = fit.model.readings
    scale, bias, _ = fit.constants("gyroscope")
    try:
        clock = by_rates.synchronise(
            readings.t,
            sensor_model.calibrate(readings.gyroscope, scale, bias),
            poses.t,
            poses.q,
            max_lag_s=s.vps_max_lag_s,
            min_peak=s.vps_min_peak,
            max_gap_s=poses.max_gap_s,
        )
        vps = VpsRecord.of(poses.t, poses.q, clock, fit.model, fit.state, fit.path, max_gap_s=poses.max_gap_s)
        if vps is None:
            return fit, {"use_vps": False, "use_vps_reason": ReasonCode.VPS_TOO_SHORT}
        start = replace(fit.state, values={**fit.state.values, **vps.start()})
        refitted = fit_joint(fit.model, start, try_lever_arm="lever_arm" in fit.layout, vps=vps, levels=fit.levels)
    except (UnusableFlight, EstimationError) as error:
        return fit, {"use_vps": False, "use_vps_reason": error.reason_code}
    return replace(refitted, iterations=fit.iterations + refitted.iterations), _measured(refitted, vps, poses)


def _measured(fit: JointFit, vps: VpsRecord, poses: Poses) -> dict[str, Json]:
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
