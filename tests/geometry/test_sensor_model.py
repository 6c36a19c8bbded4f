"""Sensor model, axes and lever arm against the kinematics of a point on a turning body."""

from __future__ import annotations

import numpy as np
import pytest
from numerics_support import ROUNDING, constants, directions, logged
from scipy.spatial.transform import Rotation

from fieldcal.geometry import sensor_model
from fieldcal.simulation.experiment import Experiment, Motion, simulate

STEP_S = 1e-3
ARM_M = (0.05, 0.02, -0.03)
FINITE_DIFFERENCE_MPS2 = 1e-3  # of a second difference over 2 ms: r ω⁗ Δt²/12 and rounding


def test_sensor_model_inverts_the_logged_readings() -> None:
    scale, bias = constants("accelerometer")
    z = 9.81 * directions(np.random.default_rng(0), 100)
    np.testing.assert_allclose(sensor_model.calibrate(logged(z, scale, bias), scale, bias), z, atol=ROUNDING)
    np.testing.assert_allclose(sensor_model.calibrate(logged(z, scale, bias), np.diag(scale), bias), z, atol=ROUNDING)


def test_cross_axis_scale_mixes_by_rows() -> None:
    full = np.array([[1.0, 0.1, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    np.testing.assert_array_equal(sensor_model.calibrate([[0.0, 2.0, 0.0]], full, np.zeros(3)), [[0.2, 2.0, 0.0]])


def test_flu_and_mounting_reach_nose_starboard_underside() -> None:
    mounting = Rotation.from_euler("z", 90, degrees=True).as_matrix()
    forward = mounting.T @ [1.0, 0.0, 0.0]
    np.testing.assert_allclose(sensor_model.frd_from_sensor(mounting, "flu") @ forward, [1, 0, 0], atol=ROUNDING)
    left_up = mounting.T @ [0.0, 1.0, 1.0]
    np.testing.assert_allclose(sensor_model.frd_from_sensor(mounting, "flu") @ left_up, [0, -1, -1], atol=ROUNDING)
    np.testing.assert_array_equal(sensor_model.frd_from_sensor(mounting, "frd"), mounting)
    with pytest.raises(ValueError, match="body"):
        sensor_model.frd_from_sensor(mounting, "nwu")


def test_lever_arm_is_the_second_derivative_of_the_sensors_place() -> None:
    motion = Motion(Experiment(seed=3), np.random.default_rng(3))
    t = np.arange(8.0, 30.0, 0.01)
    arm = np.array(ARM_M)

    def place(at: np.ndarray) -> np.ndarray:
        return Rotation.from_quat(motion.attitude(at)).apply(arm)

    inertial = (place(t + STEP_S) - 2 * place(t) + place(t - STEP_S)) / STEP_S**2
    expected = Rotation.from_quat(motion.attitude(t)).inv().apply(inertial)
    computed = sensor_model.lever_arm_acceleration(motion.rate(t), motion.rate_dot(t), arm)
    assert np.abs(expected).max() > 100 * FINITE_DIFFERENCE_MPS2
    np.testing.assert_allclose(computed, expected, atol=FINITE_DIFFERENCE_MPS2)


def test_lever_arm_is_equation_3() -> None:
    rng = np.random.default_rng(4)
    w, w_dot, r = rng.normal(size=3), rng.normal(size=3), rng.normal(size=3)
    s = np.array([[0, -w_dot[2], w_dot[1]], [w_dot[2], 0, -w_dot[0]], [-w_dot[1], w_dot[0], 0]])
    bracket = w @ w * np.eye(3) - np.outer(w, w) - s
    np.testing.assert_allclose(sensor_model.lever_arm_acceleration([w], [w_dot], r)[0], -bracket @ r, atol=ROUNDING)


@pytest.mark.parametrize(("gravity_sign", "sign"), [("gravity", 1.0), ("specific_force", -1.0)])
@pytest.mark.parametrize("full", [False, True])
def test_readings_moved_to_the_centre_of_mass(gravity_sign: str, sign: float, full: bool) -> None:
    """A simulated flight with the sensor off-centre, corrected, is the flight with it in the centre."""
    clean = {"noise": False, "quantisation": False, "band_limit": False, "vps": False, "duration_s": 20.0}
    off, centred = simulate(seed=1, lever_arm_m=ARM_M, **clean), simulate(seed=1, **clean)
    scale, bias = constants("accelerometer")
    mounting = Rotation.from_euler("xyz", [20, -10, 70], degrees=True).as_matrix()
    # the same flight read by a triad turned by R_BS, and of the other sign convention
    read_off, read_centred = (
        logged(sign * sensor_model.calibrate(r.counts["accelerometer"], scale, bias) @ mounting, scale, bias)
        for r in (off, centred)
    )
    motion = Motion(off.experiment, np.random.default_rng(np.random.SeedSequence(1).spawn(6)[0]))
    arm = sensor_model.lever_arm_acceleration(off.rate, motion.rate_dot(off.t), ARM_M)
    known = np.diag(scale) if full else scale
    moved = sensor_model.to_centre_of_mass(read_off, known, arm, mounting, gravity_sign)
    assert np.abs((read_off - read_centred) * scale).max() > 0.1
    np.testing.assert_allclose((moved - read_centred) * scale, 0.0, atol=1e-9)


def test_reference_reading_by_the_kind_of_word() -> None:
    rng = np.random.default_rng(5)
    unsigned, signed = rng.integers(30000, 36000, (50, 3)), rng.integers(-5000, 30000, (50, 3))
    np.testing.assert_array_equal(sensor_model.default_reference_reading(unsigned, "counts"), [32768.0] * 3)
    np.testing.assert_array_equal(sensor_model.default_reference_reading(signed, "counts"), [0.0] * 3)
    np.testing.assert_array_equal(sensor_model.default_reference_reading(unsigned, "g"), [0.0] * 3)


@pytest.mark.parametrize(
    ("least", "median", "reference"), [(0, 16385, 32768.0), (0, 16384, 0.0), (-1, 16385, 0.0), (1, 20000, 32768.0)]
)
def test_words_that_are_never_negative_and_of_which_half_are_above_a_quarter_are_unsigned(
    least: int, median: int, reference: float
) -> None:
    logged = np.array([[least] * 3, [median] * 3, [30000] * 3])
    np.testing.assert_array_equal(sensor_model.default_reference_reading(logged, "counts"), [reference] * 3)
