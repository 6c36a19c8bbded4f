"""The estimate by velocity: exact without noise, one fault at a time, honest, whatever the units; refusals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from outside_ci import outside_ci
from velocity_support import epochs_of, errors, fitted, priors, readings_of, short_flight, with_readings

import fieldcal.estimation.by_velocity.fit as by_velocity
import fieldcal.estimation.by_velocity.start as start
from fieldcal.errors import UnusableFlight
from fieldcal.estimation.by_velocity.fit import FEWEST_EPOCHS
from fieldcal.estimation.by_velocity.information import observed
from fieldcal.estimation.by_velocity.known import LAG_S
from fieldcal.estimation.by_velocity.problem import place_knots
from fieldcal.estimation.by_velocity.walk import walk_density
from fieldcal.geometry.rotation import angle_between

RATE_HZ = 200.0
# Without noise, of trapezoids at RATE_HZ: m/s², rad/s, relative, s, m.
EXACT = {
    "gyroscope scale": 2e-4,
    "gyroscope zero": 2e-5,
    "accelerometer scale": 2e-3,
    "accelerometer zero": 1e-2,
    "magnetometer scale": 5e-4,
    "magnetometer zero": 5e-4,
    "lag": 1e-3,
    "arm": 3e-3,
}
HONEST = (0.8, 1.2)


def test_without_noise_the_truth_is_found() -> None:
    flight = short_flight("lively", 2, noise=False, rate_hz=RATE_HZ, duration_s=25.0)
    found = errors(flight, fitted(flight, known=priors(wide=30.0)))
    assert {
        name: float(np.max(np.abs(error))) for name, (error, _) in found.items() if np.max(np.abs(error)) > EXACT[name]
    } == {}


@pytest.mark.parametrize(
    ("triad", "fault", "moves"),
    [
        ("gyroscope", np.array([0.01, 0.0, 0.0]), "gyroscope zero"),
        ("accelerometer", np.array([0.0, 0.1, 0.0]), "accelerometer zero"),
        ("magnetometer", np.array([0.0, 0.0, 0.05]), "magnetometer zero"),
    ],
)
def test_one_fault_moves_one_constant(triad: str, fault: np.ndarray, moves: str) -> None:
    flight = short_flight("lively", 4)
    before = errors(flight, fitted(flight, known=priors(wide=10.0)))
    faulty = with_readings(flight, **{triad: flight.counts[triad] + fault})
    after = errors(flight, fitted(flight, faulty, priors(wide=10.0)))
    for name, (error, sd) in after.items():
        moved = error - before[name][0]
        expected = fault if name == moves else 0.0
        assert np.all(np.abs(moved - expected) < 0.3 * sd + 0.02 * np.abs(fault).max()), name


def _ratios(motion: str, seeds: range, **changes: object) -> dict[str, np.ndarray]:
    found = [errors(flight, fitted(flight)) for flight in (short_flight(motion, seed, **changes) for seed in seeds)]
    return {name: np.array([own[name][0] / own[name][1] for own in found]) for name in found[0]}


def test_errors_are_as_large_as_the_sd_say() -> None:
    ratios = _ratios("lively", range(16))
    # Level scales of the accelerometer are little more than what was known of them.
    told = [r.ravel() for name, r in ratios.items() if name != "accelerometer scale"]
    assert HONEST[0] < np.sqrt(np.mean(np.concatenate(told) ** 2)) < HONEST[1]
    assert np.max(np.abs(np.concatenate(told))) < 4.5


@outside_ci
@pytest.mark.parametrize("motion", ["lively", "mission", "fixed_wing"])
@pytest.mark.parametrize("changes", [{}, {"gnss_colour": 0.7}, {"gnss_outlier_share": 0.03}])
def test_sd_are_honest_in_every_flight(motion: str, changes: dict[str, object]) -> None:
    full = {"duration_s": 120.0, "rate_hz": 100.0, **changes}
    for name, r in _ratios(motion, range(40), **full).items():
        if name in ("gyroscope scale", "gyroscope zero", "magnetometer zero", "lag", "arm"):
            assert 0.7 < np.sqrt(np.mean(r**2)) < 1.3, name


def test_a_noisy_gyroscope_keeps_its_scale() -> None:
    noise = {"magnetometer": 34e-6, "accelerometer": 2.5e-3, "gyroscope": 0.004}
    ratio = _ratios("mission", range(6), noise_variance=noise, duration_s=80.0)["gyroscope scale"]
    assert abs(ratio.mean()) < 1.0


def test_units_origin_and_axes_do_not_matter() -> None:
    flight = short_flight("lively", 6)
    plain = fitted(flight)
    units = {"gyroscope": 180.0 / np.pi, "accelerometer": 1.0 / 9.80665, "magnetometer": 0.5}
    other = fitted(
        flight,
        with_readings(flight, **{name: flight.counts[name] * factor for name, factor in units.items()}),
        priors(units=units),
    )
    for name, factor in units.items():
        (scale, bias, _), (own, own_bias, _) = plain.constants(name), other.constants(name)
        assert np.allclose(own * factor, scale, rtol=1e-6)
        assert np.allclose(own_bias, bias, atol=1e-7)
    late = replace(flight, t=flight.t + 1000.0, gnss_t=flight.gnss_t + 1000.0)
    assert np.allclose(fitted(late).constants("gyroscope")[0], plain.constants("gyroscope")[0], rtol=1e-7)
    cycle = [1, 2, 0]
    turned = with_readings(flight, **{name: x[:, cycle] for name, x in flight.counts.items()})
    found = fitted(flight, turned)
    for name in units:
        assert np.allclose(found.constants(name)[0], plain.constants(name)[0][cycle], atol=2e-5)
    assert np.allclose(found.state.values["arm"], plain.state.values["arm"][cycle], atol=1e-3)


def test_outliers_change_nothing_much() -> None:
    flight = short_flight("lively", 7)
    wrong = flight.gnss_velocity.copy()
    wrong[::25] += 8.0
    of_spoilt = fitted(replace(flight, gnss_velocity=wrong))
    clean, spoilt = errors(flight, fitted(flight)), errors(flight, of_spoilt)
    for name, (error, sd) in clean.items():
        assert np.all(np.abs(spoilt[name][0] - error) < sd), name
    outlier = of_spoilt.weight < 0.1
    np.testing.assert_allclose(of_spoilt.residual[outlier], 8.0, atol=1.5)
    np.testing.assert_array_equal(of_spoilt.t[outlier], np.intersect1d(flight.gnss_t[::25], of_spoilt.t))


def test_what_clipped_residuals_and_blocks_of_time_tell_is_in_every_sd(monkeypatch: pytest.MonkeyPatch) -> None:
    """By the factors that `huber_inflation` and `wider` have, which are tested by themselves."""
    flight = short_flight("lively", 7)
    fits = []
    for inflation, factor in ((1.0, 1.0), (4.0, 1.0), (1.0, 3.0), (4.0, 3.0)):
        monkeypatch.setattr(by_velocity, "huber_inflation", lambda weights, inflation=inflation: inflation)
        monkeypatch.setattr(
            by_velocity, "wider", lambda rows, *rest, factor=factor: factor * np.ones(rows[0].theta.shape[2])
        )
        fits.append(fitted(flight))
    for fit, by in zip(fits[1:], (2.0, 3.0, 6.0), strict=True):
        assert np.allclose(fit.covariance, by**2 * fits[0].covariance, rtol=1e-9)
        assert np.allclose(fit.information, fits[0].information / by**2, rtol=1e-9)
        assert np.allclose(fit.pull, fits[0].pull / by, rtol=1e-9)


def test_another_way_down_ends_at_the_same_minimum(monkeypatch: pytest.MonkeyPatch) -> None:
    """Steps of the levels that are longer or shorter, a start that trusts the walks less or looks further about a knot,
    an end that is nearer."""
    flight = short_flight("lively", 7)
    plain = errors(flight, fitted(flight))
    ways: tuple[dict[str, float], ...] = (
        {"DAMPING": 0.75},
        {"START_RATIO": 100.0},
        {"ROUGH_ITERATIONS": 8},
        {"UNDAMPED_ITERATIONS": 4},
        {"CONVERGED_SD": 0.003, "CONVERGED_LEVEL": 0.003},
        {"WINDOW_S": 8.0, "VELOCITY_SD_MPS": 0.4},
    )
    for changed in ways:
        with monkeypatch.context() as patch:
            for name, value in changed.items():
                patch.setattr(by_velocity if hasattr(by_velocity, name) else start, name, value)
            for name, (error, sd) in errors(flight, fitted(flight)).items():
                assert np.all(np.abs(error - plain[name][0]) < 0.1 * sd), (changed, name)
                assert np.allclose(sd, plain[name][1], rtol=0.05)


@pytest.mark.parametrize("still", [False, True])
def test_no_walk_is_less_than_its_triads_noise_makes_and_no_receiver_better_than_it_is_rounded(
    monkeypatch: pytest.MonkeyPatch, still: bool
) -> None:
    """Of readings that do not change at all a walk is 1e-10 rad²/s and 1e-8 (m/s)²/s."""
    flight = short_flight("lively", 7)
    readings = readings_of(flight)
    if still:
        readings = replace(
            readings,
            gyroscope=np.zeros((len(flight.t), 3)),
            accelerometer=np.tile([0.0, 0.0, flight.experiment.gravity_mps2], (len(flight.t), 1)),
        )
    seen = []

    def told(*arguments: object) -> None:
        seen.append(arguments[1])
        raise RuntimeError

    monkeypatch.setattr(by_velocity, "renewed", told)
    with pytest.raises(RuntimeError):
        fitted(flight, readings)
    walks = [walk_density(readings, x, np.ones(3)) for x in (readings.gyroscope, readings.accelerometer)]
    rounded = (0.02 / np.median(flight.gnss_sd)) ** 2
    np.testing.assert_allclose(seen[0], [*([1e-10, 1e-8] if still else walks), rounded, rounded, 0.0], rtol=1e-12)


def test_attitude_is_that_of_the_flight() -> None:
    flight = short_flight("mission", 8)
    fit = fitted(flight)
    assert np.degrees(np.sqrt(np.mean(angle_between(fit.attitude(readings_of(flight)), flight.q) ** 2))) < 0.5


def test_without_a_magnetometer_a_lively_flight_still_tells_the_rest() -> None:
    flight = short_flight("lively", 9)
    found = errors(flight, fitted(flight, with_readings(flight, magnetometer=None)))
    assert "magnetometer scale" not in found
    for error, sd in found.values():
        assert np.all(np.abs(error) < 4.0 * sd)


def _of_gains(scale: np.ndarray, bias: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Covariance of gains and zeros."""
    by_scale = np.vstack([np.diag(-1.0 / scale**2), np.diag(bias / scale**2)])
    jacobian = np.hstack([by_scale, np.vstack([np.zeros((3, 3)), np.diag(-1.0 / scale)])])
    return np.asarray(jacobian @ covariance @ jacobian.T)


def test_information_is_the_estimate_less_what_was_known() -> None:
    flight, known = short_flight("lively", 10), priors()
    fit = fitted(flight, known=known)
    found = observed(fit)
    total, expected = found.information.copy(), np.zeros(len(found.names))
    for name, prior in known.items():
        at = [k for k, parameter in enumerate(found.names) if parameter[0] == name]
        scale, bias, covariance = fit.constants(name)
        total[np.ix_(at, at)] += np.linalg.inv(_of_gains(prior.scale, prior.bias, prior.covariance))
        expected[at] = np.sqrt(np.diagonal(_of_gains(scale, bias, covariance)))
    # With the prior put back, in gains and zeros, it is the estimate again.
    assert np.allclose(np.sqrt(np.diagonal(np.linalg.inv(total))), expected, rtol=0.05)
    # And there the record pulls as far away from the prior as the prior pulls back.
    pull = found.right.copy()
    for name, prior in known.items():
        at = [k for k, parameter in enumerate(found.names) if parameter[0] == name]
        information = np.linalg.inv(_of_gains(prior.scale, prior.bias, prior.covariance))
        gain_and_zero = np.r_[1.0 / prior.scale, -prior.bias / prior.scale]
        pull[at] += information @ (gain_and_zero - found.reference[at])
    assert np.all(np.abs(np.linalg.solve(total, pull)) < 0.1 * expected)


def test_a_short_record_is_refused() -> None:
    flight = short_flight("lively", 11, duration_s=8.0)
    with pytest.raises(UnusableFlight) as error:
        fitted(flight)
    assert error.value.reason_code == "velocity_too_short"
    assert len(epochs_of(flight).t) < FEWEST_EPOCHS


@pytest.mark.parametrize(("epochs", "taken"), [(49, False), (50, True)])
def test_it_takes_fifty_epochs_among_the_readings(epochs: int, taken: bool) -> None:
    flight = short_flight("lively", 7)
    placed = place_knots(readings_of(flight), epochs_of(flight)).epoch
    last = placed[placed >= 0][epochs - 1] + 1  # those before the first reading at the longest lag are not counted
    short = replace(
        flight, gnss_t=flight.gnss_t[:last], gnss_velocity=flight.gnss_velocity[:last], gnss_sd=flight.gnss_sd[:last]
    )
    if taken:
        assert len(fitted(short).t) == epochs
    else:
        with pytest.raises(UnusableFlight):
            fitted(short)


@pytest.mark.parametrize(("readings", "taken"), [(19, False), (20, True)])
def test_a_magnetometer_takes_part_with_twenty_readings(readings: int, taken: bool) -> None:
    flight = short_flight("lively", 11)
    few = np.full((len(flight.t), 3), np.nan)
    at = np.linspace(200, len(flight.t) - 200, readings).astype(int)
    few[at] = flight.counts["magnetometer"][at]
    fit = fitted(flight, with_readings(flight, magnetometer=few))
    assert ("magnetometer" in fit.layout) == taken
    assert fit.setting.lit.sum() == (readings if taken else 0)
    assert taken or fit.field_weight == 1.0


@pytest.mark.parametrize("seed", range(20, 25))
def test_readings_count_in_the_interval_that_the_lag_found_puts_them_in(seed: int) -> None:
    flight = short_flight("lively", seed)
    # Once a second, between where an epoch is at the lag of the start and where it is at the true one.
    at = np.searchsorted(flight.t, flight.gnss_t[5:-5:5] - 0.5 * (LAG_S + flight.gnss_lag_s))
    slow = np.full((len(flight.t), 3), np.nan)
    slow[at] = flight.counts["magnetometer"][at]
    fit = fitted(flight, with_readings(flight, magnetometer=slow))
    ends = fit.setting.knots.offset - fit.state.lag_s
    assert np.flatnonzero(fit.setting.lit) == pytest.approx(np.searchsorted(ends, flight.t[at]) - 1)
    found = errors(flight, fit)
    assert all(np.all(np.abs(error) < 4.0 * sd) for error, sd in found.values())
    assert np.all(found["magnetometer scale"][1] < 0.02)


def test_hover_tells_no_scale_of_an_accelerometer() -> None:
    flight = short_flight("hover", 12)
    _, sd = errors(flight, fitted(flight))["accelerometer scale"]
    assert np.all(sd > 0.015)
