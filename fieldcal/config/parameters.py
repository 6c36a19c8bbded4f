"""Every stage parameter: default, allowed values, unit and meaning. The configuration is checked against this page."""

from __future__ import annotations

from typing import TypeVar

from pydantic import Field

from fieldcal.config.values import Table
from fieldcal.names import AttitudeFit, EllipsoidFit, Equations, InitialAttitude, ProfileName, SegmentEnds, UseVps

Value = float | str | bool
V = TypeVar("V", bound=Value)


def parameter(default: V, meaning: str, unit: str = "", *, within: tuple[float, float] | None = None) -> V:
    """A field with its default, its meaning, its unit and inclusive bounds."""
    lowest, highest = within or (None, None)
    return Field(
        default, ge=lowest, le=highest, description=meaning, json_schema_extra={"unit": unit} if unit else None
    )


class Parameters(Table):
    """`[parameters]` of a vehicle."""

    # manoeuvre
    manoeuvre_window_s: float = parameter(2.0, "window over which rotation is judged", "s", within=(0.2, 60.0))
    manoeuvre_pad_s: float = parameter(5.0, "time kept on either side of an excited stretch", "s", within=(0.0, 60.0))
    manoeuvre_rest_s: float = parameter(
        60.0, "rest kept on either side of an excited stretch", "s", within=(0.0, 600.0)
    )
    manoeuvre_min_s: float = parameter(
        10.0, "shortest total excited time worth calibrating on", "s", within=(1.0, 600.0)
    )
    manoeuvre_max_gap_s: float = parameter(
        0.1, "a longer pause between samples starts a new segment", "s", within=(0.01, 10.0)
    )
    manoeuvre_excited_ratio: float = parameter(
        0.15,
        "excited: window rate rms above this share of the level sustained for manoeuvre_min_s",
        "1",
        within=(0.001, 1.0),
    )
    # smoothing
    smoothing_cutoff_hz: float = parameter(
        8.0, "cut-off of the fixed-weight low-pass; 0 switches smoothing off", "Hz", within=(0.0, 500.0)
    )
    smoothing_ends: SegmentEnds = parameter("odd", "reflection at the ends of a segment")
    smoothing_side_s: float = parameter(0.5, "length of the weights on either side", "s", within=(0.05, 10.0))
    # ellipsoids
    ellipsoid: EllipsoidFit = parameter("robust", "ellipsoid fit")
    ellipsoid_max_condition: float = parameter(50.0, "refuse above this condition number", "1", within=(2.0, 1e6))
    ellipsoid_max_scale_sd: float = parameter(
        0.05, "refuse above this relative standard deviation of a scale", "1", within=(1e-4, 1.0)
    )
    ellipsoid_max_residual: float = parameter(
        0.10, "refuse above this rms residual, relative to the field", "1", within=(1e-3, 1.0)
    )
    gate_norm: float = parameter(
        0.05, "accelerometer gate: low-passed norm within this share of g", "1", within=(1e-3, 1.0)
    )
    gate_rate_radps: float = parameter(
        0.15, "accelerometer gate: rotation rate below this", "rad/s", within=(0.01, 50.0)
    )
    # attitude
    attitude: AttitudeFit = parameter("quest", "attitude from two vectors")
    # gyroscope
    equations: Equations = parameter("all", "kinematic equations used by the equation-error fit")
    differentiation_window_s: float = parameter(
        0.027, "window of the local smoothed differentiation (at least 5 samples)", "s", within=(0.001, 2.0)
    )
    gyro_output: bool = parameter(True, "refine the gyroscope by output error")
    initial_attitude: InitialAttitude = parameter("estimated", "output error: initial attitudes")
    shooting_s: float = parameter(
        0.0,
        "output error: longest stretch integrated from one initial attitude; 0 lets the noise decide",
        "s",
        within=(0.0, 1e5),
    )
    gyro_max_scale_sd: float = parameter(
        0.05, "refuse above this relative standard deviation of a gyroscope scale", "1", within=(1e-4, 1.0)
    )
    # joint estimate: what is known of a sensor before the first sample, where its unit or nominal scale is
    prior_scale_sd: float = parameter(
        0.03, "joint: sd of a scale about the nominal one, before the flight", "1", within=(1e-4, 1.0)
    )
    prior_magnetometer_scale_sd: float = parameter(
        0.10, "joint: sd of what the magnetometer's scales have in common", "1", within=(1e-4, 1.0)
    )
    prior_gyroscope_zero_dps: float = parameter(2.0, "joint: sd of a gyroscope's zero", "deg/s", within=(1e-3, 100.0))
    prior_accelerometer_zero_mps2: float = parameter(
        0.3, "joint: sd of an accelerometer's zero", "m/s^2", within=(1e-3, 20.0)
    )
    prior_magnetometer_zero: float = parameter(
        0.5, "joint: sd of a magnetometer's zero, as a share of the local field", "1", within=(1e-3, 20.0)
    )
    # visual positioning system
    use_vps: UseVps = parameter(
        "auto",
        'VPS in the estimate (method joint): "auto" and true use one that can be used, true tells where there is none',
    )
    use_velocity: bool = parameter(
        True, "velocity of a satellite receiver in the estimate (method joint), where there is no VPS"
    )
    vps_max_lag_s: float = parameter(
        60.0,
        "clock offset searched first; beyond it only a match without doubt counts, and is told",
        "s",
        within=(0.1, 1e6),
    )
    vps_min_peak: float = parameter(0.5, "refuse a correlation peak below this", "1", within=(0.0, 1.0))
    vps_max_gap_s: float = parameter(
        0.05,
        "VPS gaps longer than this, and than 2.5 of its own intervals (at most 0.3 s), are masked, never interpolated",
        "s",
        within=(0.001, 10.0),
    )


PROFILES: dict[ProfileName, dict[str, Value]] = {
    "full": {},
    "onboard": {"ellipsoid": "two_step", "attitude": "euler", "equations": "all", "gyro_output": False},
    "paper": {
        "ellipsoid": "li",
        "attitude": "quest",
        "equations": "scalar",
        "initial_attitude": "fixed",
        "shooting_s": 1e5,
    },
}
