"""Ordinary flights as the estimate by velocity takes them: short, without a band limit, at a low rate."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fieldcal.estimation.by_velocity.fit import VelocityFit, fit_by_velocity
from fieldcal.estimation.by_velocity.problem import Epochs
from fieldcal.estimation.joint.problem import PriorConstants, Readings
from fieldcal.geometry.rotation import Array
from fieldcal.simulation.experiment import Experiment, SimulatedFlight, constants_at, simulate
from fieldcal.simulation.ordinary import ordinary_flight

TRIADS = ("gyroscope", "accelerometer", "magnetometer")
ZERO_SD = {"gyroscope": np.radians(2.0), "accelerometer": 0.3, "magnetometer": 0.5}
SHORT = {"duration_s": 40.0, "rate_hz": 40.0, "band_limit": False, "quantisation": False}


def short_flight(motion: str, seed: int, **changes: object) -> SimulatedFlight:
    return simulate(ordinary_flight(motion, seed, **{**SHORT, **changes}))


def field_of(e: Experiment) -> Array:
    return np.array([np.cos(e.dip_rad), 0.0, np.sin(e.dip_rad)])


def readings_of(flight: SimulatedFlight) -> Readings:
    return Readings(
        t=flight.t,
        segment=np.zeros(len(flight.t), dtype=np.int64),
        gyroscope=flight.counts["gyroscope"],
        accelerometer=flight.counts["accelerometer"],
        magnetometer=flight.counts["magnetometer"],
        gravity_mps2=flight.experiment.gravity_mps2,
        field_ned=field_of(flight.experiment),
        turning=np.zeros((2, len(flight.t), 3)),
    )


def epochs_of(flight: SimulatedFlight) -> Epochs:
    return Epochs(flight.gnss_t, flight.gnss_velocity, flight.gnss_sd)


def priors(wide: float = 1.0, units: dict[str, float] | None = None) -> dict[str, PriorConstants]:
    """Of readings in SI units, or in units of which `units` make one; `wide` times the sd of the defaults."""
    out = {}
    for name in TRIADS:
        scale = np.full(3, 1.0 / (units or {}).get(name, 1.0))
        covariance = np.diag(np.r_[(0.03 * scale) ** 2, np.full(3, ZERO_SD[name] ** 2)])
        if name == "magnetometer":
            covariance[:3, :3] += 0.01 * np.outer(scale, scale)
        out[name] = PriorConstants(scale, np.zeros(3), wide**2 * covariance)
    return out


def fitted(
    flight: SimulatedFlight, readings: Readings | None = None, known: dict[str, PriorConstants] | None = None
) -> VelocityFit:
    own, known = readings or readings_of(flight), known or priors()
    start = {name: (prior.scale, prior.bias) for name, prior in known.items()}
    if own.magnetometer is None:
        start.pop("magnetometer")
    return fit_by_velocity(own, epochs_of(flight), start, known, field_known=True)


def errors(flight: SimulatedFlight, fit: VelocityFit) -> dict[str, tuple[Array, Array]]:
    """Error and sd of every constant, and of lag and arm."""
    out = {}
    for name in TRIADS:
        if name not in fit.layout:
            continue
        scale, bias, covariance = fit.constants(name)
        true_scale, true_bias = constants_at(flight.experiment, name, 25.0)
        slope = np.hstack([np.diag(bias / scale**2), np.diag(-1.0 / scale)])
        sd = np.sqrt(np.r_[np.diagonal(covariance)[:3], np.diagonal(slope @ covariance @ slope.T)])
        out[f"{name} scale"] = scale - true_scale, sd[:3]
        out[f"{name} zero"] = true_bias / true_scale - bias / scale, sd[3:]
    for name, true in (("lag", np.array([flight.gnss_lag_s])), ("arm", np.array(flight.experiment.gnss_arm_m))):
        value, covariance = fit.found(name)
        out[name] = value - true, np.sqrt(np.diagonal(covariance))
    return out


def with_readings(flight: SimulatedFlight, **changes: Array) -> Readings:
    return replace(readings_of(flight), **changes)
