"""The start of the joint estimate: means, turns and constants by closed forms, limits from both sides."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numerics_support import angle, directions, turning_rates

from fieldcal.errors import UnusableFlight
from fieldcal.estimation.joint import initialise
from fieldcal.estimation.joint.initialise import anew, low_passed, prepare, start_of_triad, turning
from fieldcal.estimation.joint.problem import Readings
from fieldcal.estimation.smoothing import differentiate_samples, smooth_samples
from fieldcal.geometry.rotation import Array, body_from_inertial, conjugate, from_rotation_vector, multiply, propagate

G = 9.81
FIELD_NED = 0.5 * np.array([0.6, 0.2, 0.75])
RATE_HZ = 128.0
SCALE = {
    "gyroscope": np.array([0.5, -0.4, 0.3]),
    "accelerometer": np.array([2.0, -1.0, 0.5]),
    "magnetometer": np.array([0.1, 0.2, -0.3]),
}
BIAS = {
    "gyroscope": np.array([0.02, -0.01, 0.03]),
    "accelerometer": np.array([1.0, -2.0, 0.5]),
    "magnetometer": np.array([0.1, -0.2, 0.3]),
}
INTEGRATED_RAD = 5e-4
RESOLUTION_HZ = 1.0 / 8.0  # of a spectrum over 8 s
RIPPLE = 1e-4  # of a low-pass of 0.2 Hz at a quarter of the sampling rate


def test_stretches_are_low_passed_apart() -> None:
    t = np.r_[np.arange(200), 1000 + np.arange(300)] / RATE_HZ
    segment, x = np.repeat([0, 1], [200, 300]), np.random.default_rng(1).normal(size=(500, 3))
    found = low_passed(t, segment, x, 4.0, 0.5)
    for a, b in ((0, 200), (200, 500)):
        np.testing.assert_allclose(found[a:b], smooth_samples(t[a:b], x[a:b], 4.0, side_s=0.5))
    low, change = turning(t, segment, x)
    for a, b in ((0, 200), (200, 500)):
        np.testing.assert_allclose(change[a:b], differentiate_samples(t[a:b], low[a:b]))


def fastest(t: Array, x: Array, segment: np.ndarray | None = None) -> float:
    own = np.zeros(len(t), dtype=np.int64) if segment is None else segment
    return initialise._fastest_turning_hz(t, own, x)


def band(t: Array, up_to_hz: float, power: float, seed: int = 2) -> Array:
    """Lines every RESOLUTION_HZ up to a frequency, `power` times the density of unit white noise each."""
    rng = np.random.default_rng(seed)
    frequency = np.arange(RESOLUTION_HZ, up_to_hz + 1e-9, RESOLUTION_HZ)
    shifted = 2.0 * np.pi * frequency[:, None] * t + rng.uniform(0.0, 2.0 * np.pi, (3, len(frequency), 1))
    # White noise of unit variance has 2/rate per Hz, one side.
    each = np.sqrt(2.0 * power * (2.0 / RATE_HZ) * RESOLUTION_HZ)
    return np.asarray(each * np.sin(shifted).sum(axis=1).T)


@pytest.mark.parametrize(("power", "told"), [(30.0, True), (4.0, False)])
@pytest.mark.parametrize("up_to_hz", [1.0, 3.0])
def test_turning_ends_where_its_density_falls_below_ten_times_the_noise(
    up_to_hz: float, power: float, told: bool
) -> None:
    """Strong up to 0.75 Hz in any case, then `power` times the noise."""
    t = np.arange(round(240 * RATE_HZ)) / RATE_HZ
    x = np.random.default_rng(3).normal(size=(len(t), 3)) + band(t, up_to_hz, power) + band(t, 0.75, 1e3, 4)
    expected = up_to_hz if told else 0.75
    assert fastest(t, x) == pytest.approx(expected, abs=2.5 * RESOLUTION_HZ)


def by_spectrum(monkeypatch: pytest.MonkeyPatch, density: Array, top_hz: float = 64.0) -> float:
    """The frequency that is read off a spectrum (bins of RESOLUTION_HZ up to `top_hz`), alike on three axes."""
    asked = []

    def power_density(x: Array, interval_s: float, length: int) -> tuple[Array, Array]:
        asked.append((x.shape, interval_s, length))
        return RESOLUTION_HZ * np.arange(len(density)), np.tile(density[:, None], 3)

    monkeypatch.setattr(initialise, "power_density", power_density)
    assert len(density) == round(top_hz / RESOLUTION_HZ) + 1
    for seconds, length in ((60.0, 1024), (4.0, 512)):
        t = np.arange(round(seconds * RATE_HZ)) / RATE_HZ
        found = fastest(t, np.zeros((len(t), 3)))
        assert asked.pop() == ((len(t), 3), pytest.approx(1.0 / RATE_HZ), length)
    return found


def bins(*spans: tuple[float, float, float], top_hz: float = 64.0, floor: float = 1.0) -> Array:
    """A density of `floor` but for (from Hz, to Hz, density), both ends included."""
    f = RESOLUTION_HZ * np.arange(round(top_hz / RESOLUTION_HZ) + 1)
    out = np.full(len(f), floor)
    for begin, end, value in spans:
        out[(f >= begin) & (f <= end)] = value
    return out


def test_the_end_of_turning_is_read_off_its_spectrum(monkeypatch: pytest.MonkeyPatch) -> None:
    """From the strongest bin up to 5 Hz on, to the last before one below ten times the noise."""
    assert by_spectrum(monkeypatch, bins((0.0, 3.0, 10.5), (1.0, 1.0, 50.0))) == 3.0
    assert by_spectrum(monkeypatch, bins((0.0, 3.0, 10.0), (1.0, 1.0, 50.0))) == 3.0
    assert by_spectrum(monkeypatch, bins((0.0, 3.0, 9.9), (1.0, 1.25, 50.0))) == 1.25
    assert by_spectrum(monkeypatch, bins((0.0, 3.0, 20.0), (2.0, 2.0, 9.0), (2.5, 2.5, 50.0))) == 3.0
    assert by_spectrum(monkeypatch, bins((0.0, 4.0, 20.0), (2.0, 2.0, 9.0), (1.0, 1.0, 50.0))) == 1.875
    assert by_spectrum(monkeypatch, bins((2.0, 2.0, 100.0), (4.0, 5.0, 50.0), (5.0, 5.0, 500.0))) == 5.0
    assert by_spectrum(monkeypatch, bins((4.25, 4.5, 100.0), (1.0, 1.0, 50.0), (6.0, 6.0, 1e3))) == 4.5
    assert by_spectrum(monkeypatch, bins((0.0, 0.25, 100.0))) == 0.5


def test_noise_is_the_median_from_five_hertz_to_twenty(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of 121 bins 61 have a density of 1 and 60 one of 5, so that one bin more or less on either end decides whether
    turning of a density of 20 is above ten times the noise."""
    quiet = bins((5.0, 5.0 + 29 * RESOLUTION_HZ, 1.0), (20.0 - 30 * RESOLUTION_HZ, 20.0, 1.0), floor=5.0)
    assert (quiet == 1.0).sum() == 61
    quiet[: round(2.0 / RESOLUTION_HZ) + 1] = 20.0
    quiet[8] = 21.0
    assert by_spectrum(monkeypatch, quiet) == 2.0


def test_noise_of_slow_samples_is_the_median_of_the_upper_half(monkeypatch: pytest.MonkeyPatch) -> None:
    """Up to 4 Hz: of the 17 bins from 2 Hz on 9 have a density of 1."""
    quiet = bins((2.0, 2.5, 1.0), (3.5, 3.875, 1.0), top_hz=4.0, floor=5.0)
    assert (quiet == 1.0).sum() == 9
    quiet[: round(1.0 / RESOLUTION_HZ) + 1] = 20.0
    quiet[4] = 21.0
    assert by_spectrum(monkeypatch, quiet, top_hz=4.0) == 1.0


def test_turning_is_cut_off_between_half_a_hertz_and_five() -> None:
    t = np.arange(round(60 * RATE_HZ)) / RATE_HZ
    noise = np.random.default_rng(5).normal(size=(len(t), 3))
    assert fastest(t, noise + band(t, 0.25, 1e3)) == 0.5
    assert fastest(t, noise + band(t, 12.0, 1e3)) == 5.0
    assert fastest(t, 1e-9 * noise + band(t, 2.0, 1e3)) < 3.0
    assert fastest(t, band(t, 60.0, 1e3) + band(t, 4.0, 1e6)) > 3.5


def test_the_longest_stretch_tells() -> None:
    t = np.arange(round(90 * RATE_HZ)) / RATE_HZ
    segment = (t < 60.0).astype(np.int64)
    noise = np.random.default_rng(6).normal(size=(len(t), 3))
    x = noise + np.where(segment[:, None] == 1, band(t, 3.0, 1e3), band(t, 1.0, 1e3))
    assert fastest(t, x, segment) == pytest.approx(3.0, abs=2.5 * RESOLUTION_HZ)
    assert fastest(t, x, 1 - segment) == pytest.approx(3.0, abs=2.5 * RESOLUTION_HZ)


def test_slow_samples_tell_their_noise_in_the_upper_half() -> None:
    """At 8 Hz nothing is known above 4 Hz: noise is that from 2 Hz on."""
    t = np.arange(8 * 240) / 8.0
    noise = np.random.default_rng(7).normal(size=(len(t), 3))
    slow = 50.0 * np.sin(2.0 * np.pi * np.array([0.6, 0.7, 0.8]) * t[:, None])
    assert fastest(t, noise + slow) == pytest.approx(0.85, abs=3.0 * RESOLUTION_HZ)


def test_an_ellipsoid_starts_a_triad_and_nothing_does_not() -> None:
    seen = directions(np.random.default_rng(8), 500)
    for polarity in (np.array([1.0, -1.0, 1.0]), np.array([-1.0, 1.0, 1.0])):
        scale = polarity * [2.0, 1.0, 0.5]
        logged = (G * seen - BIAS["accelerometer"]) / scale
        holed = logged.copy()
        holed[3, 1] = np.nan
        for given in (logged, holed):
            start = start_of_triad(given, G, polarity)
            assert start is not None
            np.testing.assert_allclose(start[0], scale, rtol=1e-6)
            np.testing.assert_allclose(start[1], BIAS["accelerometer"], atol=1e-5)
    assert start_of_triad(np.ones((500, 3)), G, np.ones(3)) is None
    assert start_of_triad(seen[:3], G, np.ones(3)) is None


def test_a_field_far_off_its_mean_has_half_the_weight_at_a_tenth_of_itself() -> None:
    """A pattern of four readings, too fast for the mean: one is 3 e off it, three are e off on the other side."""
    n = 4096
    t, segment = np.arange(n) / RATE_HZ, np.zeros(n, dtype=np.int64)
    r = blank(t, segment)
    limit = 0.1 * np.linalg.norm(FIELD_NED)
    way = np.array([2.0, -1.0, 2.0]) / 3.0
    for e in (limit / 3.0, limit, 2.0 * limit):
        off = np.where(np.arange(n) % 4 == 0, 3.0 * e, -e)
        carried = {"magnetometer": FIELD_NED + off[:, None] * way, "accelerometer": G * np.ones((n, 3))}
        found = initialise._means(r, carried, 0.2, 1.5)
        far, near = (1.0 / (1.0 + (x / limit) ** 2) for x in (3.0 * e, e))
        expected = (3.0 * e * far - 3.0 * e * near) / (far + 3.0 * near)
        inner = slice(n // 4, -n // 4)
        np.testing.assert_allclose(
            found["magnetometer"][inner] - FIELD_NED, np.tile(expected * way, (n // 2, 1)), atol=1e-3
        )
        np.testing.assert_allclose(found["accelerometer"], G)
    assert initialise._means(r, {"accelerometer": carried["accelerometer"]}, 0.2, 1.5).keys() == {"accelerometer"}


def blank(t: Array, segment: np.ndarray, **changes: Any) -> Readings:
    n = len(t)
    given: dict[str, Any] = {
        "t": t, "segment": segment, "gyroscope": np.zeros((n, 3)), "accelerometer": None, "magnetometer": None,
        "gravity_mps2": G, "field_ned": FIELD_NED, "turning": np.zeros((2, n, 3)),
    }  # fmt: skip
    return Readings(**{**given, **changes})


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_vectors_tell_the_attitude_both_exactly_and_one_by_the_shortest_turn(sign: float) -> None:
    t = np.arange(50) / RATE_HZ
    r = blank(t, np.zeros(50, dtype=np.int64), gravity_mps2=sign * G)
    q = from_rotation_vector(np.random.default_rng(9).normal(size=(50, 3)))
    seen = {
        "magnetometer": 3.0 * body_from_inertial(q) @ FIELD_NED,
        "accelerometer": sign * G * body_from_inertial(q)[..., 2],
    }
    assert angle(initialise._turned_to(r, seen), q).max() < 1e-6
    for name, vector in seen.items():
        found = initialise._turned_to(r, {name: vector})
        true = FIELD_NED / np.linalg.norm(FIELD_NED) if name == "magnetometer" else np.array([0.0, 0.0, sign])
        length = np.linalg.norm(vector, axis=1)
        turned = np.einsum("nji,nj->ni", body_from_inertial(found), vector) / length[:, None]
        np.testing.assert_allclose(turned, np.tile(true, (50, 1)), atol=1e-9)
        between = np.arccos(vector @ true / length)
        np.testing.assert_allclose(angle(found, [0.0, 0.0, 0.0, 1.0]), between, atol=1e-7)
    nothing = initialise._turned_to(r, {"accelerometer": np.zeros((50, 3))})
    assert np.isfinite(nothing).all()


@pytest.mark.parametrize("side_s", [0.5, 2.0])
def test_means_wander_by_their_turn_over_both_sides(side_s: float) -> None:
    t = np.arange(1024) / RATE_HZ
    turned = from_rotation_vector(0.05 * t[:, None] * np.array([[0.6, 0.0, 0.8]]))
    assert initialise._wander(t, turned, side_s) == pytest.approx(0.05 * 2.0 * side_s)
    assert initialise._wander(t, turned, 4.0) == np.inf
    assert initialise._wander(t, turned, 3.99) == pytest.approx(0.05 * 7.98, rel=1e-2)


def test_readings_are_filled_along_time() -> None:
    t = np.cumsum(np.random.default_rng(10).uniform(0.5, 1.5, 40))
    x = np.column_stack([t, 2.0 * t, 1.0 - t])
    holed = x.copy()
    holed[[3, 4, 20]] = np.nan
    holed[30, 1] = np.nan
    np.testing.assert_allclose(initialise.filled(t, holed), x, rtol=1e-12)
    assert initialise.filled(t, x) is x


def flown(*, seconds: float = 20.0, sign: float = 1.0, parts: int = 1) -> tuple[Readings, Array]:
    """Exact readings of a turning vehicle, and its attitudes; in so many stretches."""
    t = np.arange(round(seconds * RATE_HZ)) / RATE_HZ
    rate = turning_rates(t, np.random.default_rng(11))
    q = propagate(t, rate, from_rotation_vector([0.3, -0.2, 1.0]))
    turn = body_from_inertial(q)
    sensed = {"gyroscope": rate, "accelerometer": sign * G * turn[..., 2], "magnetometer": turn @ FIELD_NED}
    logged = {name: (x - BIAS[name]) / SCALE[name] for name, x in sensed.items()}
    segment = (np.arange(len(t)) * parts // len(t)).astype(np.int64)
    low = turning(t, segment, logged["gyroscope"])
    return blank(t, segment, **logged, turning=low, gravity_mps2=sign * G), q


CONSTANTS = {name: (SCALE[name], BIAS[name]) for name in SCALE}


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("parts", [1, 2])
def test_a_record_is_prepared_at_its_truth(sign: float, parts: int) -> None:
    r, q = flown(sign=sign, parts=parts)
    model, state = prepare(r, CONSTANTS, lever_arm=np.array([0.1, 0.2, 0.3]))
    assert angle(state.q, q[model.knots.index]).max() < 20.0 * INTEGRATED_RAD
    assert state.motion.shape == (len(model.knots.index), 9)
    assert not state.motion.any()
    assert state.values["lever_arm"].tolist() == [0.1, 0.2, 0.3]
    assert state.values["dip"] == pytest.approx(np.arctan2(FIELD_NED[2], np.hypot(*FIELD_NED[:2])))
    for name in SCALE:
        scale, bias = model.triads[name].logged(state.values[name])
        np.testing.assert_allclose(scale, SCALE[name])
        np.testing.assert_allclose(bias, BIAS[name])
    assert np.max(model.knots.interval_s[model.knots.joined]) <= 0.08 + 1.0 / RATE_HZ
    again = anew(model, replace(state, q=np.roll(state.q, 5, axis=0), motion=state.motion + 1.0))
    assert angle(again.q, state.q).max() < 1e-6
    assert not again.motion.any()
    assert again.values is state.values
    assert prepare(r, CONSTANTS)[1].values["lever_arm"].tolist() == [0.0, 0.0, 0.0]


def test_the_gyroscope_s_start_comes_from_attitudes_where_both_vectors_tell_them() -> None:
    r, _ = flown(seconds=40.0)
    model, state = prepare(r, {**CONSTANTS, "gyroscope": None})
    scale, bias = model.triads["gyroscope"].logged(state.values["gyroscope"])
    np.testing.assert_allclose(scale, SCALE["gyroscope"], rtol=0.02)
    np.testing.assert_allclose(bias, BIAS["gyroscope"], atol=0.01)
    with pytest.raises(UnusableFlight) as error:
        prepare(r, {**CONSTANTS, "gyroscope": None, "magnetometer": None})
    assert error.value.reason_code == "no_start"
    with pytest.raises(UnusableFlight):
        prepare(r, {**CONSTANTS, "accelerometer": None, "magnetometer": None})


def test_a_triad_without_a_start_is_left_out() -> None:
    r, _ = flown()
    model, state = prepare(r, {**CONSTANTS, "magnetometer": None})
    assert model.vectors == ("accelerometer",)
    assert "magnetometer" not in state.values
    assert model.readings.magnetometer is None
    model, state = prepare(replace(r, magnetometer=None), CONSTANTS)
    assert (model.vectors, "magnetometer" in state.values) == (("accelerometer",), False)


def test_vectors_are_averaged_by_the_rms_rate_times_three() -> None:
    """At 128 Hz three samples are 23 ms: never; at 512 Hz while 3 · rms rate · time is below 0.1 rad."""
    t = np.arange(10240) / 512.0
    bias = np.array([2.0, -2.0, 2.0])
    for rms_radps, side in ((0.5, 4), (3.0, 2), (3.37, 2), (3.6, 1), (8.0, 0)):  # 5.06 samples at 3.37 rad/s
        rate = np.tile(rms_radps * np.array([0.6, 0.0, 0.8]), (len(t), 1))
        q = propagate(t, rate, np.array([0.0, 0.0, 0.0, 1.0]))
        turn = body_from_inertial(q)
        sensed = {"gyroscope": rate, "accelerometer": G * turn[..., 2], "magnetometer": turn @ FIELD_NED}
        rng = np.random.default_rng(12)
        constants = {**CONSTANTS, "gyroscope": (SCALE["gyroscope"], bias)}
        noisy = {n: x + 1e-6 * rng.normal(size=x.shape) for n, x in sensed.items()}
        logged = {n: (x - constants[n][1]) / SCALE[n] for n, x in noisy.items()}
        low = np.stack([logged["gyroscope"], np.zeros_like(rate)])
        model, _ = prepare(blank(t, np.zeros(len(t), dtype=np.int64), **logged, turning=low), constants)
        assert int(np.diff(model.at)[0]) == 2 * side + 1


def test_a_drifting_gyroscope_takes_short_means_and_a_steady_one_with_translation_long_ones() -> None:
    """The attitude is the vectors' where the gyroscope drifts by 0.1 rad/s; and the gyroscope's, over half a minute,
    where translation shakes the vectors for seconds."""
    r, q = flown(seconds=60.0)
    drifting = {**CONSTANTS, "gyroscope": (SCALE["gyroscope"], BIAS["gyroscope"] + 0.1)}
    model, state = prepare(r, drifting)
    inner = slice(100, -100)
    # Over 1.5 s on either side a constant drift averages out but for the ends.
    assert angle(state.q, q[model.knots.index])[inner].max() < 0.05
    assert r.accelerometer is not None
    shaken = r.accelerometer + 2.0 * np.sin(2.0 * np.pi * 0.13 * r.t)[:, None] / SCALE["accelerometer"]
    model, state = prepare(replace(r, accelerometer=shaken), CONSTANTS)
    off = angle(state.q, q[model.knots.index])[inner]
    vectors = {
        "accelerometer": shaken * SCALE["accelerometer"] + BIAS["accelerometer"],
        "magnetometer": body_from_inertial(q) @ FIELD_NED,
    }
    alone = angle(initialise._turned_to(r, vectors), q)
    assert np.sqrt(np.mean(off**2)) < 0.7 * np.sqrt(np.mean(alone**2))


def test_rates_by_attitudes_are_those_that_were_flown() -> None:
    r, q = flown(seconds=40.0, parts=2)
    fit = initialise.gyro_from_attitude(r.t, r.segment, r.gyroscope, q)
    np.testing.assert_allclose(fit.scale, SCALE["gyroscope"], rtol=5e-3)
    np.testing.assert_allclose(fit.bias, BIAS["gyroscope"], atol=2e-3)
    again = multiply(conjugate(q[:1]), q)
    same = initialise.gyro_from_attitude(r.t, r.segment, r.gyroscope, again)
    np.testing.assert_allclose(same.scale, fit.scale, rtol=1e-6)
