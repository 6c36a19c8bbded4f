"""Attitude from vectors: QUEST against SciPy and the other solvers, its covariance and fit statistic over seeds."""

from __future__ import annotations

import numpy as np
import pytest
from numerics_support import AXES, MICRODEGREE_RAD, angle, directions, random_attitudes, rms
from scipy.spatial.transform import Rotation

from fieldcal.estimation.wahba import (
    METHODS,
    attitude_covariance,
    attitudes,
    nearest_rotation,
    rotate_reference,
    rotation_between,
)
from fieldcal.geometry.rotation import conjugate, from_euler, from_rotation_vector, multiply, to_rotation_vector

DOWN = np.array([0.0, 0.0, 1.0])
DIP_RAD = np.radians(65.0)
REFERENCES = {
    "orthogonal": np.array([[1.0, 0.0, 0.0], DOWN]),
    "65° dip": np.array([[np.cos(DIP_RAD), 0.0, np.sin(DIP_RAD)], DOWN]),
    "87° dip": np.array([[np.cos(np.radians(87.0)), 0.0, np.sin(np.radians(87.0))], DOWN]),
    "three vectors": np.array([[1.0, 0.0, 0.0], [0.6, 0.0, 0.8], [0.0, -1.0, 0.2]]),
}
SIGMA = np.array([0.006, 0.004, 0.01])
HONEST = (0.9, 1.1)
MANY = 20_000
SEVERAL_REFERENCES = pytest.mark.parametrize("references", sorted(REFERENCES))


def sensed(q: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """What perfect sensors see, (n, k, 3), by SciPy."""
    return np.stack([Rotation.from_quat(q).inv().apply(r) for r in reference], axis=1)


def tilted(rng: np.random.Generator, vectors: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    """Unit vectors (n, k, 3) turned by white noise of sigma (k,) rad about every axis across them."""
    unit = vectors / np.linalg.norm(vectors, axis=2, keepdims=True)
    noise = sigma[: vectors.shape[1], None] * rng.normal(size=vectors.shape)
    noisy = unit + noise - unit * np.sum(noise * unit, axis=2, keepdims=True)
    return noisy / np.linalg.norm(noisy, axis=2, keepdims=True)


@SEVERAL_REFERENCES
@pytest.mark.parametrize("method", sorted(METHODS))
def test_exact_on_random_attitudes(method: str, references: str) -> None:
    reference = REFERENCES[references]
    q = random_attitudes(np.random.default_rng(0), MANY if method == "quest" else 2000)
    found = attitudes(sensed(q, reference), reference, SIGMA[: len(reference)], method=method)
    assert angle(found.q, q).max() < MICRODEGREE_RAD
    assert (np.sum(found.q[1:] * found.q[:-1], axis=1) >= 0).all()


@SEVERAL_REFERENCES
@pytest.mark.parametrize("method", sorted(METHODS))
def test_exact_at_and_near_180_degrees(method: str, references: str) -> None:
    """About each axis, about the references themselves and about everything else; with 1e-9 … 1 rad more."""
    reference = REFERENCES[references]
    axes = np.vstack([AXES, -AXES, reference / np.linalg.norm(reference, axis=1, keepdims=True)])
    axes = np.vstack([axes, directions(np.random.default_rng(1), 200)])
    for excess in (0.0, 1e-9, -1e-9, 1e-6, -1e-4, 0.01, 1.0):
        q = from_rotation_vector((np.pi + excess) * axes)
        found = attitudes(sensed(q, reference), reference, SIGMA[: len(reference)], method=method)
        assert angle(found.q, q).max() < MICRODEGREE_RAD


@pytest.mark.parametrize("turned_deg", [0.0, 90.0, 120.0])
def test_exact_where_the_papers_matrix_is_singular(turned_deg: float) -> None:
    """S is singular at common attitudes (level, facing any way): never inverted here."""
    q = from_euler(np.radians(np.c_[np.zeros((3, 2)), turned_deg + np.array([0.0, 1e-7, -1e-7])]))
    for reference in REFERENCES.values():
        found = attitudes(sensed(q, reference), reference, SIGMA[: len(reference)])
        assert angle(found.q, q).max() < MICRODEGREE_RAD


@SEVERAL_REFERENCES
@pytest.mark.parametrize("method", ["quest", "davenport", "svd"])
def test_with_noise_and_weights_it_is_scipys_align_vectors(method: str, references: str) -> None:
    """Wahba's problem has one answer. 3° of noise, weights 1/σ² of 1 to 6."""
    reference = REFERENCES[references]
    k, rng = len(reference), np.random.default_rng(2)
    sigma = np.array([0.05, 0.02, 0.03])[:k]
    q = random_attitudes(rng, 150)
    observed = tilted(rng, sensed(q, reference), sigma) * rng.uniform(0.5, 2.0, (150, k, 1))  # lengths do not matter
    found = attitudes(observed, reference, sigma, method=method).q
    unit = observed / np.linalg.norm(observed, axis=2, keepdims=True)
    normal = reference / np.linalg.norm(reference, axis=1, keepdims=True)
    expected = np.array([Rotation.align_vectors(normal, b, weights=1 / sigma**2)[0].as_quat() for b in unit])
    assert angle(found, expected).max() < MICRODEGREE_RAD


def test_same_as_davenport_and_svd_on_many() -> None:
    rng = np.random.default_rng(3)
    reference = REFERENCES["65° dip"]
    sigma = np.array([0.1, 0.02])
    observed = tilted(rng, sensed(random_attitudes(rng, MANY), reference), sigma)
    found = {method: attitudes(observed, reference, sigma, method=method) for method in ("quest", "davenport", "svd")}
    for other in ("davenport", "svd"):
        assert angle(found["quest"].q, found[other].q).max() < MICRODEGREE_RAD
        np.testing.assert_allclose(found["quest"].taste, found[other].taste, atol=1e-6)


def test_triad_trusts_the_heavier_vector() -> None:
    rng = np.random.default_rng(4)
    reference = REFERENCES["orthogonal"]
    observed = tilted(rng, sensed(random_attitudes(rng, 500), reference), np.array([0.05, 0.05]))
    for heavy, sigma in ((0, [0.01, 0.05]), (1, [0.05, 0.01])):
        q = attitudes(observed, reference, sigma, method="triad").q
        np.testing.assert_allclose(rotate_reference(q, reference[heavy]), observed[:, heavy], atol=1e-12)


def test_order_and_unit_of_vectors_and_number_of_samples_do_not_matter() -> None:
    rng = np.random.default_rng(5)
    reference = REFERENCES["65° dip"]
    observed = tilted(rng, sensed(random_attitudes(rng, 9000), reference), SIGMA)
    whole = attitudes(observed, reference, SIGMA[:2])
    swapped = attitudes(9.81 * observed[:, ::-1], 50e-6 * reference[::-1], SIGMA[1::-1])
    assert angle(whole.q, swapped.q).max() < MICRODEGREE_RAD
    np.testing.assert_allclose(swapped.taste, whole.taste, atol=1e-6)
    part = attitudes(observed[4000:5000], reference, SIGMA[:2])
    np.testing.assert_allclose(np.abs(part.q), np.abs(whole.q[4000:5000]), atol=1e-14)


@SEVERAL_REFERENCES
def test_covariance_is_honest(references: str) -> None:
    """Error ÷ sd over 20 000 samples: each component whitened by P, and the claimed total √tr P."""
    reference = REFERENCES[references]
    rng, sigma = np.random.default_rng(6), SIGMA[: len(reference)]
    q = random_attitudes(rng, MANY)
    observed = tilted(rng, sensed(q, reference), sigma)
    found = attitudes(observed, reference, sigma)
    error = to_rotation_vector(multiply(conjugate(q), found.q))
    covariance = attitude_covariance(observed, sigma)
    whitened = np.linalg.solve(np.linalg.cholesky(covariance), error[:, :, None])[:, :, 0]
    for component in whitened.T:
        assert HONEST[0] < rms(component) < HONEST[1]
    assert HONEST[0] < rms(np.linalg.norm(error, axis=1) / found.sd) < HONEST[1]
    np.testing.assert_allclose(found.sd, np.sqrt(np.trace(covariance, axis1=1, axis2=2)), rtol=1e-6)


@pytest.mark.parametrize(("references", "degrees_of_freedom"), [("65° dip", 1), ("three vectors", 3)])
def test_taste_is_chi_squared(references: str, degrees_of_freedom: int) -> None:
    """2k − 3 degrees of freedom: mean k', variance 2k' (four sigma of 20 000 samples)."""
    reference = REFERENCES[references]
    rng, sigma = np.random.default_rng(7), SIGMA[: len(reference)]
    observed = tilted(rng, sensed(random_attitudes(rng, MANY), reference), sigma)
    taste = attitudes(observed, reference, sigma).taste
    assert taste.mean() == pytest.approx(degrees_of_freedom, abs=4 * np.sqrt(2 * degrees_of_freedom / MANY))
    assert taste.var() == pytest.approx(2 * degrees_of_freedom, rel=0.15)


def test_taste_sees_a_wrong_angle_between_the_vectors_not_the_heading() -> None:
    reference = REFERENCES["65° dip"]
    rng = np.random.default_rng(8)
    q = random_attitudes(rng, 1000)
    observed = tilted(rng, sensed(q, reference), SIGMA)
    dipped = np.array([[np.cos(DIP_RAD + 0.1), 0.0, np.sin(DIP_RAD + 0.1)], DOWN])
    disturbed = tilted(rng, sensed(q, dipped), SIGMA)
    turned = multiply(from_euler([0.0, 0.0, 0.3]), q)  # another heading, same everything else
    healthy = np.percentile(attitudes(observed, reference, SIGMA[:2]).taste, 99.9)
    assert (attitudes(disturbed, reference, SIGMA[:2]).taste > healthy).all()
    assert np.mean(attitudes(tilted(rng, sensed(turned, reference), SIGMA), reference, SIGMA[:2]).taste) < 1.3


def test_taste_is_the_least_weighted_misfit() -> None:
    rng = np.random.default_rng(9)
    reference = REFERENCES["65° dip"]
    observed = tilted(rng, sensed(random_attitudes(rng, 500), reference), SIGMA)
    best = attitudes(observed, reference, SIGMA[:2])
    assert (attitudes(observed, reference, SIGMA[:2], method="triad").taste >= best.taste - 1e-9).all()
    misfit = observed - sensed(best.q, reference)
    expected = np.sum(np.sum(misfit**2, axis=2) / SIGMA[:2] ** 2, axis=1)
    np.testing.assert_allclose(best.taste, expected, atol=1e-6)


@pytest.mark.parametrize("declination", [0.0, 0.2])
def test_euler_is_good_at_small_angles(declination: float) -> None:
    """Eq. 2 and 4 neglect the product of tilt angles: the error grows with the square of the angles."""
    reference = np.array([[np.cos(declination), np.sin(declination), 0.0], DOWN])
    worst = []
    for largest_deg in (1.0, 2.0, 4.0):
        tilt = np.radians(largest_deg) * np.random.default_rng(10).uniform(-1, 1, (2000, 2))
        heading = np.random.default_rng(11).uniform(-np.pi, np.pi, (2000, 1))
        q = from_euler(np.hstack([tilt, heading]))
        found = attitudes(sensed(q, reference), reference, SIGMA[:2], method="euler", declination=declination).q
        worst.append(angle(found, q).max())
    assert worst[0] < np.radians(1.0) ** 2
    np.testing.assert_allclose([worst[1] / worst[0], worst[2] / worst[1]], 4.0, rtol=0.1)


def test_euler_is_exact_without_tilt_and_in_one_plane() -> None:
    reference = REFERENCES["orthogonal"]
    heading = np.random.default_rng(12).uniform(-np.pi, np.pi, 200)
    bank = np.random.default_rng(13).uniform(-1.4, 1.4, 200)
    for angles in (
        np.stack([0 * heading, 0 * heading, heading], axis=1),
        np.stack([bank, 0 * bank, 0 * bank], axis=1),
        np.stack([0 * bank, bank, 0 * bank], axis=1),
    ):
        q = from_euler(angles)
        assert angle(attitudes(sensed(q, reference), reference, SIGMA[:2], method="euler").q, q).max() < 1e-7


def test_rotate_reference_is_scipys() -> None:
    rng = np.random.default_rng(14)
    q, r = random_attitudes(rng, 300), rng.normal(size=3)
    np.testing.assert_allclose(rotate_reference(q, r), Rotation.from_quat(q).inv().apply(r), atol=1e-12)


@pytest.mark.parametrize("method", [*sorted(METHODS), "euler"])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_collinear_references_are_refused(method: str, sign: float) -> None:
    with pytest.raises(ValueError, match="collinear"):
        attitudes(np.ones((5, 2, 3)), [[0.0, 0.0, sign * 3.0], DOWN], SIGMA[:2], method=method)


def test_callers_errors() -> None:
    reference, observed = REFERENCES["orthogonal"], np.ones((5, 2, 3))
    for given, said in (
        ((observed[:, :1], reference[:1], SIGMA[:1]), "k ≥ 2"),
        ((observed, REFERENCES["three vectors"], SIGMA[:2]), "reference must be"),
        ((observed, reference, [0.1, 0.0]), "positive"),
        ((observed, reference, SIGMA), "positive"),
    ):
        with pytest.raises(ValueError, match=said):
            attitudes(*given)
    with pytest.raises(ValueError, match="quest"):
        attitudes(observed, reference, SIGMA[:2], method="flae")


def test_rotation_between_is_scipys() -> None:
    rng = np.random.default_rng(10)
    a = directions(rng, 50)
    true = Rotation.from_quat(random_attitudes(rng, 1)[0])
    b = true.apply(a) + 0.05 * rng.normal(size=a.shape)
    np.testing.assert_allclose(rotation_between(a, b), Rotation.align_vectors(b, a)[0].as_matrix(), atol=1e-7)


def test_rotation_between_never_mirrors() -> None:
    a = directions(np.random.default_rng(10), 50)
    found = rotation_between(a, -a)
    np.testing.assert_allclose(found @ found.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(found) == pytest.approx(1.0)


def test_nearest_rotations_of_a_stack_are_scipys() -> None:
    rng = np.random.default_rng(11)
    a, weight = directions(rng, 6), rng.uniform(0.1, 2.0, 6)
    true = Rotation.from_quat(random_attitudes(rng, 30))
    b = np.stack([turn.apply(a) for turn in true]) + 0.05 * rng.normal(size=(30, 6, 3))
    found = nearest_rotation(np.einsum("k,nki,kj->nij", weight, b, a))
    expected = [Rotation.align_vectors(one, a, weights=weight)[0].as_matrix() for one in b]
    np.testing.assert_allclose(found, expected, atol=1e-7)
