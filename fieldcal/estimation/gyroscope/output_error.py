"""Gyroscope scale and bias by output error: integrate Eq. 10 with the real stamps and match the attitude.

The paper integrates once from a given attitude. Over tens of seconds that ignores what gyroscope noise does to an
integral (0.135 rad/s is a 3.6° random walk in 40 s), so by default the record is cut into stretches, each with an
initial attitude that is eliminated (multiple shooting).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from fieldcal import compiled
from fieldcal.compiled import attitude as compiled_attitude
from fieldcal.errors import EstimationError
from fieldcal.estimation.gyroscope.equation_error import GyroFit, from_centred
from fieldcal.estimation.segments import begins_run, run_bounds
from fieldcal.estimation.statistics import huber_inflation, huber_weights, least_squares_covariance, robust_sigma
from fieldcal.geometry.rotation import (
    IDENTITY,
    Array,
    body_from_inertial,
    conjugate,
    cumulative_product,
    from_rotation_vector,
    mean_quaternion,
    multiply,
    rotation_steps,
    to_rotation_vector,
)
from fieldcal.reason_codes import ReasonCode

BLOCKS = 12  # of a stretch, to tell a random walk from stationary error


def shooting_segments(t: ArrayLike, segment: ArrayLike, longest_s: float) -> np.ndarray:
    """Number the stretches to integrate: contiguous `segment`s (n,) cut into equal parts of at most `longest_s`."""
    t, segment = np.asarray(t, dtype=float), np.asarray(segment)
    out = np.empty(len(t), dtype=np.int64)
    number = 0
    for a, b in run_bounds(segment):
        parts = max(1, int(np.ceil((t[b - 1] - t[a]) / longest_s)))
        edges = np.linspace(t[a], t[b - 1], parts + 1)[1:-1]
        out[a:b] = number + np.searchsorted(edges, t[a:b], side="right")
        number += parts
    return out


def propagate_stretches(t: Array, rate: Array, stretch: Array) -> Array:
    """Attitude (n, 4) relative to the start of each stretch from body rates (n, 3), rad/s."""
    first = begins_run(stretch)
    if (library := compiled.LIBRARY) is not None:
        return compiled_attitude.propagate_stretches(library, t, rate, first)
    steps = from_rotation_vector(rotation_steps(t, rate))
    chain = np.concatenate([[IDENTITY], steps])
    chain[first] = IDENTITY
    # One scan over everything; dividing by its value at each start makes every stretch begin at the identity.
    total = cumulative_product(chain)
    starts = np.flatnonzero(first)
    return multiply(conjugate(total[starts])[np.cumsum(first) - 1], total)


def start_stretches(relative: Array, q: Array, stretch: Array, weight: Array, *, fixed: bool) -> Array:
    """Initial attitudes put on: the best rotation of each stretch onto the measured attitudes, or its first sample
    (`fixed`)."""
    out = np.empty_like(relative)
    for a, b in run_bounds(stretch):
        start = q[a] if fixed else mean_quaternion(multiply(q[a:b], conjugate(relative[a:b])), weight[a:b])
        out[a:b] = multiply(start, relative[a:b])
    return out


def without_stretch_means(x: Array, first: np.ndarray, weight: Array) -> Array:
    """Subtract each stretch's weighted mean: the Schur complement that eliminates the initial attitudes."""
    flat = x.reshape(len(x), -1)
    starts = np.flatnonzero(first)
    sums = np.add.reduceat(flat * weight[:, None], starts, axis=0)
    means = sums / np.add.reduceat(weight, starts)[:, None]
    return np.asarray((flat - np.repeat(means, np.diff(np.r_[starts, len(x)]), axis=0)).reshape(x.shape))


def random_walk(t: Array, residual: Array, stretch: np.ndarray, weight: Array) -> tuple[float, float]:
    """Random walk in the attitude error, rad²/s a component, and the share of the residual's variance that it makes.

    From means over twelfths of a stretch: how much further apart they are half a stretch away than next to each other.
    What is stationary in the residual (the error of the measured attitude) averages out in the means and is as far
    apart at both distances."""
    bounds = run_bounds(stretch)
    lengths = [stop - start for start, stop in bounds]
    typical, apart = float(np.median(lengths)), BLOCKS // 2
    size = max(1, int(typical) // BLOCKS)
    interval = float(np.median(np.diff(t)))
    near, far = [], []
    for (start, _), length in zip(bounds, lengths, strict=True):
        count = length // size
        if count <= apart:
            continue
        samples = slice(start, start + count * size)
        w = weight[samples].reshape(count, size, 1)
        mean = np.sum(residual[samples].reshape(count, size, 3) * w, axis=1) / np.maximum(w.sum(axis=1), 1e-300)
        near.append((mean[1:] - mean[:-1]) ** 2)
        far.append((mean[apart:] - mean[:-apart]) ** 2)
    if not near:
        return 0.0, 0.0
    growth = float(np.mean(np.concatenate(far)) - np.mean(np.concatenate(near)))
    walk = max(growth / ((apart - 1) * size * interval), 0.0)
    variance = float(np.average(np.mean(residual**2, axis=1), weights=weight))
    return walk, float(np.clip(walk * typical * interval / 6.0 / max(variance, 1e-300), 0.0, 1.0))


def walk_information(weighted: Array, dt: Array, first: np.ndarray, walk: float) -> Array:
    """Σ_k q Δt C_kᵀC_k, (6, 6): what a random walk q of the attitude does to the score Σ Sᵀw r.

    An increment at sample k moves every later sample of its stretch, so C_k is the sum of the weighted sensitivities
    (n, 3, 6) from k to the stretch's end."""
    total = np.cumsum(weighted, axis=0)
    starts = np.flatnonzero(first)
    ends = np.r_[starts[1:], len(weighted)] - 1
    later = np.repeat(total[ends], np.diff(np.r_[starts, len(weighted)]), axis=0)
    later[1:] -= total[:-1]
    later *= np.sqrt(walk * np.r_[0.0, dt])[:, None, None]
    flat = later.reshape(-1, 6)
    return np.asarray(flat.T @ flat)


def suitable_stretch_s(rate_noise: float, interval_s: float, attitude_sd: float) -> float:
    """How long one may integrate before gyroscope noise outgrows the attitude's error, s, within 5 to 200 s.

    White rate noise σ (rad/s a sample, every Δt) walks: over a stretch L the integral's scatter about its mean is
    σ²Δt L/6. Equal to the attitude variance at L = 6 σ_att²/(σ²Δt)."""
    walk = rate_noise**2 * interval_s
    return float(np.clip(6.0 * attitude_sd**2 / walk, 5.0, 200.0)) if walk > 0 else 200.0


def attitude_error_median(t: Array, q: Array, rate: Array, segment: Array, stretch_s: float, weight: Array) -> float:
    """Median attitude error, rad, of body rates integrated over stretches: which of two starts is nearer."""
    stretch = shooting_segments(t, segment, stretch_s)
    residual, _ = attitude_error(t, q, rate, stretch, weight, fixed=False)
    return float(np.median(np.linalg.norm(residual, axis=1)))


def fit_output_error(
    t: ArrayLike,
    q: ArrayLike,
    rate_logged: ArrayLike,
    start: GyroFit,
    *,
    segment: ArrayLike | None = None,
    stretch_s: float = 15.0,
    initial_attitude: str = "estimated",
    weights: ArrayLike | None = None,
    robust: bool = True,
    max_iterations: int = 40,
) -> GyroFit:
    """Gauss–Newton on the attitude error r = log(q_measured ⊗ q_model⁻¹), three components, inertial axes.

    The sensitivities are exact and cheap: ∂r(t)/∂(λ, b) = ∫ R_nb(τ)[diag(ω_d), I] dτ, a cumulative sum; only the
    quaternion product is a scan.

    Parameters
    ----------
    t : (n,) array
        Real stamps, s, rising.
    q : (n, 4) array
        Measured attitude, any source.
    rate_logged : (n, 3) array
        Gyroscope as logged, body axes. Unsmoothed or smoothed: integration does not mind.
    start : GyroFit
        Where to begin, normally the equation-error result.
    segment : (n,) array, optional
        Contiguous stretches; nothing is integrated across a boundary.
    stretch_s : float
        Longest integration from one initial attitude, s.
    initial_attitude : {"estimated", "fixed"}
        "fixed" starts each stretch at its first measured attitude (the paper).
    weights : (n,) array, optional
        Relative trust in each attitude.
    robust : bool
        Huber weights on each sample's error angle.

    Raises
    ------
    EstimationError
        `output_error_diverged`.

    Notes
    -----
    The covariance is the coloured-residual form. It cannot see errors of the attitude that move with the motion
    itself: see `uncertainty_propagation` for what the magnetometer's and accelerometer's uncertainty adds.
    """
    t, q, w_d = (np.asarray(v, dtype=float) for v in (t, q, rate_logged))
    n = len(t)
    if q.shape != (n, 4) or w_d.shape != (n, 3) or n < 10:
        raise ValueError(f"shapes (n,), (n, 4), (n, 3) with n ≥ 10 wanted, got {t.shape}, {q.shape}, {w_d.shape}")
    stretch = shooting_segments(t, np.zeros(n) if segment is None else segment, stretch_s)
    trust = np.ones(n) if weights is None else np.asarray(weights, dtype=float)
    fixed = initial_attitude == "fixed"
    centre = w_d.mean(axis=0)
    x_scale = np.maximum(np.sqrt(np.mean((w_d - centre) ** 2, axis=0)), 1e-300)
    x = (w_d - centre) / x_scale  # parameters scaled to O(1): absolute tolerances on λ ≈ 2e-4 would pass at once
    theta = np.concatenate([start.scale * x_scale, start.bias + start.scale * centre])
    weight, inflation = trust, 1.0
    first = begins_run(stretch)
    dt = np.where(first[1:], 0.0, np.diff(t))
    for iteration in range(1, max_iterations + 1):
        residual, model = attitude_error(t, q, theta[:3] * x + theta[3:], stretch, weight, fixed=fixed)
        if robust:
            length = np.sqrt(np.einsum("ni,ni->n", residual, residual))
            huber = huber_weights(length, robust_sigma(length))
            weight, inflation = trust * huber, huber_inflation(huber)
        if (library := compiled.LIBRARY) is not None:
            normal, gradient, square = compiled_attitude.normal_equations(
                library, t, model, x, first, weight, residual, fixed=fixed
            )
        else:
            sensitivity, centred = _centred(dt, model, x, first, weight, residual, fixed=fixed)
            normal, gradient, square = _normal_equations(sensitivity, centred, weight)
        step = np.linalg.lstsq(normal, gradient, rcond=1e-13)[0]
        theta = theta + step
        if not np.isfinite(theta).all():
            break
        # Settled: every step is a small part of the smallest standard deviation one could claim, or of the value
        # itself.
        claimed = np.sqrt(np.diagonal(np.linalg.pinv(normal, hermitian=True)) * square / (3 * n))
        if (np.abs(step) < np.maximum(0.02 * claimed, 1e-8 * float(np.max(np.abs(theta))))).all():
            sensitivity, centred = _centred(dt, model, x, first, weight, residual, fixed=fixed)
            root = np.sqrt(weight)
            white, covariance = least_squares_covariance(
                sensitivity * root[:, None, None],
                centred * root[:, None],
                nuisance=0 if fixed else 3 * int(first.sum()),
            )
            covariance *= inflation
            if not fixed:
                walk, share = random_walk(t, residual, stretch, weight)
                if walk > 0.0:
                    information = walk_information(sensitivity * weight[:, None, None], dt, first, walk)
                    inverse = np.linalg.pinv(normal, hermitian=True)
                    covariance = (1.0 - share) * covariance + inverse @ information @ inverse
            transform = from_centred(centre, x_scale)
            constants = transform @ theta
            return GyroFit(
                scale=constants[:3],
                bias=constants[3:],
                covariance=transform @ covariance @ transform.T,
                covariance_white=transform @ white @ transform.T,
                residual_rms=float(np.sqrt(np.mean(np.sum(residual**2, axis=1)))),
                n_samples=n,
                iterations=iteration,
            )
    raise EstimationError(
        ReasonCode.OUTPUT_ERROR_DIVERGED,
        "Output error found no minimum: the integrated gyroscope never came near the measured attitude.",
        {"iterations": iteration, "attitude_error_rms_rad": float(np.sqrt(np.mean(residual**2)))},
    )


def _centred(
    dt: Array, model: Array, x: Array, first: Array, weight: Array, residual: Array, *, fixed: bool
) -> tuple[Array, Array]:
    """Sensitivities (n, 3, 6) and residuals (n, 3), unless `fixed` with the initial attitudes eliminated."""
    sensitivity = attitude_sensitivity(dt, model, x, first)
    if fixed:
        return sensitivity, residual
    return without_stretch_means(sensitivity, first, weight), without_stretch_means(residual, first, weight)


def _normal_equations(sensitivity: Array, residual: Array, weight: Array) -> tuple[Array, Array, float]:
    """Normal matrix (6, 6), gradient (6,) and weighted square of the residual."""
    root = np.sqrt(weight)
    a = (sensitivity * root[:, None, None]).reshape(-1, 6)
    y = (residual * root[:, None]).reshape(-1)
    return a.T @ a, a.T @ y, float(y @ y)


def attitude_error(
    t: Array, q: Array, rate: Array, stretch: Array, weight: Array, *, fixed: bool
) -> tuple[Array, Array]:
    """r = log(q ⊗ q_model⁻¹) (n, 3), rad, inertial axes, and q_model (n, 4) for body rates (n, 3), rad/s."""
    model = start_stretches(propagate_stretches(t, rate, stretch), q, stretch, weight, fixed=fixed)
    return to_rotation_vector(multiply(q, conjugate(model))), model


def attitude_sensitivity(dt: Array, model: Array, x: Array, first: Array) -> Array:
    """∫ R_nb [diag(x), I] dτ from each stretch's start, (n, 3, 6), trapezoidal; dt (n−1,) is 0 across starts."""
    r_nb = body_from_inertial(model).transpose(0, 2, 1)
    integrand = np.concatenate([r_nb * x[:, None, :], r_nb], axis=2).reshape(len(model), 18)
    increments = np.zeros_like(integrand)
    increments[1:] = 0.5 * dt[:, None] * (integrand[1:] + integrand[:-1])
    total = np.cumsum(increments, axis=0)
    starts = np.flatnonzero(first)
    return np.asarray((total - total[starts][np.cumsum(first) - 1]).reshape(-1, 3, 6))
