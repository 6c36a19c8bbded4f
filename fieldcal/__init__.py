"""fieldcal: field calibration of inertial sensors (Grauer et al., AIAA 2009-2064, corrected and extended).

This page fixes the conventions; no other docstring repeats them.

Frames
    n  inertial: north, east, down (NED) at a fixed point.
    b  body: nose, starboard, underside (FRD).
    s  sensor: the triads' own axes, as logged. R_BS turns s into b.
    v  the world of the visual positioning system (VPS).
    Logs in ENU / FLU (ROS) are converted after the sensor model, never before.

Attitude
    Quaternions are (ε1, ε2, ε3, δ): **scalar last** (Eq. 1). A(q) = (δ² − εᵀε)I + 2εεᵀ − 2δS(ε) takes inertial
    components to body components; the same four numbers are SciPy's body-to-inertial rotation.
    q̇ = ½[δI + S(ε); −εᵀ] ω, ω the body rate in body axes (Eq. 10–11). Hemisphere is made continuous before any
    interpolation, smoothing, differentiation or fit metric.

Sensor model (Eq. 5)
    z = Λ z_d + b: z_d the logged number, Λ = diag(λ), in sensor axes. Polarity lives in the sign of λ.
    `zero` = −b/λ in logged units; `zero_bias` = λ d0 + b at a fixed reading d0.

Gravity sign
    "gravity": the accelerometer reads +g on the down axis at rest (the paper). "specific_force": it reads −g there.
    Inside fieldcal's attitude and lever-arm code the accelerometer is always gravity-signed, in body axes.

Arrays
    Rows are samples: (n, 3) vectors, (n, 4) quaternions. Time `t` is float64 seconds from the first sample of the
    log; stamps in tables are int64 nanoseconds. SI units: s, m, rad, m/s², rad/s; magnetic field in the unit of the
    configured reference (T, uT, G, or "norm": units of the local field).
    `segment` numbers contiguous stretches; nothing is interpolated, filtered or integrated across a boundary.

Symbols
    λ, Λ scale · b bias · h field · a acceleration · ω rate · q, ε, δ attitude · f field strength · σ standard
    deviation · ν residual · r_SB lever arm, centre of mass to sensor, body axes · TIC Theil inequality coefficient.

Use
    read_log → Recording; calibrate → Calibration, whose sensors have scale, bias and zero; export and apply take it on.
    Warehouse asks what the nights have found. fit_ellipsoid, fit_output_error, fit_joint and synchronise work on
    arrays. What was refused raises Refused when it is asked for; every error is a FieldcalError with a reason_code, or
    Python's ValueError for a caller's mistake. plot, and the method of that name, draw any result.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

__version__ = "0.1.0"

__all__ = [
    "CalibratedReadings",
    "Calibration",
    "Compared",
    "ConfigurationError",
    "Constants",
    "Decided",
    "EllipsoidFit",
    "Estimate",
    "EstimationError",
    "Experiment",
    "Export",
    "FieldcalError",
    "HandedOut",
    "JointEstimate",
    "OutputErrorFit",
    "Part",
    "Recording",
    "Refit",
    "Refused",
    "SensorCalibration",
    "SimulatedFlight",
    "Synchronisation",
    "Triad",
    "UnreadableLog",
    "UnusableFlight",
    "VpsClock",
    "Warehouse",
    "WarehouseError",
    "Written",
    "apply",
    "calibrate",
    "compare",
    "export",
    "fit_ellipsoid",
    "fit_joint",
    "fit_output_error",
    "ordinary_flight",
    "plot",
    "read_log",
    "simulate",
    "synchronise",
    "write_flights",
    "write_onboard",
]

_NAMES_OF = {
    "api.calibration": (
        "Calibration",
        "calibrate",
    ),
    "api.clock_sync": (
        "Synchronisation",
        "synchronise",
    ),
    "api.constants": (
        "apply",
        "compare",
        "export",
    ),
    "api.ellipsoid": (
        "EllipsoidFit",
        "fit_ellipsoid",
    ),
    "api.estimate": ("Estimate",),
    "api.joint": (
        "JointEstimate",
        "fit_joint",
    ),
    "api.onboard": ("write_onboard",),
    "api.output_error": (
        "OutputErrorFit",
        "fit_output_error",
    ),
    "api.plot": ("plot",),
    "api.recording": (
        "Recording",
        "read_log",
    ),
    "api.sensor": ("SensorCalibration",),
    "api.vps_clock": ("VpsClock",),
    "api.warehouse": ("Decided", "Part", "Warehouse"),
    "errors": (
        "ConfigurationError",
        "EstimationError",
        "FieldcalError",
        "Refused",
        "UnreadableLog",
        "UnusableFlight",
    ),
    "exports.apply": ("CalibratedReadings",),
    "exports.autopilots.comparison": ("Compared",),
    "exports.calibration": (
        "Constants",
        "Export",
        "Triad",
        "Written",
    ),
    "exports.handed_out": ("HandedOut",),
    "exports.refit": ("Refit",),
    "simulation.archive": ("write_flights",),
    "simulation.experiment": (
        "Experiment",
        "SimulatedFlight",
        "simulate",
    ),
    "simulation.ordinary": ("ordinary_flight",),
    "warehouse.errors": ("WarehouseError",),
}
"""Module → public names. They are loaded when they are asked for: `fieldcal --help` needs none of them."""

if TYPE_CHECKING:
    from fieldcal.api.calibration import Calibration, calibrate
    from fieldcal.api.clock_sync import Synchronisation, synchronise
    from fieldcal.api.constants import apply, compare, export
    from fieldcal.api.ellipsoid import EllipsoidFit, fit_ellipsoid
    from fieldcal.api.estimate import Estimate
    from fieldcal.api.joint import JointEstimate, fit_joint
    from fieldcal.api.onboard import write_onboard
    from fieldcal.api.output_error import OutputErrorFit, fit_output_error
    from fieldcal.api.plot import plot
    from fieldcal.api.recording import Recording, read_log
    from fieldcal.api.sensor import SensorCalibration
    from fieldcal.api.vps_clock import VpsClock
    from fieldcal.api.warehouse import Decided, Part, Warehouse
    from fieldcal.errors import (
        ConfigurationError,
        EstimationError,
        FieldcalError,
        Refused,
        UnreadableLog,
        UnusableFlight,
    )
    from fieldcal.exports.apply import CalibratedReadings
    from fieldcal.exports.autopilots.comparison import Compared
    from fieldcal.exports.calibration import Constants, Export, Triad, Written
    from fieldcal.exports.handed_out import HandedOut
    from fieldcal.exports.refit import Refit
    from fieldcal.simulation.archive import write_flights
    from fieldcal.simulation.experiment import Experiment, SimulatedFlight, simulate
    from fieldcal.simulation.ordinary import ordinary_flight
    from fieldcal.warehouse.errors import WarehouseError
else:  # mypy is not shown this: it would let every misspelt name pass

    def __getattr__(name: str) -> object:
        from importlib import import_module

        for module, names in _NAMES_OF.items():
            if name in names:
                globals()[name] = value = getattr(import_module(f"fieldcal.{module}"), name)
                return value
        raise AttributeError(f"module 'fieldcal' has no attribute {name!r}")

    def __dir__() -> list[str]:
        return sorted([*globals(), *__all__])
