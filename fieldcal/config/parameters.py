"""Every stage parameter: default, allowed values, unit and meaning. The configuration is checked against this page."""

from __future__ import annotations

from dataclasses import dataclass

Value = float | int | str | bool


@dataclass(frozen=True)
class Parameter:
    """One knob of one or more stages. `choices` or inclusive `bounds` limit it."""

    default: Value
    meaning: str
    unit: str = ""
    choices: tuple[str, ...] = ()
    bounds: tuple[float, float] | None = None


PARAMETERS: dict[str, Parameter] = {
    # manoeuvre
    "manoeuvre_window_s": Parameter(2.0, "window over which rotation is judged", "s", bounds=(0.2, 60.0)),
    "manoeuvre_pad_s": Parameter(5.0, "time kept on either side of an excited stretch", "s", bounds=(0.0, 60.0)),
    "manoeuvre_rest_s": Parameter(60.0, "rest kept on either side of an excited stretch", "s", bounds=(0.0, 600.0)),
    "manoeuvre_min_s": Parameter(10.0, "shortest total excited time worth calibrating on", "s", bounds=(1.0, 600.0)),
    "manoeuvre_max_gap_s": Parameter(
        0.1, "a longer pause between samples starts a new segment", "s", bounds=(0.01, 10.0)
    ),
    "manoeuvre_excited_ratio": Parameter(
        0.15,
        "excited: window rate rms above this share of the level sustained for manoeuvre_min_s",
        "1",
        bounds=(0.001, 1.0),
    ),
    # smoothing
    "smoothing_cutoff_hz": Parameter(
        8.0, "cut-off of the fixed-weight low-pass; 0 switches smoothing off", "Hz", bounds=(0.0, 500.0)
    ),
    "smoothing_ends": Parameter("odd", "reflection at the ends of a segment", choices=("odd", "even")),
    "smoothing_side_s": Parameter(0.5, "length of the weights on either side", "s", bounds=(0.05, 10.0)),
    # ellipsoids
    "ellipsoid": Parameter("robust", "ellipsoid fit", choices=("robust", "li", "li_full", "two_step", "tls")),
    "ellipsoid_max_condition": Parameter(50.0, "refuse above this condition number", "1", bounds=(2.0, 1e6)),
    "ellipsoid_max_scale_sd": Parameter(
        0.05, "refuse above this relative standard deviation of a scale", "1", bounds=(1e-4, 1.0)
    ),
    "ellipsoid_max_residual": Parameter(
        0.10, "refuse above this rms residual, relative to the field", "1", bounds=(1e-3, 1.0)
    ),
    "gate_norm": Parameter(0.05, "accelerometer gate: low-passed norm within this share of g", "1", bounds=(1e-3, 1.0)),
    "gate_rate_radps": Parameter(0.15, "accelerometer gate: rotation rate below this", "rad/s", bounds=(0.01, 50.0)),
    # attitude
    "attitude": Parameter(
        "quest", "attitude from two vectors", choices=("quest", "davenport", "svd", "triad", "euler")
    ),
    # gyroscope
    "equations": Parameter("all", "kinematic equations used by the equation-error fit", choices=("all", "scalar")),
    "differentiation_window_s": Parameter(
        0.027, "window of the local smoothed differentiation (at least 5 samples)", "s", bounds=(0.001, 2.0)
    ),
    "gyro_output": Parameter(True, "refine the gyroscope by output error"),
    "initial_attitude": Parameter("estimated", "output error: initial attitudes", choices=("estimated", "fixed")),
    "shooting_s": Parameter(
        0.0,
        "output error: longest stretch integrated from one initial attitude; 0 lets the noise decide",
        "s",
        bounds=(0.0, 1e5),
    ),
    "gyro_max_scale_sd": Parameter(
        0.05, "refuse above this relative standard deviation of a gyroscope scale", "1", bounds=(1e-4, 1.0)
    ),
    # visual positioning system
    "use_vps": Parameter(False, "use the VPS attitude in the estimate (method joint)"),
    "vps_max_lag_s": Parameter(60.0, "largest clock offset searched", "s", bounds=(0.1, 1e6)),
    "vps_min_peak": Parameter(0.5, "refuse a correlation peak below this", "1", bounds=(0.0, 1.0)),
    "vps_max_gap_s": Parameter(
        0.05, "VPS gaps longer than this are masked, never interpolated", "s", bounds=(0.001, 10.0)
    ),
}

PROFILES: dict[str, dict[str, Value]] = {
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
