"""Which poses of a visual positioning system are admitted, and on which clock: one answer for every stage."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import polars as pl

from fieldcal.errors import UnusableFlight
from fieldcal.estimation.clock_sync.by_rates import SyncFit, mask_outliers
from fieldcal.estimation.clock_sync.handedness import READINGS, better_readings, handedness, mounting_deg
from fieldcal.estimation.clock_sync.repeated_poses import find_repeats
from fieldcal.estimation.clock_sync.search import find_clock
from fieldcal.estimation.faults import Fault
from fieldcal.estimation.statistics import robust_sigma
from fieldcal.geometry.frames import FRD_FROM_FLU_QUATERNION, NED_FROM_ENU_QUATERNION, in_ned
from fieldcal.geometry.rotation import Array, multiply, normalise
from fieldcal.names import Json
from fieldcal.reason_codes import ReasonCode
from fieldcal.stages.tables import QUATERNION, matrix, seconds

if TYPE_CHECKING:
    from fieldcal.config.stage_settings import VpsAttitude, VpsPoses

VPS = "vps"  # what findings name as the sensor
POSITION = ("px_m", "py_m", "pz_m")
LARGEST_LOST_SHARE = 0.5  # of poses that are frozen, stand for none or jump: nobody knows then what the rest is
# Gaps bridged of a system with slower poses: one that is missing, with jitter; but no more than a turn is smooth for.
GAP_INTERVALS, LONGEST_GAP_S = 2.5, 0.3
SLOW_SHARE = 0.1  # of intervals longer than the configured gap, from which that is told
JITTER_TOLD_S = 1e-3  # a vehicle that turns at 1 rad/s is then a tenth of a degree elsewhere


@dataclass(frozen=True)
class AdmittedPoses:
    """Poses that are left of a log's: stamps `t` (m,), s from the IMU's first sample with `base_s` taken off; `logged`
    (m, 4) quaternions as they stand in the log, `q` (m, 4) of the body (FRD) in NED, `position` (m, 3) m, NED, NaN
    for none; `lost_share` of the log's that are frozen, stand for none or jump; the longest gap that is bridged;
    what was found, and the numbers."""

    t: Array
    logged: Array
    q: Array
    position: Array
    base_s: float
    lost_share: float
    max_gap_s: float
    found: tuple[Fault, ...]
    measured: dict[str, Json]


def vps_attitude(q: Array, s: VpsAttitude) -> Array:
    """Logged VPS attitudes, body to world, in the paper's NED and FRD; unit length, continuous."""
    with np.errstate(invalid="ignore", divide="ignore"):
        q = normalise(q)
    if s.world == "enu":
        q = multiply(NED_FROM_ENU_QUATERNION, q)
    if s.body == "flu":
        q = multiply(q, FRD_FROM_FLU_QUATERNION)
    return q


def admitted_poses(vps: pl.DataFrame, origin_ns: int, length_s: float, s: VpsPoses) -> AdmittedPoses:
    """The poses of table `vps` less those that the system repeated, made up or got wrong; each kind is told.

    `origin_ns`, `length_s`: the IMU's first stamp, and its record's length. Clocks of different epochs: their starts
    are aligned first, as integers."""
    base_ns = int(vps["t_ns"][0]) - origin_ns
    if abs(base_ns) * 1e-9 <= s.vps_max_lag_s + length_s:
        base_ns = 0
    t, logged = seconds(vps["t_ns"], origin_ns + base_ns), matrix(vps, QUATERNION)
    return admitted(
        t,
        vps_attitude(logged, s),
        s.vps_max_gap_s,
        logged=logged,
        position=in_ned(matrix(vps, POSITION), s.world),
        base_s=base_ns * 1e-9,
    )


def admitted(
    t: Array,
    q: Array,
    max_gap_s: float,
    *,
    logged: Array | None = None,
    position: Array | None = None,
    base_s: float = 0.0,
) -> AdmittedPoses:
    """The same of stamps (m,), s, and attitudes (m, 4), body to world."""
    logged = q if logged is None else logged
    position = np.full((len(t), 3), np.nan) if position is None else position
    repeats = find_repeats(t, logged)
    keep = ~(repeats.held | repeats.frozen | repeats.default)
    jumps = np.zeros(len(t), dtype=bool)
    jumps[keep] = ~mask_outliers(t[keep], q[keep])
    keep &= ~jumps
    found = [
        *_masked(repeats.frozen, ReasonCode.VPS_FROZEN, "repeat the pose before while the vehicle turns"),
        *_masked(repeats.default, ReasonCode.VPS_DEFAULT_POSE, "are one and the same pose, reached by a jump"),
        *_masked(jumps, ReasonCode.VPS_OUTLIERS, "are no attitude or jump away from those beside them"),
    ]
    if repeats.rows_a_pose > 1:
        sentence = (
            f"The VPS's rows bring a new pose only every {repeats.rows_a_pose} rows: {int(repeats.held.sum())} of"
            f" {len(t)} rows repeat the one before and are left out."
        )
        share = float(repeats.held.mean())
        found.append(Fault(VPS, "", ReasonCode.VPS_HELD, share, 0.0, False, sentence))
    measured: dict[str, Json] = {
        "vps_samples": len(t),
        "vps_masked": int((~keep).sum()),
        "vps_frozen": int(repeats.frozen.sum()),
        "vps_default_poses": int(repeats.default.sum()),
        "vps_outliers": int(jumps.sum()),
    }
    poses = AdmittedPoses(
        t[keep],
        logged[keep],
        q[keep],
        position[keep],
        base_s,
        float((repeats.frozen | repeats.default | jumps).mean()),
        max_gap_s,
        tuple(found),
        measured,
    )
    return _with_gap(poses)


def need_most(poses: AdmittedPoses) -> None:
    """Refuse poses of which most were left out (`vps_lost`): nobody knows then what the rest is."""
    if poses.lost_share > LARGEST_LOST_SHARE:
        told = " ".join(f.sentence for f in poses.found)
        raise UnusableFlight(
            ReasonCode.VPS_LOST, f"Most of the VPS's poses cannot be used. {told}", {"lost_share": poses.lost_share}
        )


def _masked(rows: np.ndarray, code: ReasonCode, what: str) -> list[Fault]:
    if not rows.any():
        return []
    share = float(rows.mean())
    stretches = int(np.sum(np.diff(np.r_[0, rows.astype(int)]) == 1))
    sentence = (
        f"{int(rows.sum())} of the VPS's {len(rows)} poses ({100 * share:.2g} %, {stretches}"
        f" {'stretch' if stretches == 1 else 'stretches'}) {what}: they are left out."
    )
    return [Fault(VPS, "", code, share, LARGEST_LOST_SHARE, False, sentence)]


def _with_gap(poses: AdmittedPoses) -> AdmittedPoses:
    """The gap that is bridged, by the system's own interval; how its stamps scatter."""
    if len(poses.t) < 3:
        return poses
    step = np.diff(poses.t)
    usual = step[step < 1.5 * np.median(step)]
    interval = float(usual.mean())  # the median of a few steps of jitter is beside it
    gap = max(poses.max_gap_s, min(GAP_INTERVALS * interval, LONGEST_GAP_S))
    # From stamp to stamp, whole intervals taken off: both stamps' scatter is in it.
    off = step - np.maximum(np.rint(step / interval), 1.0) * interval
    jitter = robust_sigma(off[step < 10.0 * interval] - np.median(off)) / np.sqrt(2.0)
    found = list(poses.found)
    longer = float(np.mean(step > poses.max_gap_s))
    if gap > poses.max_gap_s and longer > SLOW_SHARE:
        sentence = (
            f"The VPS gives a pose every {1e3 * interval:.0f} ms, {100 * longer:.0f} % of the"
            f" intervals are longer than vps_max_gap_s = {poses.max_gap_s:g} s: gaps up to {1e3 * gap:.0f} ms are"
            " bridged."
        )
        found.append(Fault(VPS, "", ReasonCode.VPS_SLOW, interval, poses.max_gap_s, False, sentence))
    if jitter > JITTER_TOLD_S:
        sentence = (
            f"The VPS's stamps scatter by {1e3 * jitter:.1f} ms about a regular grid of {1e3 * interval:.4g} ms: if"
            " they tell when poses were published, log when they were captured."
        )
        found.append(Fault(VPS, "", ReasonCode.VPS_JITTER, float(jitter), JITTER_TOLD_S, False, sentence))
    numbers: dict[str, Json] = {
        "vps_interval_s": interval,
        "vps_stamp_jitter_s": float(jitter),
        "vps_gap_bridged_s": gap,
    }
    return replace(poses, max_gap_s=gap, found=tuple(found), measured={**poses.measured, **numbers})


def clock_of(poses: AdmittedPoses, t_imu: Array, rate: Array, q: Array, s: VpsPoses) -> SyncFit:
    """The VPS's clock against the IMU's, by attitudes q (m, 4) of the axes that are asked for.

    `t_imu` (n,) s; `rate` (n, 3) of right-handed axes (polarity applied), rad/s or any scale.

    Raises
    ------
    UnusableFlight
        `vps_lost`: most poses are left out; `vps_mirrored`: no rotation makes the one's turns the other's; and those of
        `find_clock`.
    """
    need_most(poses)
    try:
        fit = find_clock(
            t_imu,
            rate,
            poses.t,
            q,
            max_lag_s=s.vps_max_lag_s,
            min_peak=s.vps_min_peak,
            max_gap_s=poses.max_gap_s,
        )
    except UnusableFlight as error:
        if error.reason_code != ReasonCode.NOT_THE_SAME_MOTION:
            raise
        _refuse_other_reading(poses, t_imu, rate, s, float(str(error.measured.get("explained", 0.0))))
        raise
    found = handedness(fit)
    if not found.is_rotation:
        _refuse_other_reading(poses, t_imu, rate, s, fit.explained)
        raise UnusableFlight(
            ReasonCode.VPS_MIRRORED,
            f"The VPS's turns are {'mirrored' if found.is_mirror else 'sheared'} against the gyroscope's"
            f" ({100 * min(found.from_rotation, 1.0):.0f} % of their variance is beside any rotation): check"
            " polarity.gyroscope and rotation_body_from_sensor, and whether the VPS's axes are right-handed.",
            {"beside_rotation": found.from_rotation, "beside_mirror": found.from_mirror, **_peak(fit)},
        )
    return fit


MEND = {
    "inverse": "the inverse, world to body: log body to world, which has x, y and z with the other sign",
    "scalar first": "scalar first: name the columns in the order in which they stand as csv.vps.quaternion_wxyz, or log"
    " the scalar last",
}


def _refuse_other_reading(poses: AdmittedPoses, t_imu: Array, rate: Array, s: VpsPoses, explained: float) -> None:
    """Raise `vps_mirrored` where the quaternions fit as something else than body to world, scalar last. It is not used:
    which of the two mistakes it is only the mounting tells, and nothing what else was mistaken with it."""
    readings = {name: vps_attitude(read(poses.logged), s) for name, read in READINGS.items()}
    better = better_readings(
        t_imu, rate, poses.t, readings, explained, min_peak=s.vps_min_peak, max_gap_s=poses.max_gap_s
    )
    if not better:
        return
    told = [f"{MEND[name]} (then mounted {mounting_deg(fit):.0f}° from the IMU's axes)" for name, fit in better.items()]
    raise UnusableFlight(
        ReasonCode.VPS_MIRRORED,
        "The VPS's quaternions are no attitudes body to world, scalar last: they turn the other way than the gyroscope."
        f" They are {'; or '.join(told)}.",
        {"explained": explained, "fits_as": list(better), **_peak(next(iter(better.values())))},
    )


def _peak(fit: SyncFit) -> dict[str, Json]:
    return {"peak": fit.peak, "runner_up": fit.runner_up, "coarse_lag_s": fit.lag_mid_s}


def far_clock(poses: AdmittedPoses, lag_s: float, max_lag_s: float) -> tuple[Fault, ...]:
    """Told where the clocks are further apart than `vps_max_lag_s`, though they are not of different epochs."""
    if abs(lag_s) <= max_lag_s:
        return ()
    sentence = (
        f"The VPS's clock and the IMU's are {abs(lag_s - poses.base_s):.4g} s apart, further than vps_max_lag_s ="
        f" {max_lag_s:g} s: the motion matches there and nowhere nearer."
    )
    return (Fault(VPS, "", ReasonCode.VPS_FAR, abs(lag_s - poses.base_s), max_lag_s, False, sentence),)
