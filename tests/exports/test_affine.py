"""Constants before an autopilot's correction: its affine map tells what they are, and how sure."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fieldcal.exports.autopilots.affine import angle_deg, of_raw
from fieldcal.exports.autopilots.thermal import Curve
from fieldcal.exports.calibration import Triad

RNG = np.random.default_rng(16)
QUARTER_TURN = Rotation.from_euler("zx", [90.0, 90.0], degrees=True).as_matrix()
ANY_TURN = Rotation.from_rotvec([0.3, -0.5, 0.9]).as_matrix()
DIAGONAL = np.diag([0.6, 1.7, 1.2])
SYMMETRIC = np.array([[1.3, 0.2, -0.3], [0.2, 0.7, 0.1], [-0.3, 0.1, 1.6]])
AT = 30.0


def found(**sd: np.ndarray) -> Triad:
    """Constants of logged readings."""
    return Triad(
        scale=np.eye(3) + 0.1 * RNG.normal(size=(3, 3)),
        zero=RNG.normal(size=3),
        scale_per_degc=0.01 * RNG.normal(size=(3, 3)),
        zero_per_degc=0.1 * RNG.normal(size=3),
        zero_per_degc2=0.01 * RNG.normal(size=3),
        zero_per_degc3=0.001 * RNG.normal(size=3),
        scale_sd=sd.get("scale", np.ones(3)),
        zero_sd=sd.get("zero", np.ones(3)),
        zero_per_degc_sd=sd.get("slope", np.ones(3)),
        unit="rad/s",
        logged_unit="rad/s",
        temperature_degc=AT,
        flown_degc=None,
        why=(),
    )


@pytest.mark.parametrize("compensated", [False, True])
def test_raw_readings_through_them_are_logged_ones_through_what_was_found(compensated: bool) -> None:
    """Turned back: the autopilot turns after it has corrected. logged = R S (raw − P(T)) + offset, P(T0) = 0."""
    own, matrix, offset = found(), ANY_TURN @ SYMMETRIC, RNG.normal(size=3)
    terms = RNG.normal(size=(3, 3)) * [[1e-1], [1e-2], [1e-3]]
    curve = Curve(AT, -np.inf, np.inf, terms, np.zeros(3)) if compensated else None
    raw, warm = RNG.normal(size=(20, 3)), RNG.uniform(0.0, 60.0, 20)
    moved = np.zeros((20, 3)) if curve is None else np.array([curve.at(degc) for degc in warm])
    logged = (raw - moved) @ matrix.T + offset
    wanted = own.apply(logged, warm) @ ANY_TURN
    np.testing.assert_allclose(of_raw(own, matrix, offset, curve).apply(raw, warm), wanted, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(("turn", "symmetric"), [(QUARTER_TURN, SYMMETRIC), (ANY_TURN, DIAGONAL)])
def test_the_sd_of_zeros_and_slopes_goes_through_the_inverse(turn: np.ndarray, symmetric: np.ndarray) -> None:
    """raw zero = M⁻¹ (b − o): the variance of M⁻¹ b, b with independent errors, and M⁻¹ with its elements squared."""
    matrix, zero_sd, slope_sd = turn @ symmetric, np.array([0.1, 0.2, 0.4]), np.array([0.3, 0.1, 0.7])
    own = of_raw(found(zero=zero_sd, slope=slope_sd), matrix, np.ones(3), None)
    inverse = np.linalg.inv(matrix)
    np.testing.assert_allclose(own.zero_sd**2, np.diagonal(inverse @ np.diag(zero_sd**2) @ inverse.T))
    np.testing.assert_allclose(own.zero_per_degc_sd**2, np.diagonal(inverse @ np.diag(slope_sd**2) @ inverse.T))


@pytest.mark.parametrize("turn", [QUARTER_TURN, ANY_TURN])
def test_the_sd_of_a_scale_is_that_of_the_diagonal_turned_back_and_grows_with_the_autopilots(turn: np.ndarray) -> None:
    """(Rᵀ diag(e) R)_ii = Σ_j R_ji² e_j, e independent errors; times the autopilot's factor of the axis."""
    sd = np.array([0.1, 0.2, 0.4])
    own = of_raw(found(scale=sd), turn @ DIAGONAL, np.zeros(3), None)
    variances = np.diagonal(DIAGONAL) ** 2 * sum(turn[j] ** 4 * sd[j] ** 2 for j in range(3))
    np.testing.assert_allclose(own.scale_sd**2, variances)


@pytest.mark.parametrize("axis", [*np.eye(3), [1.0, -2.0, 0.5], [-0.3, 0.4, 2.0]])
@pytest.mark.parametrize("angle", [1e-5, 30.0, 90.0, 179.0])
def test_the_angle_of_a_rotation_is_that_about_its_axis(axis: np.ndarray, angle: float) -> None:
    turn = Rotation.from_rotvec(angle * np.array(axis) / np.linalg.norm(axis), degrees=True)
    assert angle_deg(turn.as_matrix()) == pytest.approx(angle, rel=1e-9)
