"""The smoother in information form against least squares on all states at once."""

from __future__ import annotations

import numpy as np
import pytest

from fieldcal.estimation.pooled.chain import Chain, Known
from fieldcal.geometry.rotation import Array

RTOL = 1e-6
D, M = 4, 6
WALK = np.array([0.3, 0.0, 0.05, 1.0])
DAY = np.cumsum([0.0, 1.0, 3.0, 0.5, 2.0, 7.0])


def told(seed: int, rows: int) -> list[tuple[Array, Array]]:
    """Observations (H, y) of unit variance of each session's state."""
    rng = np.random.default_rng(seed)
    return [(rng.normal(size=(rows, D)), rng.normal(size=rows)) for _ in range(M)]


def known(h: Array, y: Array) -> Known:
    return Known(h.T @ h, h.T @ y)


def all_at_once(
    observed: list[tuple[Array, Array]], days: Array, prior: Array, jump: Array | None = None
) -> tuple[Array, Array]:
    """States (k, D) at `days` and their covariances, by one least-squares problem; sessions are at DAY, `jump` (M − 1,
    D) is between them."""
    rows, right = [], []
    n = len(days) * D
    for k, day in enumerate(days):
        for (h, y), at in zip(observed, DAY, strict=True):
            if at == day:
                block = np.zeros((len(y), n))
                block[:, k * D : (k + 1) * D] = h
                rows.append(block)
                right.append(y)
    for k in range(len(days) - 1):
        for i in range(D):
            block = np.zeros((1, n))
            block[0, k * D + i], block[0, (k + 1) * D + i] = -1.0, 1.0
            variance = WALK[i] * (days[k + 1] - days[k])
            if jump is not None:
                variance += jump[list(DAY).index(days[k]), i]
            rows.append(block / max(np.sqrt(variance), 1e-4))
            right.append(np.zeros(1))
    block = np.zeros((D, n))
    block[:, :D] = np.diag(np.sqrt(prior))
    rows.append(block)
    right.append(np.zeros(D))
    design = np.vstack(rows)
    covariance = np.linalg.inv(design.T @ design)
    state = covariance @ design.T @ np.concatenate(right)
    blocks = [covariance[k * D : (k + 1) * D, k * D : (k + 1) * D] for k in range(len(days))]
    return state.reshape(-1, D), np.array(blocks)


def chain(observed: list[tuple[Array, Array]], prior: Array | None = None) -> Chain:
    first = Known(np.diag(np.zeros(D) if prior is None else prior), np.zeros(D))
    return Chain.of(DAY, [known(*own) for own in observed], WALK, np.zeros((M - 1, D)), first)


@pytest.mark.parametrize("rows", [1, 2, 6])
def test_every_session_and_any_day_is_what_least_squares_say(rows: int) -> None:
    """Sessions of one reading alone determine nothing by themselves."""
    observed, prior = told(rows, rows), np.array([0.0, 0.2, 0.0, 0.0])
    found = chain(observed, prior)
    days = np.sort(np.r_[-1.5, DAY, 0.25, 2.0, 5.5, 20.0])
    state, covariance = all_at_once(observed, days, prior)
    for day, x, c in zip(days, state, covariance, strict=True):
        own = found.at(day).estimate()
        np.testing.assert_allclose(own.state, x, rtol=RTOL, atol=1e-7)
        np.testing.assert_allclose(own.covariance, c, rtol=RTOL, atol=1e-7)


def test_sessions_may_be_further_apart_than_days_would_have_them() -> None:
    observed, jump = told(8, 6), np.zeros((M - 1, D))
    jump[1], jump[3, 2] = [0.5, 0.2, 0.0, 3.0], 2.0
    found = Chain.of(DAY, [known(*own) for own in observed], WALK, jump, Known.nothing(D))
    state, covariance = all_at_once(observed, DAY, np.zeros(D), jump)
    for day, x, c in zip(DAY, state, covariance, strict=True):
        own = found.at(day).estimate()
        np.testing.assert_allclose(own.state, x, rtol=RTOL, atol=1e-6)
        np.testing.assert_allclose(own.covariance, c, rtol=RTOL, atol=1e-6)


def test_what_no_session_shows_stays_unknown_however_many_there_are() -> None:
    observed = told(3, 2)
    for h, _ in observed:
        h[:, 2] = 0.0  # never seen
        h[:, 1] = h[:, 0]  # only the sum of the two is
    own = chain(observed).at(DAY[-1]).estimate()
    assert np.isinf(np.diagonal(own.covariance)[[0, 1, 2]]).all()
    assert np.isnan(own.state[[0, 1, 2]]).all()
    assert np.isfinite(own.covariance[3, 3])
    assert not own.covariance[~np.eye(D, dtype=bool)].any()
    assert own.of(np.array([0.0, 0.0, 1.0, 0.0])) == (pytest.approx(np.nan, nan_ok=True), np.inf)
    assert np.isfinite(own.of(np.array([0.0, 0.0, 0.0, 2.0]))[1])


@pytest.mark.parametrize(("left", "known_apart"), [(0.95e-9, False), (1.05e-9, True)])
def test_two_that_are_told_apart_by_less_than_a_billionth_are_not(left: float, known_apart: bool) -> None:
    units = np.array([1.0, 1e4])
    information = np.array([[1.0, 1.0 - left], [1.0 - left, 1.0]]) * np.outer(units, units)
    assert np.isfinite(Known(information, np.zeros(2)).estimate().state).all() == known_apart


@pytest.mark.parametrize(("share", "told_third"), [(0.95e-3, True), (1.05e-3, False)])
def test_what_has_next_to_no_part_in_what_is_unseen_is_known(share: float, told_third: bool) -> None:
    """Two readings of three: what they leave open is (1, −1, 2 sin a), to the length of √2."""
    a = share / np.sqrt(2.0)
    read = np.array([[np.cos(a), np.cos(a), 0.0], [-np.sin(a), np.sin(a), 1.0]])
    own = Known(read.T @ read, np.zeros(3)).estimate()
    assert np.isnan(own.state[:2]).all()
    assert np.isfinite(own.covariance[2, 2]) == told_third


def test_others_are_all_but_the_session_itself() -> None:
    observed = told(4, 6)
    silent = [own if k != 2 else (np.zeros((1, D)), np.zeros(1)) for k, own in enumerate(observed)]
    without, others = chain(silent).at(DAY[2]).estimate(), chain(observed).others(2).estimate()
    np.testing.assert_allclose(others.state, without.state, rtol=RTOL)
    np.testing.assert_allclose(others.covariance, without.covariance, rtol=RTOL)


def test_loosened_is_the_inverse_of_the_covariance_with_more_on_its_diagonal() -> None:
    own = known(*told(5, 6)[0])
    variance = np.array([0.5, 0.0, 2.0, 0.0])
    found = own.loosened(variance)
    covariance = np.linalg.inv(own.information) + np.diag(variance)
    np.testing.assert_allclose(np.linalg.inv(found.information), covariance, rtol=RTOL)
    np.testing.assert_allclose(covariance @ found.right, np.linalg.solve(own.information, own.right), rtol=RTOL)


def test_loosened_without_bound_leaves_what_the_others_share() -> None:
    own = known(*told(6, 6)[0])
    found = own.loosened(np.array([np.inf, 0.0, 0.0, 0.0]))
    assert not found.information[0].any()
    assert found.right[0] == 0.0
    rest = np.linalg.inv(found.information[1:, 1:])
    np.testing.assert_allclose(rest, np.linalg.inv(own.information)[1:, 1:], rtol=RTOL)
    great = own.loosened(np.array([1e9, 0.0, 0.0, 0.0]))
    np.testing.assert_allclose(great.information, found.information, atol=1e-6)


def test_of_what_is_not_known_an_error_takes_nothing() -> None:
    own = Known(np.diag([0.0, 2.0]), np.array([0.0, 3.0]))
    found = own.loosened(np.array([np.inf, 0.0]))
    np.testing.assert_array_equal(found.information, own.information)
    np.testing.assert_array_equal(found.right, own.right)


def test_a_jump_lets_the_sessions_before_it_tell_nothing_of_the_constant() -> None:
    observed = told(7, 6)
    jump = np.zeros((M - 1, D))
    jump[2, 0] = np.inf
    first = Known(np.zeros((D, D)), np.zeros(D))
    whole = Chain.of(DAY, [known(*own) for own in observed], WALK, jump, first).at(DAY[-1]).estimate()
    moved = [(h, y + 50.0 * h[:, 0]) if k < 3 else (h, y) for k, (h, y) in enumerate(observed)]
    other = Chain.of(DAY, [known(*own) for own in moved], WALK, jump, first).at(DAY[-1]).estimate()
    np.testing.assert_allclose(whole.state, other.state, atol=1e-6)
    apart = chain(observed).at(DAY[-1]).estimate()
    assert apart.covariance[0, 0] < whole.covariance[0, 0]
