"""What is known beforehand: in the units in which it is said, of each unknown by itself, through the other form too."""

from __future__ import annotations

import numpy as np
import pytest

from fieldcal.estimation.by_velocity.known import known_beforehand
from fieldcal.estimation.by_velocity.problem import layout_of
from fieldcal.estimation.joint.problem import PriorConstants

VALUES = {
    "gyroscope": np.r_[np.full(3, 1.01), 0.1, 0.2, 0.3],
    "accelerometer": np.r_[np.full(3, 0.98), 1.0, 2.0, 3.0],
    "magnetometer": np.r_[np.full(3, 2.0), 4.0, 5.0, 6.0],
    "field": np.zeros(2),
    "delay": np.zeros(1),
    "drift": np.zeros(3),
    "lag": np.zeros(1),
    "smoothing": np.zeros(1),
    "arm": np.zeros(3),
}
LAYOUT = layout_of(VALUES)


@pytest.mark.parametrize(
    ("name", "value", "sd"),
    [
        ("drift", 0.0, np.radians(0.05) / 60.0),  # °/s a minute
        ("delay", 0.0, 0.05),
        ("lag", 0.12, 0.15),
        ("smoothing", 0.0, 1e-3),
        ("arm", 0.0, 0.5),
        ("field", 0.0, 0.03),
    ],
)
def test_of_receiver_and_field_as_the_documentation_has_it(name: str, value: float, sd: float) -> None:
    information, expected = known_beforehand(VALUES, LAYOUT, {}, field_known=True)
    at = LAYOUT[name]
    np.testing.assert_allclose(expected[at], value, atol=0.0)
    np.testing.assert_allclose(np.sqrt(np.diagonal(np.linalg.inv(information[at, at]))), sd, rtol=0.04)
    assert np.count_nonzero(information[at]) == at.stop - at.start


def test_where_the_place_is_not_known_its_field_points_anywhere_within_a_radian() -> None:
    information, _ = known_beforehand(VALUES, LAYOUT, {}, field_known=False)
    np.testing.assert_allclose(np.diagonal(information)[LAYOUT["field"]], 1.0 / 0.5**2)


def test_of_a_triad_without_a_prior_nothing_is_known() -> None:
    information, expected = known_beforehand(VALUES, LAYOUT, {}, field_known=True)
    for name in ("gyroscope", "accelerometer", "magnetometer"):
        assert not information[LAYOUT[name]].any()
        np.testing.assert_array_equal(expected[LAYOUT[name]], VALUES[name])


def test_priors_are_where_their_triads_are_and_a_magnetometers_in_the_form_in_which_it_is_estimated() -> None:
    """Constants drawn from the prior, each turned into gain and zero: logged = z / λ − b / λ."""
    rng = np.random.default_rng(5)
    scale, bias = np.array([2.0, 0.5, 1.5]), np.array([0.4, -0.3, 0.2])
    root = 0.004 * rng.normal(size=(6, 6))
    prior = PriorConstants(scale, bias, root @ root.T)
    priors = dict.fromkeys(("gyroscope", "magnetometer"), prior)
    information, expected = known_beforehand(VALUES, LAYOUT, priors, field_known=True)
    plain, other = LAYOUT["gyroscope"], LAYOUT["magnetometer"]
    np.testing.assert_allclose(expected[plain], np.r_[scale, bias])
    np.testing.assert_allclose(np.linalg.inv(information[plain, plain]), prior.covariance, rtol=1e-6, atol=1e-12)
    drawn = np.r_[scale, bias] + rng.normal(size=(200_000, 6)) @ root.T
    turned = np.c_[1.0 / drawn[:, :3], -drawn[:, 3:] / drawn[:, :3]]
    np.testing.assert_allclose(expected[other], turned.mean(axis=0), atol=2e-3)
    covariance = np.linalg.inv(information[other, other])
    sd = np.sqrt(np.diagonal(covariance))
    np.testing.assert_allclose(covariance / np.outer(sd, sd), np.cov(turned.T) / np.outer(sd, sd), atol=0.05)
    assert not information[plain, other].any()
    assert not information[LAYOUT["accelerometer"]].any()
