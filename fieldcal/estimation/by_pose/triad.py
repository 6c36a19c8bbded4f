"""A vector triad's constants as a trajectory shows them: a full matrix, and the form in which it is published."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from fieldcal.estimation.statistics import robust_sigma
from fieldcal.geometry.rotation import Array, skew

DIFFERENCE_SHARE = 1e-6  # of a matrix element, for the derivatives of a decomposition


@dataclass(frozen=True)
class TriadByPose:
    """Calibrated = `matrix` (3, 3) · logged + `bias` (3,), SI, axes of the trajectory.

    `covariance` (12, 12) of the matrix by rows and the bias; `delay_s` of the triad behind the trajectory's clock and
    its sd; `misfit`: rms residual over the sensed vector's length; `weight` (n,) mean robust weight of each row that
    was compared; `colour`: how many times the density of white noise the residual has at low frequency, mean of the
    axes; `lever_arm_m` (3,) from the VPS's point to the sensor and its sd, accelerometer only."""

    matrix: Array
    bias: Array
    covariance: Array
    delay_s: float
    delay_sd_s: float
    misfit: float
    weight: Array
    colour: float
    lever_arm_m: Array | None = None
    lever_arm_sd_m: Array | None = None

    def turned(self, rotation: Array, covariance: Array) -> TriadByPose:
        """The same in axes turned by `rotation` (3, 3): new = rotation · old, known to a `covariance` (3, 3) about the
        new axes, rad²."""
        big = np.kron(rotation, np.eye(3))
        turn = np.block([[big, np.zeros((9, 3))], [np.zeros((3, 9)), rotation]])
        matrix, bias = rotation @ self.matrix, rotation @ self.bias
        # A small turn φ of the axes changes the matrix by −S(φ) M: ∂/∂φ_k.
        axes = [skew(axis) for axis in np.eye(3)]
        uncertain = np.column_stack([np.r_[(-s @ matrix).ravel(), -s @ bias] for s in axes])
        return replace(
            self,
            matrix=matrix,
            bias=bias,
            covariance=turn @ self.covariance @ turn.T + uncertain @ covariance @ uncertain.T,
        )

    @property
    def diagonal_covariance(self) -> Array:
        """(6, 6) of (λx, λy, λz, bx, by, bz)."""
        at = [0, 4, 8, 9, 10, 11]
        return np.asarray(self.covariance[np.ix_(at, at)])

    @property
    def cross_sd(self) -> Array | None:
        """Standard deviations (3, 3) of the matrix where it has off-diagonal elements."""
        if np.array_equal(self.matrix, np.diag(np.diagonal(self.matrix))):
            return None
        return np.sqrt(np.maximum(np.diagonal(self.covariance)[:9], 0.0)).reshape(3, 3)

    def cross_test(self, elements: tuple[tuple[int, int], ...]) -> float:
        """Wald statistic of these off-diagonal elements."""
        at = [3 * i + j for i, j in elements]
        value = self.matrix.ravel()[at]
        return float(value @ np.linalg.lstsq(self.covariance[np.ix_(at, at)], value, rcond=1e-12)[0])

    def square(self, centre: ArrayLike, elements: tuple[tuple[int, int], ...]) -> TriadByPose:
        """The estimate given that these off-diagonal elements are zero; variances stay those without that knowledge, so
        that what the elements may be is in them. `centre` (3,): mean reading."""
        at = [3 * i + j for i, j in elements]
        # About the mean reading, where matrix and bias hardly depend on each other.
        to_centre = np.eye(12)
        to_centre[9:, :9] = np.kron(np.eye(3), np.asarray(centre, dtype=float))
        value = to_centre @ np.r_[self.matrix.ravel(), self.bias]
        covariance = to_centre @ self.covariance @ to_centre.T
        gain = np.linalg.lstsq(covariance[np.ix_(at, at)], covariance[at], rcond=1e-12)[0].T
        value = value - gain @ value[at]
        value[at] = 0.0
        back = np.linalg.inv(to_centre)
        value = back @ value
        covariance[at], covariance[:, at] = 0.0, 0.0
        matrix = value[:9].reshape(3, 3)
        # Exactly, as those that the axes make zero: rounding leaves dust.
        matrix[tuple(np.array(elements).T)] = 0.0
        matrix[self.matrix == 0.0] = 0.0
        return replace(self, matrix=matrix, bias=value[9:], covariance=back @ covariance @ back.T)


def axis_sigma(residual: Array) -> Array:
    """Robust standard deviation of each axis of residuals (n, 3), at least 1e-12."""
    return np.maximum([robust_sigma(r) for r in residual.T], 1e-12)


def body_axes(triad: TriadByPose, polarity: ArrayLike) -> tuple[TriadByPose, Array, Array]:
    """The triad in axes of its own: x axis kept, y in its plane, so that the matrix is lower triangular.

    Returns
    -------
    The triad; the rotation (3, 3) from the trajectory's axes into its own, determinant −1 where `polarity` (3,)
    contradicts the readings; its covariance (3, 3), rad², about its own axes.
    """
    sign = np.asarray(polarity, dtype=float)

    def lower(values: Array) -> tuple[Array, Array]:
        matrix, bias = values[:9].reshape(3, 3), values[9:]
        turn, upper = np.linalg.qr(matrix[:, ::-1])  # M J = Q R, so M = (Q J)(J R J)
        q, left = turn[:, ::-1], upper[::-1, ::-1]
        signs = np.where(np.sign(np.diagonal(left)) == sign, 1.0, -1.0)
        q, left = q * signs, np.tril(left * signs[:, None])  # exactly: rounding leaves dust
        return np.r_[left.ravel(), q.T @ bias], q.T

    at = np.r_[triad.matrix.ravel(), triad.bias]
    value, rotation = lower(at)
    step = DIFFERENCE_SHARE * np.maximum(np.abs(at), np.r_[np.full(9, np.abs(triad.matrix).max()), np.ones(3)])
    jacobian, turning = np.zeros((12, 12)), np.zeros((3, 12))
    for k, e in enumerate(np.diag(step)):
        (after, turned), (before, back) = lower(at + e), lower(at - e)
        jacobian[:, k] = (after - before) / (2.0 * e[k])
        slope = (turned - back) @ rotation.T / (2.0 * e[k])  # −S(φ) per unit
        turning[:, k] = slope[1, 2], slope[2, 0], slope[0, 1]
    return (
        replace(
            triad,
            matrix=value[:9].reshape(3, 3),
            bias=value[9:],
            covariance=jacobian @ triad.covariance @ jacobian.T,
        ),
        rotation,
        turning @ triad.covariance @ turning.T,
    )
