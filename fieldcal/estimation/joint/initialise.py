"""Start of the joint estimator: constants from the serial chain or from ellipsoids, attitudes from calibrated
vectors."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from fieldcal.errors import EstimationError, UnusableFlight
from fieldcal.estimation import wahba
from fieldcal.estimation.ellipsoid import fit_ellipsoid
from fieldcal.estimation.gyroscope.equation_error import GyroFit, fit_equation_error
from fieldcal.estimation.gyroscope.output_error import propagate_stretches
from fieldcal.estimation.joint.chain_solver import STATES, place_knots
from fieldcal.estimation.joint.problem import Model, Readings, State, averaging_side
from fieldcal.estimation.segments import run_bounds
from fieldcal.estimation.smoothing import differentiate_samples, fill, lattice, smooth_samples
from fieldcal.estimation.statistics import power_density
from fieldcal.geometry.earth_field import dip_rad
from fieldcal.geometry.rotation import (
    Array,
    angle_between,
    body_from_inertial,
    continuous,
    from_rotation_vector,
    multiply,
)
from fieldcal.reason_codes import ReasonCode

KNOT_SPACING_S = 0.08
START_CUTOFF_HZ = 4.0
# Low-passes (cut-off, Hz; length on either side, s) of the vectors in the axes of the integrated gyroscope: the longer,
# the less translation and passing magnets disturb them, and the more the gyroscope's drift does.
WINDOWS = ((0.2, 1.5), (0.07, 4.5), (0.02, 15.0))
HALF_WEIGHT_EXCESS = 0.1  # relative; a field that far off its mean has half the weight
# Cut-off of the rates for the lever arm: noise of their derivative, a regressor, would shrink it. So they are cut off,
# to within 0.8 Hz (π/TURNING_SIDE_S), where the density of the turning falls below LEAST_DENSITY_OVER_NOISE times that
# of the noise, which is measured in the band NOISE_HZ.
LEAST_DENSITY_OVER_NOISE, TURNING_SIDE_S, SPECTRUM_S = 10.0, 4.0, 8.0
NOISE_HZ, TURNING_HZ = (5.0, 20.0), (0.5, 5.0)

Constants = tuple[Array, Array]


def low_passed(t: Array, segment: np.ndarray, x: Array, cutoff_hz: float, side_s: float) -> Array:
    """Fixed-weight low-pass by contiguous segment."""
    out = np.empty_like(x)
    for a, b in run_bounds(segment):
        out[a:b] = smooth_samples(t[a:b], x[a:b], cutoff_hz, side_s=side_s)
    return out


def turning(t: Array, segment: np.ndarray, gyroscope: Array) -> Array:
    """Low-passed gyroscope and its derivative (2, n, 3), logged units: `Readings.turning`."""
    low = low_passed(t, segment, gyroscope, _fastest_turning_hz(t, segment, gyroscope), TURNING_SIDE_S)
    change = np.empty_like(low)
    for a, b in run_bounds(segment):
        change[a:b] = differentiate_samples(t[a:b], low[a:b])
    return np.stack([low, change])


def _fastest_turning_hz(t: Array, segment: np.ndarray, gyroscope: Array) -> float:
    """Frequency up to which the longest segment's spectrum, mean of the axes, is above the gyroscope's noise."""
    a, b = max(run_bounds(segment), key=lambda bounds: bounds[1] - bounds[0])
    index, interval_s = lattice(t[a:b])
    x = fill(index, gyroscope[a:b])
    frequency, density = power_density(x, interval_s, min(len(x), round(SPECTRUM_S / interval_s)))
    from_hz = min(NOISE_HZ[0], 0.5 * frequency[-1])
    noise = np.median(density[(frequency >= from_hz) & (frequency <= max(NOISE_HZ[1], from_hz))], axis=0)
    over = np.mean(density / np.maximum(noise, 1e-300), axis=1)
    strongest = int(np.argmax(over * (frequency <= TURNING_HZ[1])))
    lost = strongest + np.flatnonzero(over[strongest:] < LEAST_DENSITY_OVER_NOISE)
    return float(np.clip(frequency[max(lost[0] - 1, 0)] if len(lost) else np.inf, *TURNING_HZ))


def start_of_triad(logged: Array, magnitude: float, polarity: Array) -> Constants | None:
    """Ellipsoid constants to start from: the refined fit, else an algebraic one; None where no fit succeeds."""
    valid = logged[np.isfinite(logged).all(axis=1)]
    for method in ("robust", "li", "two_step", "tls"):
        try:
            fit = fit_ellipsoid(valid, magnitude, method=method, polarity=polarity)
        except (UnusableFlight, EstimationError, ValueError):
            continue
        return fit.scale_diagonal, fit.bias
    return None


def prepare(
    readings: Readings, constants: Mapping[str, Constants | None], *, lever_arm: Array | None = None
) -> tuple[Model, State]:
    """Model of a record and the state to start from.

    Parameters
    ----------
    readings : Readings
    constants : sensor → (λ (3,), b (3,)) or None
        Start in logged units, sensor axes, polarity right. A vector triad without one is left out; the gyroscope's is
        estimated from attitudes where both vector triads have one.
    lever_arm : (3,) array, optional
        As measured on the vehicle, m, sensor axes; 0 without.

    Raises
    ------
    UnusableFlight
        `no_start`: no vector triad has a start, or the gyroscope has none and one vector alone cannot give it.
    """
    vectors = {name: constants.get(name) for name in ("accelerometer", "magnetometer")}
    readings = Readings(**{**vars(readings), **{name: None for name, start in vectors.items() if start is None}})
    knots = place_knots(readings.t, readings.segment, KNOT_SPACING_S)
    q, gyro = _start_attitude(readings, knots.index, vectors, constants.get("gyroscope"))
    rate = np.sqrt(np.mean(np.sum((gyro[0] * readings.turning[0] + gyro[1]) ** 2, axis=1)))
    model = Model.of(readings, knots, side=averaging_side(readings, 3.0 * float(rate)))
    values = {
        "dip": np.array([dip_rad(readings.field_ned)]),
        "lever_arm": np.zeros(3) if lever_arm is None else lever_arm,
    }
    for name, start in {**vectors, "gyroscope": gyro}.items():
        if name in model.triads and start is not None:
            values[name] = model.triads[name].scaled(*start)
    return model, State(q, np.zeros((len(knots.index), STATES - 3)), values)


def anew(model: Model, state: State) -> State:
    """The state with attitudes made again from its constants, and no translation: where the constants of the start were
    far off, some attitudes end in a minimum in which a passing field or translation explains the readings."""
    constants = {name: triad.logged(state.values[name]) for name, triad in model.triads.items()}
    vectors = {name: constants.get(name) for name in ("accelerometer", "magnetometer")}
    q, _ = _start_attitude(model.readings, model.knots.index, vectors, constants["gyroscope"])
    return State(q, np.zeros_like(state.motion), state.values)


def _start_attitude(
    r: Readings, at: np.ndarray, vectors: Mapping[str, Constants | None], gyro: Constants | None
) -> tuple[Array, Constants]:
    """Attitude of the sensor axes (k, 4) at the samples `at` (k,), and gyroscope constants."""
    sensed = {}
    for name, start in vectors.items():
        logged = r.accelerometer if name == "accelerometer" else r.magnetometer
        if start is not None and logged is not None:
            sensed[name] = filled(r.t, logged) * start[0] + start[1]
    if len(sensed) == 2 and gyro is None:
        both = {name: low_passed(r.t, r.segment, x, START_CUTOFF_HZ, 0.5) for name, x in sensed.items()}
        gyro = _gyro_start(r, continuous(_turned_to(r, both)))
    if not sensed or gyro is None:
        raise UnusableFlight(
            ReasonCode.NO_START,
            "The joint estimate found no start: it needs a magnetometer or accelerometer with some constants, and with"
            " one of them alone a gyroscope whose unit is known.",
        )
    relative = propagate_stretches(r.t, r.gyroscope * gyro[0] + gyro[1], r.segment)
    r_nb = body_from_inertial(relative).transpose(0, 2, 1)
    carried = {name: np.einsum("nij,nj->ni", r_nb, x) for name, x in sensed.items()}
    means = ({name: x[at] for name, x in _means(r, carried, *window).items()} for window in WINDOWS)
    offsets = [_turned_to(r, own) for own in means]
    wander = [_wander(r.t[at], offset, side_s) for offset, (_, side_s) in zip(offsets, WINDOWS, strict=True)]
    return multiply(offsets[int(np.argmin(wander))], relative[at]), gyro


def _means(r: Readings, carried: Mapping[str, Array], cutoff_hz: float, side_s: float) -> dict[str, Array]:
    """Vectors in the axes of the integrated gyroscope, low-passed. Translation averages out; a passing magnet does not,
    so that a field far off its mean has less weight."""
    out = {name: low_passed(r.t, r.segment, x, cutoff_hz, side_s) for name, x in carried.items()}
    if "magnetometer" in carried:
        field, mean = carried["magnetometer"], out["magnetometer"]
        limit = HALF_WEIGHT_EXCESS * np.linalg.norm(r.field_ned)
        trust = 1.0 / (1.0 + np.sum(((field - mean) / limit) ** 2, axis=1, keepdims=True))
        weighted = low_passed(r.t, r.segment, np.hstack([field * trust, trust]), cutoff_hz, side_s)
        out["magnetometer"] = weighted[:, :3] / np.maximum(weighted[:, 3:], 1e-3)
    return out


def _turned_to(r: Readings, vectors: Mapping[str, Array]) -> Array:
    """Attitudes (n, 4) of the axes in which `vectors` (n, 3) are given; with one vector alone the shortest turn."""
    down = np.array([0.0, 0.0, float(np.sign(r.gravity_mps2))])
    if len(vectors) == 2:
        both = np.stack([vectors["magnetometer"], vectors["accelerometer"]], axis=1)
        reference = np.array([r.field_ned, down])
        return wahba.attitudes(both, reference, np.array([0.02, 0.02])).q
    ((name, vector),) = vectors.items()
    seen = vector / np.maximum(np.linalg.norm(vector, axis=1, keepdims=True), 1e-300)
    true = r.field_ned / np.linalg.norm(r.field_ned) if name == "magnetometer" else down
    axis = np.cross(seen, true)
    sine = np.linalg.norm(axis, axis=1)
    angle = np.arctan2(sine, seen @ true)
    return from_rotation_vector(axis * (angle / np.maximum(sine, 1e-12))[:, None])


def _wander(t: Array, offset: Array, side_s: float) -> float:
    """Rms angle, rad, between means that share no reading: their disturbance and the gyroscope's drift."""
    apart = int(2.0 * side_s / float(np.median(np.diff(t))))
    if apart >= len(t):
        return np.inf
    return float(np.sqrt(np.mean(angle_between(offset[:-apart], offset[apart:]) ** 2)))


def filled(t: Array, x: Array) -> Array:
    """Readings at every sample, interpolated linearly where there are none."""
    valid = np.isfinite(x).all(axis=1)
    return x if valid.all() else np.column_stack([np.interp(t, t[valid], c[valid]) for c in x.T])


def _gyro_start(r: Readings, q: Array) -> Constants:
    try:
        fit = gyro_from_attitude(r.t, r.segment, r.gyroscope, q)
    except UnusableFlight as error:
        raise UnusableFlight(
            ReasonCode.NO_START, f"The joint estimate found no start for the gyroscope: {error}"
        ) from error
    return fit.scale, fit.bias


def gyro_from_attitude(t: Array, segment: np.ndarray, gyroscope: Array, q: Array) -> GyroFit:
    """Equation error on attitudes q (n, 4), hemisphere continuous: both sides low-passed alike."""
    logged = low_passed(t, segment, gyroscope, START_CUTOFF_HZ, 0.5)
    q_dot = np.empty_like(q)
    for a, b in run_bounds(segment):
        q_dot[a:b] = differentiate_samples(t[a:b], q[a:b], window_s=0.05)
    return fit_equation_error(q, q_dot, logged)
