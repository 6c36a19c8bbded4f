"""What a record says without what was known beforehand: the prior is taken out exactly, and nothing else."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from small_record import small

from fieldcal.estimation.joint import initialise
from fieldcal.estimation.joint.covariance import Noise
from fieldcal.estimation.joint.fit import JointFit, fit_joint
from fieldcal.estimation.joint.information import CONSTANTS, _published, observed
from fieldcal.estimation.joint.ladder import held
from fieldcal.estimation.joint.problem import TRIADS, PriorConstants, Readings, State
from fieldcal.geometry.rotation import Array
from fieldcal.simulation.experiment import SimulatedFlight, simulate

AXES = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
SCALE = {"gyroscope": (1.01, 0.99, 1.015), "accelerometer": (0.985, 1.01, 1.02), "magnetometer": (1.05, 0.97, 1.02)}
BIAS = {"gyroscope": (0.01, -0.02, 0.015), "accelerometer": (0.15, -0.2, 0.1), "magnetometer": (0.05, -0.1, 0.07)}
PRIOR_SD = {"gyroscope": (0.02, 0.03), "accelerometer": (0.02, 0.3), "magnetometer": (0.1, 0.2)}
PRIORS = {
    name: PriorConstants(np.ones(3), np.zeros(3), np.diag(np.repeat(np.square(sd), 3))) for name, sd in PRIOR_SD.items()
}
STEP = 1e-6


def flown(seed: int, turned: tuple[float, float, float]) -> SimulatedFlight:
    return simulate(
        seed=seed, duration_s=20.0, sets=1, dip_rad=1.0, translation_rms_mps2=0.1, turned=turned, scale=SCALE,
        bias=BIAS, quantisation=False, vps=False,
    )  # fmt: skip


def fitted(r: SimulatedFlight, priors: dict[str, PriorConstants]) -> JointFit:
    gyroscope, accelerometer, magnetometer = (np.asarray(r.counts[name]) for name in TRIADS)
    segment = np.zeros(len(r.t), dtype=np.int64)
    turning = initialise.turning(r.t, segment, gyroscope)
    field = np.array([np.cos(1.0), 0.0, np.sin(1.0)])
    readings = Readings(r.t, segment, gyroscope, accelerometer, magnetometer, 9.81, field, turning)
    start = {name: (priors[name].scale, priors[name].bias) for name in TRIADS}
    return fit_joint(*initialise.prepare(readings, start), priors=priors)


@pytest.fixture(scope="module")
def weak() -> JointFit:
    """A record that hardly pitches and banks, with priors."""
    return fitted(flown(1, (0.3, 0.3, 1.0)), PRIORS)


def constants(fit: JointFit) -> np.ndarray:
    return np.concatenate([np.arange(own.start, own.stop) for name, own in fit.layout.items() if name in CONSTANTS])


def test_with_the_prior_again_it_is_the_fit_s(weak: JointFit) -> None:
    """Inverse information and estimate, where neither coloured noise nor doubt enlarge anything."""
    plain = replace(weak, noise=None, doubt=np.zeros_like(weak.doubt))
    found, at = observed(plain, AXES), constants(weak)
    _, value, jacobian = _published(weak, AXES)
    back = np.linalg.inv(jacobian)
    with_prior = found.information + back.T @ weak.known[np.ix_(at, at)] @ back
    expected = jacobian @ np.linalg.inv(weak.information)[np.ix_(at, at)] @ jacobian.T
    np.testing.assert_allclose(np.linalg.inv(with_prior), expected, rtol=1e-5, atol=1e-9 * expected.max())
    step = np.linalg.solve(with_prior, found.right + back.T @ weak.pull[at])
    np.testing.assert_allclose(step / np.sqrt(np.diagonal(expected)), 0.0, atol=1e-5)
    np.testing.assert_allclose(found.reference, value)


def test_with_the_prior_again_its_sd_are_about_the_published_ones(weak: JointFit) -> None:
    """Coloured noise enlarges directions here, parameters there."""
    found, at = observed(weak, AXES), constants(weak)
    _, _, jacobian = _published(weak, AXES)
    back = np.linalg.inv(jacobian)
    covariance = np.linalg.inv(found.information + back.T @ weak.known[np.ix_(at, at)] @ back)
    published = jacobian @ weak.covariance[np.ix_(at, at)] @ jacobian.T
    ratio = np.sqrt(np.diagonal(covariance) / np.diagonal(published))
    assert 0.7 < ratio.min() < ratio.max() < 1.4


def test_another_prior_leaves_the_information_as_it_is(weak: JointFit) -> None:
    """To what the estimate moves: twice as vague, the same record says the same."""
    vague = {name: replace(prior, covariance=4.0 * prior.covariance) for name, prior in PRIORS.items()}
    one, other = observed(weak, AXES), observed(fitted(flown(1, (0.3, 0.3, 1.0)), vague), AXES)
    prior = np.concatenate([np.repeat(sd, 3) for sd in PRIOR_SD.values()])
    sds = []
    for found in (one, other):
        names = [name for name in found.names if name[1] in ("gain", "zero")]
        own = found.of(names)
        sds.append(1.0 / np.sqrt(np.diagonal(own.information)) / prior[: len(names)])
    np.testing.assert_allclose(sds[0], sds[1], rtol=0.25)


def test_held_constants_are_known_by_the_record_alone() -> None:
    """What holds them is 10¹⁰ times what was known: taken out, too."""
    priors = {**PRIORS, "accelerometer": held(PRIORS["accelerometer"])}
    found = observed(fitted(flown(2, (0.1, 0.1, 1.0)), priors), AXES)
    own = found.of([name for name in found.names if name[0] == "accelerometer" and name[1] in ("gain", "zero")])
    scale = 1.0 / np.sqrt(np.maximum(np.diagonal(own.information), 1e-300))
    value, direction = np.linalg.eigh(own.information * np.outer(scale, scale))
    # Level, gravity is one number: a gain of z and its zero are known together, not one by one.
    assert value[0] < 1e-2 * value[-1]
    truth = np.r_[1.0 / np.array(SCALE["accelerometer"]), -np.array(BIAS["accelerometer"]) / SCALE["accelerometer"]]
    seen = value > 1e-6
    left = direction[:, seen].T @ (scale * own.moved(truth).right) / np.sqrt(value[seen])
    assert np.sqrt(np.mean(left**2)) < 2.0


def test_constants_and_jacobian_by_finite_differences() -> None:
    """In a record that has every term there is."""
    flight = small(tuple(f"{name}_cross" for name in TRIADS))

    def of(theta: Array) -> Array:
        values, at = dict(flight.state.values), 0
        for name in layout:
            size = len(values[name])
            values[name] = values[name] + theta[at : at + size]
            at += size
        return _published(made(replace(flight.state, values=values)), AXES)[1]

    def made(state: State) -> JointFit:
        nothing = np.zeros((p, p))
        solution = flight.model, state, path, flight.levels, weight, layout, nothing, nothing, 1
        return JointFit(*solution, nothing, np.zeros(p), None, nothing)

    from fieldcal.estimation.joint.measurement_model import layout_of, trajectory

    layout, p = layout_of(flight.model, flight.state.values, dip=False, lever_arm=True)
    path, weight = trajectory(flight.model, flight.state), np.ones((1, 1))
    names, _, jacobian = _published(made(flight.state), AXES)
    expected = np.stack([(of(e) - of(-e)) / (2.0 * STEP) for e in STEP * np.eye(p)], axis=1)
    np.testing.assert_allclose(jacobian, expected, atol=1e-7 * np.abs(expected).max())
    assert len(names) == len(set(names)) == p
    for name in TRIADS:
        matrix, bias, _ = made(flight.state).full_constants(name)
        at = {own[1:]: k for k, own in enumerate(names) if own[0] == name}
        value = of(np.zeros(p))
        np.testing.assert_allclose([value[at["gain", a]] for a in "xyz"], 1.0 / np.diagonal(matrix))
        np.testing.assert_allclose([value[at["zero", a]] for a in "xyz"], -np.linalg.solve(matrix, bias))
        for i, a in enumerate("xyz"):
            for j, b in enumerate("xyz"):
                if ("cross", a + b) in at:
                    assert value[at["cross", a + b]] == pytest.approx(matrix[i, j] / matrix[i, i])


def test_noise_that_is_twice_the_model_s_doubles_every_sd(weak: JointFit) -> None:
    """Along each direction: `excess` 3 N makes the variance of every combination four times."""
    p = len(weak.information)
    rich = Noise(3.0 * weak.information, np.zeros((2, p)), np.array([0.0, 1.0]))
    one, other = (observed(replace(weak, noise=n, doubt=np.zeros((p, p))), AXES) for n in (None, rich))
    ratio = np.linalg.inv(one.information + 1e-12 * np.diag(np.diagonal(one.information)))
    larger = np.linalg.inv(other.information + 1e-12 * np.diag(np.diagonal(other.information)))
    found = np.diagonal(larger) / np.diagonal(ratio)
    assert found.min() > 3.9
