"""What real sensors do that the simulator's do not: faults added to a simulated flight, each with its truth."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.random import Generator

from fieldcal.geometry.rotation import Array
from fieldcal.names import Rotation, Sensor, Triple
from fieldcal.simulation.experiment import SimulatedFlight, constants_at


@dataclass(frozen=True)
class Faults:
    """Faults of a flight, all absent by default; SI units and sensor axes.

    `matrix`: sensor → M (3, 3), what is sensed is M · true (axes out of square, soft iron, a turned mounting).
    `delay_s`, `held_hz`, `step`: sensor → delay, rate at which values are renewed, and smallest difference, counts.
    `g_sensitivity` (3, 3): what specific force adds to the rate, rad/s per m/s² (the accelerometer's own sign).
    `nonlinearity`: share by which a rate of 300 °/s reads too high, growing with the rate. `rate_error`: share by which
    the stamps run fast. `field_per_ampere` (3,): what the motors' current adds to the magnetometer. `hard_iron_step`
    (3,): added to the magnetometer from the middle of the flight. `repeated_s`: length of a stretch that is repeated in
    place of the next.
    """

    matrix: Mapping[Sensor, Rotation] = field(default_factory=dict)
    delay_s: Mapping[Sensor, float] = field(default_factory=dict)
    held_hz: Mapping[Sensor, float] = field(default_factory=dict)
    step: Mapping[Sensor, float] = field(default_factory=dict)
    g_sensitivity: Rotation | None = None
    nonlinearity: float = 0.0
    rate_error: float = 0.0
    field_per_ampere: Triple | None = None
    hard_iron_step: Triple | None = None
    repeated_s: float = 0.0

    def true_scale(self, flight: SimulatedFlight, sensor: Sensor) -> Array:
        """The matrix (3, 3) that makes true values of logged ones: M⁻¹ diag(λ). Zeros stay what they are."""
        m = np.array(self.matrix.get(sensor, np.eye(3)))
        return np.asarray(np.linalg.solve(m, np.diag(flight.experiment.scale[sensor])))


NONLINEAR_AT_RADPS = np.radians(300.0)
PEAK_CURRENT_A = 20.0


def with_faults(flight: SimulatedFlight, faults: Faults, rng: Generator) -> SimulatedFlight:
    """The flight as its log would be with these faults; `current_a` of the motors beside it where they draw one."""
    sensed: dict[str, Array] = {}
    constants = {name: constants_at(flight.experiment, name, flight.temperature) for name in Sensor}
    for name in Sensor:
        scale, bias = constants[name]
        sensed[name] = scale * flight.counts[name] + bias
    force = sensed[Sensor.ACCELEROMETER]
    for name, matrix in faults.matrix.items():
        sensed[name] = sensed[name] @ np.array(matrix).T
    for name, late in faults.delay_s.items():
        sensed[name] = np.column_stack([np.interp(flight.t - late, flight.t, x) for x in sensed[name].T])
    rate = sensed[Sensor.GYROSCOPE]
    if faults.g_sensitivity is not None:
        rate = rate + force @ np.array(faults.g_sensitivity).T
    if faults.nonlinearity:
        rate = rate * (1.0 + faults.nonlinearity * np.abs(rate) / NONLINEAR_AT_RADPS)
    sensed[Sensor.GYROSCOPE] = rate
    current = None
    if faults.field_per_ampere is not None:
        current = _current(flight.t, rng)
        sensed[Sensor.MAGNETOMETER] = sensed[Sensor.MAGNETOMETER] + np.outer(current, faults.field_per_ampere)
    if faults.hard_iron_step is not None:
        late = (flight.t > 0.5 * flight.t[-1])[:, None]
        sensed[Sensor.MAGNETOMETER] = sensed[Sensor.MAGNETOMETER] + late * np.array(faults.hard_iron_step)
    counts: dict[str, Array] = {}
    for name in Sensor:
        scale, bias = constants[name]
        counts[name] = (sensed[name] - bias) / scale
        if name in faults.held_hz:
            ticks = np.floor(flight.t * faults.held_hz[name])
            counts[name] = counts[name][np.searchsorted(ticks, ticks)]
        step = faults.step.get(name, 1.0)
        if flight.experiment.quantisation or name in faults.step:
            counts[name] = step * np.rint(counts[name] / step)
    if faults.repeated_s:
        length = round(faults.repeated_s * flight.experiment.rate_hz)
        at = int(rng.integers(length, len(flight.t) - 2 * length))
        for values in counts.values():
            values[at : at + length] = values[at - length : at]
    return replace(
        flight,
        t=flight.t * (1.0 + faults.rate_error),
        counts=counts,
        current_a=current,
    )


def _current(t: Array, rng: Generator) -> Array:
    """Motors that run up and down, A (n,)."""
    steps = rng.uniform(0.0, PEAK_CURRENT_A, size=int(t[-1] / 2.0) + 2)
    return np.interp(t, 2.0 * np.arange(len(steps)), steps)
