"""Chances beyond what a number holds, against closed forms and the normal distribution's own tail."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import log_ndtr
from scipy.stats import f as f_distribution
from scipy.stats import t as t_distribution

from fieldcal.estimation.pooled.chance import log_beyond, log_beyond_either_way


@pytest.mark.parametrize("z", [0.0, 2.0, 20.0, 37.0, 40.0, 100.0, 1000.0])
def test_of_many_degrees_it_is_the_normal_distributions(z: float) -> None:
    found = log_beyond_either_way([z, -z], 1e12)
    assert found == pytest.approx(np.log(2.0) + log_ndtr(-z), rel=2e-6, abs=1e-6)


@pytest.mark.parametrize("freedom", [3.0, 100.0, 1e6])
def test_of_two_and_some_the_tail_has_a_closed_form(freedom: float) -> None:
    """P(F > x) = (1 + 2 x / ν)^(−ν/2)."""
    x = np.array([1e-3, 1.0, 30.0, 1e3, 1e6])
    np.testing.assert_allclose(log_beyond(x, 2.0, freedom), -0.5 * freedom * np.log1p(2.0 * x / freedom), rtol=1e-6)


def test_where_a_number_holds_it_it_is_scipys() -> None:
    z = np.linspace(0.0, 30.0, 31)
    np.testing.assert_array_equal(log_beyond_either_way(z, 40.0), np.log(2.0) + t_distribution.logsf(z, 40.0))
    np.testing.assert_array_equal(log_beyond(z, 5.0, 40.0), f_distribution.logsf(z, 5.0, 40.0))


@pytest.mark.parametrize("freedom", [1e4, 1e6])
def test_the_greater_surprise_is_the_less_likely_all_the_way(freedom: float) -> None:
    z = np.linspace(1.0, 200.0, 4000)
    assert np.all(np.diff(log_beyond_either_way(z, freedom)) < 0.0)
    for count in (1.0, 3.0, 12.0):
        assert np.all(np.diff(log_beyond(z**2 / count, count, freedom)) < 0.0)
