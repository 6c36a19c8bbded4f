"""Residuals of a record in closed form, and every derivative of them by finite differences."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numerics_support import angle
from small_record import ARM, G, Small, moved, size_of, small

from fieldcal.estimation.joint import measurement_model
from fieldcal.estimation.joint.measurement_model import (
    body_jumps,
    layout_of,
    lever_arm_geometry,
    residuals,
    sensitivities,
    trajectory,
    translation,
)
from fieldcal.estimation.joint.problem import TERMS, TRIADS, State, slow_rate
from fieldcal.geometry.rotation import Array, body_from_inertial, from_rotation_vector, multiply, skew

ALL = tuple(TERMS)
# Trapezoids between samples 5 ms apart; delays of 4 ms to first order, with a rate that is a mean over 60 ms, at the
# ends of the stretches too.
INTEGRATED, DELAYED = 2e-4, 6e-3
STEP, DIFFERENCES = 1e-5, 2e-4  # of finite differences; what second order leaves at a jump of some mrad, relative

pytestmark = pytest.mark.usefixtures("either_kernel")


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("terms", [(), ALL])
def test_the_truth_leaves_no_residual(sign: float, terms: tuple[str, ...]) -> None:
    flight = small(terms, sign=sign)
    path = trajectory(flight.model, flight.state)
    assert angle(path.q, flight.q).max() < INTEGRATED
    np.testing.assert_allclose(path.rate, flight.rate, atol=1e-12)
    left = residuals(flight.model, flight.state, path)
    assert np.abs(left).max() < (DELAYED if terms else 5.0 * INTEGRATED)
    for i, name in enumerate(flight.model.vectors):
        row = slice(3 * i, 3 * i + 3)
        assert not left[~flight.model.triads[name].valid, row].any()
        without = residuals(flight.model, moved(flight.state, name, np.full(6, 0.1)), path)
        assert np.abs(without[flight.model.triads[name].valid, row]).max() > 0.02


def test_a_jump_is_spread_evenly_over_its_interval() -> None:
    flight = small()
    model, knots = flight.model, flight.model.knots
    jump = np.array([0.002, -0.001, 0.003])
    turned = [multiply(from_rotation_vector(jump), q) if k == 3 else q for k, q in enumerate(flight.state.q)]
    path = trajectory(model, replace(flight.state, q=np.array(turned)))
    np.testing.assert_allclose(path.jump[2], jump, atol=INTEGRATED)
    np.testing.assert_allclose(path.jump[3], -jump, atol=INTEGRATED)
    assert not path.jump[~knots.joined].any()
    share = np.interp(model.readings.t, model.readings.t[knots.index[2:5]], [0.0, 1.0, 0.0])
    expected = multiply(from_rotation_vector(share[:, None] * jump), flight.q)
    assert angle(path.q, expected).max() < INTEGRATED
    state = replace(flight.state, q=np.array(turned))
    np.testing.assert_allclose(body_jumps(state, path)[2], body_from_inertial(turned[2]) @ jump, atol=INTEGRATED)


def test_translation_is_linear_between_knots_and_the_arm_s_geometry_is_that_of_turning() -> None:
    flight = small()
    model, index = flight.model, flight.model.knots.index
    found = translation(model, flight.state)
    np.testing.assert_allclose(found[index], flight.state.motion[:, 3:6], atol=1e-12)
    for k in np.flatnonzero(model.knots.joined):
        t = model.readings.t[index[k] : index[k + 1]]
        share = ((t - t[0]) / (model.readings.t[index[k + 1]] - t[0]))[:, None]
        a, b = flight.state.motion[k : k + 2, 3:6]
        np.testing.assert_allclose(found[index[k] : index[k + 1]], a + share * (b - a), atol=1e-12)
    change = np.gradient(flight.rate[:100], model.readings.t[:100], axis=0)
    expected = skew(change) + skew(flight.rate[:100]) @ skew(flight.rate[:100])
    found = lever_arm_geometry(model, flight.state, slice(0, 100))
    np.testing.assert_allclose(found[2:-2], expected[2:-2], atol=2e-3)


def test_a_delay_s_rate_is_a_mean_over_thirty_ms_on_either_side() -> None:
    flight = small()
    path = trajectory(flight.model, flight.state)
    for span in (slice(0, 50), slice(20, 30), slice(150, len(flight.model.at))):
        found = slow_rate(flight.model, path, span)
        for row, i in zip(found, flight.model.at[span], strict=True):
            np.testing.assert_allclose(row, path.rate[max(i - 6, 0) : i + 7].mean(axis=0), rtol=1e-9)
    slow = small(rate_hz=20.0, spacing_s=0.2, missing=False)
    path = trajectory(slow.model, slow.state)
    found = slow_rate(slow.model, path, slice(2, 3))
    np.testing.assert_allclose(found[0], path.rate[1:4].mean(axis=0), rtol=1e-9)


def dense(flight: Small, dip: bool = True, lever_arm: bool = True) -> tuple[Array, Array, Array, dict[str, slice]]:
    """Minus derivatives of all residuals (m, r, ·) by knots (K · 6) and parameters, of the integrated attitude at the
    ends (K, 3, p), and the layout."""
    model, state = flight.model, flight.state
    layout, p = layout_of(model, state.values, dip=dip, lever_arm=lever_arm)
    m, r, k = len(model.at), 3 * len(model.vectors), len(model.knots.index)
    by_knot, by_parameter, ends = np.zeros((m, r, k, 6)), np.zeros((m, r, p)), np.zeros((k, 3, p))
    rows = 0
    for knot_span, chunk, moved_ends in sensitivities(model, state, trajectory(model, state), layout, p):
        here = model.at[chunk.span]
        knot, share = model.knots.of_sample[here], model.knots.share[here]
        for i in range(len(here)):
            by_knot[chunk.span][i][:, knot[i]] += (1.0 - share[i]) * chunk.by_knot[i]
            if share[i] > 0.0:
                by_knot[chunk.span][i][:, knot[i] + 1] += share[i] * chunk.by_knot[i]
        by_parameter[chunk.span] = chunk.by_parameter
        ends[knot_span] = moved_ends
        rows += len(here)
    assert rows == m
    return by_knot, by_parameter, ends, layout


def difference(flight: Small, plus: State, minus: State, step: float) -> tuple[Array, Array]:
    """Derivatives of residuals and of jumps."""
    a, b = (
        (residuals(flight.model, s, path), path.jump) for s in (plus, minus) for path in [trajectory(flight.model, s)]
    )
    return (a[0] - b[0]) / (2.0 * step), (a[1] - b[1]) / (2.0 * step)


@pytest.mark.parametrize("chunk_rows", [512, 40])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_derivatives_by_knots_are_finite_differences(
    sign: float, chunk_rows: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(measurement_model, "CHUNK_ROWS", chunk_rows)
    flight = small(sign=sign)
    by_knot, _, _, _ = dense(flight)
    for k in range(len(flight.model.knots.index)):
        for axis in range(6):
            step = np.zeros((len(flight.state.motion), 12))
            step[k, axis if axis < 3 else axis + 3] = STEP
            plus, minus = (flight.state.moved(s * step, np.zeros(0), {}) for s in (1.0, -1.0))
            found, _ = difference(flight, plus, minus, STEP)
            np.testing.assert_allclose(by_knot[:, :, k, axis], -found, atol=2e-3 * np.abs(by_knot).max())


STEADY = {"lever_arm": None, "translation_mps2": 0.0}


@pytest.mark.parametrize("chunk_rows", [512, 40])
@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("terms", [(), tuple(name for name in ALL if not name.endswith("_delay"))])
def test_derivatives_by_parameters_are_finite_differences(
    terms: tuple[str, ...], sign: float, chunk_rows: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Those by the gyroscope's constants and the accelerometer's scales where nothing but gravity is sensed:
    translation and what a lever arm does are noise to them."""
    monkeypatch.setattr(measurement_model, "CHUNK_ROWS", chunk_rows)
    for flight in (small(terms, sign=sign), small(terms, sign=sign, **STEADY)):
        _, by_parameter, ends, layout = dense(flight)
        assert sum(size_of(name) for name in layout) == by_parameter.shape[2]
        steady = not flight.state.motion.any()
        for name, columns in layout.items():
            for i in range(size_of(name)):
                if (name == "gyroscope" or (name == "accelerometer" and i < 3)) and not steady:
                    continue
                by = STEP * np.eye(size_of(name))[i]
                residual, jump = difference(flight, moved(flight.state, name, by), moved(flight.state, name, -by), STEP)
                own = by_parameter[:, :, columns.start + i]
                np.testing.assert_allclose(own, -residual, atol=DIFFERENCES * max(1.0, np.abs(own).max()), err_msg=name)
                np.testing.assert_allclose(ends[:-1, :, columns.start + i], -jump, atol=DIFFERENCES, err_msg=name)
        assert not ends[-1].any()


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_scale_s_derivative_is_gravity_s(sign: float) -> None:
    """Not the translation's, nor the lever arm's."""
    flight = small(sign=sign)
    _, by_parameter, _, layout = dense(flight)
    steady = sign * G * body_from_inertial(trajectory(flight.model, flight.state).q)[..., 2]
    scale, bias = flight.state.values["accelerometer"][:3], flight.state.values["accelerometer"][3:]
    expected = -(steady - bias) / scale**2 * flight.model.triads["accelerometer"].valid[:, None]
    found = np.stack([by_parameter[:, i, layout["accelerometer"].start + i] for i in range(3)], axis=1)
    np.testing.assert_allclose(found, expected, atol=1e-9)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_delay_s_derivative_is_a_finite_difference_about_none(sign: float) -> None:
    flight = small(sign=sign)
    names = [f"{name}_delay" for name in TRIADS[1:]]
    flight = replace(
        flight, state=replace(flight.state, values={**flight.state.values, **{n: np.zeros(1) for n in names}})
    )
    _, by_parameter, _, layout = dense(flight)
    for name in names:
        by = np.array([STEP])
        found, _ = difference(flight, moved(flight.state, name, by), moved(flight.state, name, -by), STEP)
        own = by_parameter[:, :, layout[name]][..., 0]
        np.testing.assert_allclose(own, -found, atol=1e-4 * np.abs(own).max())
        assert np.abs(own).max() > 0.1


def test_rotations_about_the_sensor_s_axes_move_as_attitudes_do() -> None:
    flight = small()
    model, state = flight.model, flight.state
    layout, p = layout_of(model, state.values, dip=True, lever_arm=True)
    path = trajectory(model, state)
    for _, rows, _ in sensitivities(model, state, path, layout, p):
        to_inertial = body_from_inertial(path.q[model.at[rows.span]]).transpose(0, 2, 1)
        np.testing.assert_allclose(rows.by_rotation, rows.by_knot[..., :3] @ to_inertial, atol=1e-9)
        np.testing.assert_allclose(rows.residual, residuals(model, state, path)[rows.span], atol=1e-12)


def test_what_is_free_has_its_place() -> None:
    flight = small(ALL)
    layout, p = layout_of(flight.model, flight.state.values, dip=True, lever_arm=True)
    assert p == 6 + 6 + 3 + 9 + 6 + 6 + 1 + 3 + 1 + 1 + 3 + 6
    assert list(layout)[:4] == ["gyroscope", "gyroscope_cross", "gyroscope_temperature", "gyroscope_g_sensitivity"]
    assert [s.start for s in layout.values()] == [0, *[s.stop for s in layout.values()][:-1]]
    assert {name: s.stop - s.start for name, s in layout.items()} == {name: size_of(name) for name in layout}
    alone = small(vectors=("magnetometer",))
    layout, p = layout_of(alone.model, alone.state.values, dip=True, lever_arm=True)
    assert (list(layout), p) == (["gyroscope", "magnetometer"], 12)
    layout, p = layout_of(flight.model, small().state.values, dip=False, lever_arm=False)
    assert (list(layout), p) == (["gyroscope", "accelerometer", "magnetometer"], 18)


def test_an_arm_is_asked_of_the_accelerometer_alone() -> None:
    flight = small()
    with_arm = residuals(flight.model, flight.state, trajectory(flight.model, flight.state))
    state = replace(flight.state, values={**flight.state.values, "lever_arm": np.zeros(3)})
    without = residuals(flight.model, state, trajectory(flight.model, state))
    assert (with_arm[:, 3:] == without[:, 3:]).all()
    scale = flight.state.values["accelerometer"][:3]
    geometry = lever_arm_geometry(flight.model, flight.state, slice(None))
    change = -(geometry @ ARM) / scale * flight.model.triads["accelerometer"].valid[:, None]
    np.testing.assert_allclose((without - with_arm)[:, :3], change, atol=1e-12)


@pytest.mark.parametrize("most", [40, 17, 5])
def test_a_chunk_ends_with_the_interval_that_fills_it(most: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(measurement_model, "CHUNK_ROWS", most)
    model = small().model
    spans = list(measurement_model.chunks(model))
    for rows, knots in spans:
        own = model.knots.index[knots.stop - 1] - rows.start  # without its last interval
        assert own < most or rows.stop == len(model.at)
    assert len(spans) > len(model.at) // (most + 18) - 1
    assert [rows.start for rows, _ in spans] == [0, *[rows.stop for rows, _ in spans[:-1]]]
    assert spans[-1][0].stop == len(model.at)
    assert spans[-1][1].stop == len(model.knots.index)
