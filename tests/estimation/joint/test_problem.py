"""Readings, triads in centred units and the model of a record: by definition, sample by sample."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numerics_support import angle
from small_record import FIELD_NED, PLACES, VALUES, mixed, moved, small

from fieldcal.estimation.joint.chain_solver import place_knots
from fieldcal.estimation.joint.problem import (
    CROSS,
    TRIADS,
    Centred,
    Model,
    Readings,
    averaging_side,
    corrected,
    off_diagonal,
)
from fieldcal.geometry.rotation import from_rotation_vector, multiply


def readings(n: int = 100, interval_s: float = 1.0 / 256.0, **changes: Any) -> Readings:
    rng = np.random.default_rng(1)
    given: dict[str, Any] = {
        "t": np.arange(n) * interval_s, "segment": np.zeros(n, dtype=np.int64), "gyroscope": rng.normal(size=(n, 3)),
        "accelerometer": rng.normal(size=(n, 3)), "magnetometer": rng.normal(size=(n, 3)), "gravity_mps2": 9.81,
        "field_ned": FIELD_NED, "turning": rng.normal(size=(2, n, 3)), "warmth": rng.normal(size=n),
        "force": rng.normal(size=(n, 3)),
    }  # fmt: skip
    return Readings(**{**given, **changes})


def test_a_part_is_every_array_s() -> None:
    given = readings()
    part = given.part(slice(20, 50))
    for name, whole in vars(given).items():
        own = getattr(part, name)
        if name == "turning":
            assert (own == whole[:, 20:50]).all()
        elif name in ("gravity_mps2", "field_ned"):
            assert np.array_equal(own, whole)
        else:
            assert (own == whole[20:50]).all(), name
    alone = replace(given, warmth=None, force=None).gyroscope_alone().part(slice(0, 5))
    assert (alone.accelerometer, alone.magnetometer, alone.warmth, alone.force) == (None,) * 4


@pytest.mark.parametrize(
    ("interval_s", "rate_radps", "side"),
    [
        # 0.1 rad of turning or 20 ms, whichever is shorter, of which a side is a half less the sample itself.
        (1.0 / 256.0, 1.0, 2),  # 5.12 samples
        (1.0 / 256.0, 0.0, 2),
        (1.0 / 256.0, 10.0, 0),  # 10 ms: 2.56 samples
        (1.0 / 256.0, 8.0, 1),  # 12.5 ms: 3.2 samples
        (1.0 / 256.0, 8.4, 1),  # 3.05 samples
        (1.0 / 256.0, 9.0, 0),  # 2.84 samples
        (1.0 / 512.0, 1.0, 4),  # 10.24 samples
        (1.0 / 32.0, 1.0, 0),
    ],
)
def test_vectors_are_averaged_while_the_vehicle_hardly_turns(interval_s: float, rate_radps: float, side: int) -> None:
    assert averaging_side(readings(interval_s=interval_s), rate_radps) == side


def test_vectors_with_readings_missing_are_not_averaged() -> None:
    given = readings()
    for name in TRIADS[1:]:
        holed = getattr(given, name).copy()
        holed[3, 1] = np.nan
        assert averaging_side(replace(given, **{name: holed}), 1.0) == 0
        assert averaging_side(replace(given, **{name: None}), 1.0) == 2


def test_centred_readings_have_no_mean_and_unit_spread() -> None:
    logged = np.random.default_rng(2).normal(size=(500, 3)) * [1.0, 5.0, 0.1] + [10.0, -20.0, 3.0]
    logged[7, 2] = np.nan
    triad = Centred.of(logged)
    whole = np.delete(logged, 7, axis=0)
    assert triad.valid.tolist() == [i != 7 for i in range(500)]
    np.testing.assert_allclose(triad.centre, whole.mean(axis=0))
    np.testing.assert_allclose(triad.spread, whole.std(axis=0))
    np.testing.assert_allclose(np.delete(triad.x, 7, axis=0), (whole - whole.mean(axis=0)) / whole.std(axis=0))
    assert not triad.x[7].any()


def test_constants_in_either_unit_calibrate_alike() -> None:
    triad = Centred.of(np.random.default_rng(3).normal(size=(100, 3)) * [1.0, 5.0, 0.1] + [10.0, -20.0, 3.0])
    scale, bias = np.array([0.3, -0.2, 0.1]), np.array([1.0, 2.0, 3.0])
    scaled = triad.scaled(scale, bias)
    logged = triad.centre + triad.spread * triad.x
    np.testing.assert_allclose(scaled[:3] * triad.x + scaled[3:], scale * logged + bias)
    np.testing.assert_allclose(np.concatenate(triad.logged(scaled)), np.r_[scale, bias])
    np.testing.assert_allclose(triad.to_logged() @ scaled, np.r_[scale, bias])


def test_rows_are_means_of_neighbours_within_a_segment() -> None:
    n, side = 100, 2
    segment = np.repeat([0, 1, 2, 3], [41, 5, 4, 50])
    given = readings(n, segment=segment)
    knots = place_knots(given.t, segment, 0.1)
    model = Model.of(given, knots, side=side)
    expected = [i for a, b in ((0, 41), (41, 46), (46, 50), (50, 100)) for i in range(a + side, b - side, 2 * side + 1)]
    assert model.at.tolist() == expected
    for name in TRIADS[1:]:
        plain = Centred.of(getattr(given, name))
        means = np.array([plain.x[i - side : i + side + 1].mean(axis=0) for i in expected])
        np.testing.assert_allclose(model.triads[name].x, means, atol=1e-12)
        assert len(model.triads[name].valid) == len(expected)
    assert len(model.triads["gyroscope"].x) == n
    alone = Model.of(given.gyroscope_alone(), knots)
    assert (alone.vectors, alone.at.tolist()) == ((), knots.index.tolist())
    assert alone.valid_rows().shape == (len(knots.index), 0)
    every = Model.of(given, knots)
    assert every.at.tolist() == list(range(n))


def test_a_triad_without_a_reading_is_left_out() -> None:
    given = readings(magnetometer=np.full((100, 3), np.nan))
    assert Model.of(given, place_knots(given.t, given.segment, 0.1)).vectors == ("accelerometer",)
    assert given.magnetometer is not None
    given.magnetometer[7] = 1.0
    assert Model.of(given, place_knots(given.t, given.segment, 0.1)).vectors == TRIADS[1:]


def test_valid_rows_are_in_the_order_of_the_vectors() -> None:
    model = small().model
    for i, name in enumerate(model.vectors):
        assert model.valid_rows()[:, i].tolist() == model.triads[name].valid.tolist()
    assert model.valid_rows().shape == (len(model.at), 2)


def test_a_part_of_the_model_is_that_of_its_samples_in_the_same_units() -> None:
    given = readings()
    segment = given.segment
    model = Model.of(given, place_knots(given.t, segment, 0.1), side=1)
    a, b = 20, 70
    knots = place_knots(given.t[a:b], segment[a:b], 0.1)
    part = model.part(a, b, knots)
    inside = (model.at >= a) & (model.at < b)
    assert part.at.tolist() == (model.at[inside] - a).tolist()
    assert part.knots is knots
    for name in TRIADS:
        own, whole = part.triads[name], model.triads[name]
        rows = np.arange(a, b) if name == "gyroscope" else np.flatnonzero(inside)
        assert (own.x == whole.x[rows]).all()
        assert (own.valid == whole.valid[rows]).all()
        assert (own.centre == whole.centre).all()
        assert (own.spread == whole.spread).all()
    assert part.readings.t.tolist() == given.t[a:b].tolist()


def test_readings_are_taken_out_of_one_triad() -> None:
    model = small().model
    rows = np.arange(len(model.at)) % 7 == 0
    found = model.without("magnetometer", rows)
    assert found.triads["accelerometer"] is model.triads["accelerometer"]
    assert found.triads["magnetometer"].valid.tolist() == (model.triads["magnetometer"].valid & ~rows).tolist()
    assert not found.triads["magnetometer"].x[rows].any()
    assert (found.triads["magnetometer"].x[~rows] == model.triads["magnetometer"].x[~rows]).all()


def test_the_field_keeps_heading_and_strength_whatever_its_dip() -> None:
    model = small().model
    for dip in (-0.5, 0.0, 0.9):
        field, change = model.field(dip)
        assert np.linalg.norm(field) == pytest.approx(np.linalg.norm(FIELD_NED))
        assert np.arctan2(field[1], field[0]) == pytest.approx(np.arctan2(FIELD_NED[1], FIELD_NED[0]))
        assert np.arctan2(field[2], np.hypot(*field[:2])) == pytest.approx(dip)
        step = (model.field(dip + 1e-6)[0] - model.field(dip - 1e-6)[0]) / 2e-6
        np.testing.assert_allclose(change, step, atol=1e-9)


def test_corrections_add_up() -> None:
    terms = ("gyroscope_cross", "gyroscope_temperature", "gyroscope_g_sensitivity", "magnetometer_cross")
    model = small(terms).model
    x, warmth, force = model.triads["gyroscope"].x, model.readings.warmth, model.readings.force
    assert warmth is not None
    assert force is not None
    span = slice(10, 40)
    expected = x @ mixed("gyroscope", VALUES["gyroscope_cross"]).T + warmth[:, None] * VALUES["gyroscope_temperature"]
    expected = expected + force @ VALUES["gyroscope_g_sensitivity"].reshape(3, 3).T
    np.testing.assert_allclose(corrected(model, VALUES, "gyroscope"), expected, atol=1e-12)
    np.testing.assert_allclose(corrected(model, VALUES, "gyroscope", span), expected[span], atol=1e-12)
    bare = replace(model, readings=replace(model.readings, warmth=None, force=None))
    only = x @ mixed("gyroscope", VALUES["gyroscope_cross"]).T
    np.testing.assert_allclose(corrected(bare, VALUES, "gyroscope"), only, atol=1e-12)
    assert (corrected(model, {}, "gyroscope") == x).all()
    for name in TRIADS:
        assert CROSS[name] == PLACES[name]
        cross = VALUES[f"{name}_cross"]
        np.testing.assert_allclose(np.eye(3) + off_diagonal(name, cross), mixed(name, cross))


def test_a_step_moves_attitudes_motion_and_parameters() -> None:
    flight = small()
    k = len(flight.state.q)
    step = np.random.default_rng(4).normal(size=(k, 12)) * 0.1
    layout = {"magnetometer": slice(2, 8), "dip": slice(0, 1)}
    theta = np.arange(8.0)
    after = flight.state.moved(step, theta, layout)
    assert angle(after.q, multiply(from_rotation_vector(step[:, :3]), flight.state.q)).max() < 1e-12
    np.testing.assert_allclose(after.motion, flight.state.motion + step[:, 3:])
    expected = moved(moved(flight.state, "magnetometer", theta[2:8]), "dip", theta[:1])
    assert after.values.keys() == expected.values.keys()
    for name, value in after.values.items():
        np.testing.assert_allclose(value, expected.values[name])
