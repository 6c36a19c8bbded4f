"""The accelerometer by position: its rows against the equation of motion, its limits from both sides."""

from __future__ import annotations

import warnings
from functools import partial

import numpy as np
import pytest
from numpy.typing import ArrayLike
from scipy.special import j1

from fieldcal.errors import UnusableFlight
from fieldcal.estimation.by_pose import accelerometer
from fieldcal.estimation.by_pose.accelerometer import fit_accelerometer
from fieldcal.estimation.by_pose.triad import TriadByPose
from fieldcal.estimation.statistics import colour, least_squares_covariance
from fieldcal.geometry.rotation import Array, body_from_inertial, from_rotation_vector, multiply

G = 9.81
ARM = np.array([0.05, 0.02, -0.03])
MATRIX = np.array([[1.02, 0.0, 0.0], [0.01, 0.985, 0.0], [-0.015, 0.008, 1.01]])
BIAS = np.array([0.2, -0.3, 0.15])
LATE_S = 0.004
AMPLITUDE_M, OMEGA_RADPS = np.array([0.3, 0.2, 0.25]), 2.0 * np.pi * np.array([0.4, 0.3, 0.5])
TURN_RADPS = 2.0 * np.pi * 0.15
DISCRETISATION = 2e-3  # m/s²: a spline through positions, a low-pass that rolls off, a slope over five samples


class Swung:
    """Turns about an axis aslant, there and back, and swings in position: everything in closed form."""

    AXIS = np.array([0.6, 0.64, 0.48])

    def __init__(self, t: Array, t_vps: Array, sign: float = -1.0, late_s: float = 0.0) -> None:
        self.t, self.t_vps, self.sign = t, t_vps, sign
        self.q = self.attitude(t)
        self.position = self.at(t_vps)
        self.logged = self.read(t - late_s)

    @classmethod
    def attitude(cls, t: Array) -> Array:
        return from_rotation_vector(1.4 * np.sin(TURN_RADPS * t)[:, None] * cls.AXIS)

    @staticmethod
    def at(t: Array) -> Array:
        return AMPLITUDE_M * np.sin(OMEGA_RADPS * t[:, None])

    def read(self, t: Array) -> Array:
        """Of a sensor at ARM from the VPS's point: what turns about one axis has acceleration α × r + ω × (ω × r)."""
        rate = 1.4 * TURN_RADPS * np.cos(TURN_RADPS * t)[:, None] * self.AXIS
        change = -1.4 * TURN_RADPS**2 * np.sin(TURN_RADPS * t)[:, None] * self.AXIS
        about = np.cross(change, ARM) + np.cross(rate, np.cross(rate, ARM))
        of_point = -AMPLITUDE_M * OMEGA_RADPS**2 * np.sin(OMEGA_RADPS * t[:, None])
        gravity = np.array([0.0, 0.0, G])
        force = np.einsum("nij,nj->ni", body_from_inertial(self.attitude(t)), of_point - gravity) + about
        return (-self.sign * force - BIAS) @ np.linalg.inv(MATRIX).T

    def rows(self, cutoff_hz: float, **changes: Array) -> list[tuple[Array, Array]]:
        given = {name: changes.get(name, getattr(self, name)) for name in ("logged", "position", "t_vps", "q")}
        valid = np.isfinite(given["logged"]).all(axis=1)
        products = partial(
            accelerometer._products, self.t, given["logged"], valid, given["q"], given["t_vps"], given["position"]
        )
        segment = changes.get("segment", np.zeros(len(self.t), dtype=np.int64))
        return accelerometer._rows(products, segment, given["t_vps"], self.sign * G, 0.05, cutoff_hz)

    def fitted(self, **changes: Array) -> TriadByPose:
        given = {name: changes.get(name, getattr(self, name)) for name in ("logged", "q", "position", "t_vps")}
        return fit_accelerometer(
            self.t, np.zeros(len(self.t), dtype=np.int64), given["logged"], given["q"], given["t_vps"],
            given["position"], gravity_mps2=self.sign * G, max_gap_s=0.05,
        )  # fmt: skip


def swung(rate_hz: float, seconds: float, sign: float = -1.0, late_s: float = 0.0) -> Swung:
    t = np.arange(round(rate_hz * seconds) + 1) / rate_hz
    return Swung(t, np.arange(-0.05, seconds + 0.05, 0.01), sign, late_s)


@pytest.mark.parametrize("sign", [-1.0, 1.0])
@pytest.mark.parametrize(("rate_hz", "cutoff_hz"), [(200.0, 5.0), (100.0, 2.5)])
def test_every_row_is_the_equation_of_motion(sign: float, rate_hz: float, cutoff_hz: float) -> None:
    """s R (M x + b) + s R M x′ · delay + (R r)″ − g τ = g e_z − p″, term by term, for both signs of gravity."""
    ((columns, y),) = swung(rate_hz, 30.0, sign, LATE_S).rows(cutoff_hz)
    delay = LATE_S * MATRIX.ravel()
    theta = np.r_[MATRIX.ravel(), BIAS, delay, ARM, 0.0, 0.0]
    assert np.abs(columns @ theta - y).max() < DISCRETISATION
    assert columns[..., 24:].tolist() == np.broadcast_to(-G * np.eye(3)[:, :2], (len(y), 3, 2)).tolist()


def test_a_small_tilt_of_the_world_is_its_column() -> None:
    flight, tilt = swung(200.0, 20.0), np.array([0.004, -0.003])
    # Gravity g (e_z + τ) in axes turned so.
    turn = np.cross([0.0, 0.0, 1.0], [*tilt, 0.0])
    world = from_rotation_vector(turn)
    ((columns, y),) = flight.rows(
        5.0, q=multiply(world, flight.q), position=flight.position @ body_from_inertial(world)
    )
    theta = np.r_[MATRIX.ravel(), BIAS, np.zeros(9), ARM]
    assert np.abs(columns[..., :24] @ theta + columns[..., 24:] @ tilt - y).max() < DISCRETISATION
    assert np.abs(columns[..., :24] @ theta - y).max() > 0.9 * G * 0.004


@pytest.mark.parametrize(
    ("rate_hz", "cutoff_hz", "n_samples", "n_rows"),
    [
        # Every (int(rate/80))th sample; 3 periods of the cut-off off either end; five rows a period.
        (200.0, 5.0, 4001, (2001 - 2 * 60 + 3) // 4),
        (200.0, 0.6, 4001, (2001 - 2 * 500 + 32) // 33),
        (128.0, 5.0, 2561, (2561 - 2 * 77 + 4) // 5),
        (160.0, 2.5, 3201, (1601 - 2 * 96 + 5) // 6),
        (1000.0, 1.2, 20001, (1667 - 2 * 208 + 13) // 14),
        (8.0, 5.0, 161, 161 - 2 * 5),
    ],
)
def test_five_rows_a_period_without_the_ends(rate_hz: float, cutoff_hz: float, n_samples: int, n_rows: int) -> None:
    flight = swung(rate_hz, 20.0)
    assert len(flight.t) == n_samples
    ((columns, y),) = flight.rows(cutoff_hz)
    assert (columns.shape, y.shape) == ((n_rows, 3, 26), (n_rows, 3))


def test_what_turns_as_fast_as_it_is_read_is_in_the_product_where_nothing_is_thinned() -> None:
    """x = cos ωt along an axis that swings by a cos ωt: its mean across is J₁(a). Before it is thinned each passes a
    low-pass, which rolls off from 20 Hz to 20 Hz + π/0.3 s as a raised cosine does."""
    a = 0.1
    at_25_hz = 0.5 * (1.0 + np.cos(np.pi * 5.0 / (np.pi / 0.3)))
    for rate_hz, frequency_hz, share in ((128.0, 30.0, 1.0), (256.0, 31.0, 0.0), (256.0, 25.0, at_25_hz**2)):
        flight, omega = swung(rate_hz, 8.0), 2.0 * np.pi * frequency_hz
        wave = np.cos(omega * flight.t)
        turned = from_rotation_vector(a * wave[:, None] * [0.0, 0.0, 1.0])
        logged = np.column_stack([wave, 0.0 * wave, 0.0 * wave])
        ((columns, _),) = flight.rows(2.5, logged=logged, q=turned)
        assert columns[:, 1, 0] == pytest.approx(-share * j1(a), abs=1e-3)  # s R_yx x


def test_the_stretch_is_what_the_positions_cover_both_ends_included() -> None:
    """128 Hz: 385 samples from 1 s to 4 s, 77 left out at either end, every fifth of the others."""
    t = np.arange(1000) / 128.0
    vps = np.arange(64, 257) / 64.0
    flight = Swung(t, vps)
    ((_, y),) = flight.rows(5.0)
    assert len(y) == 47
    # One sample less, and it is shorter than three seconds.
    assert flight.rows(5.0, t_vps=vps[1:], position=flight.position[1:]) == []
    assert flight.rows(5.0, t_vps=vps[:-1], position=flight.position[:-1]) == []


@pytest.mark.parametrize(("n", "n_rows"), [(20, 14), (19, 0)])
def test_twenty_samples_make_a_stretch(n: int, n_rows: int) -> None:
    t = 0.2 * np.arange(n) + 0.01
    flight = Swung(t, np.arange(0.0, 4.0, 0.02))
    assert sum(len(y) for _, y in flight.rows(5.0)) == n_rows


def test_stretches_of_either_side_are_taken_apart() -> None:
    """A pause of the IMU at 6 s and of the positions at 13 s, and a second of no readings."""
    flight = swung(200.0, 20.0)
    segment = (flight.t > 6.0).astype(np.int64)
    kept = (flight.t_vps < 13.0) | (flight.t_vps > 13.2)
    logged = flight.logged.copy()
    logged[3000:3003, 1] = np.nan
    rows = flight.rows(5.0, segment=segment, t_vps=flight.t_vps[kept], position=flight.position[kept], logged=logged)
    assert len(rows) == 3
    theta = np.r_[MATRIX.ravel(), BIAS, np.zeros(9), ARM, 0.0, 0.0]
    for columns, y in rows:
        assert np.abs(columns @ theta - y).max() < DISCRETISATION


def test_second_derivatives_are_exact_up_to_the_fifth_power() -> None:
    t = 0.5 * np.arange(12)
    x = np.stack([t**5, t**4 - 3.0 * t**2, t], axis=1)
    expected = np.stack([20.0 * t**3, 12.0 * t**2 - 6.0, 0.0 * t], axis=1)
    expected[[0, 1, -2, -1]] = 0.0
    np.testing.assert_allclose(accelerometer._second_derivative(x, 0.5), expected, atol=1e-8)


def asked(monkeypatch: pytest.MonkeyPatch, interval_s: float, max_gap_s: float) -> list[tuple[float, float]]:
    """Cut-offs at which rows are asked for, Hz, and the longest gap, s."""
    seen = []

    def none(*given: object) -> list[tuple[Array, Array]]:
        seen.append((given[-1], given[-2]))
        return []

    monkeypatch.setattr(accelerometer, "_rows", none)
    t = np.arange(0.0, 30.0, 0.01)
    flight = Swung(t, np.arange(0.0, 30.0, interval_s))
    with pytest.raises(UnusableFlight):
        fit_accelerometer(
            t, np.zeros(len(t), dtype=np.int64), flight.logged, flight.q, flight.t_vps, flight.position,
            gravity_mps2=-G, max_gap_s=max_gap_s,
        )  # fmt: skip
    return seen  # type: ignore[return-value]


def test_slower_motion_is_asked_for_across_longer_gaps(monkeypatch: pytest.MonkeyPatch) -> None:
    """A tenth of the cut-off's period, where that is longer than the gap allowed."""
    assert asked(monkeypatch, 0.01, 0.05) == [
        (5.0, 0.05), (2.5, 0.05), (1.2, pytest.approx(0.1 / 1.2)), (0.6, pytest.approx(0.1 / 0.6)),
    ]  # fmt: skip


def test_a_cut_off_has_six_positions_a_period(monkeypatch: pytest.MonkeyPatch) -> None:
    found = asked(monkeypatch, 0.1, 0.5)
    assert [cutoff for cutoff, _ in found] == pytest.approx([1.0 / 0.6, 1.2, 0.6])
    assert [cutoff for cutoff, _ in asked(monkeypatch, 1.0 / 3.0, 0.5)] == pytest.approx([0.5])


@pytest.mark.parametrize(("n", "enough"), [(1033, True), (1032, False)])
def test_a_hundred_rows_are_enough(n: int, enough: bool) -> None:
    """At 200 Hz every second sample, 60 of them left out at either end, every fourth of the others."""
    t = np.arange(n) / 200.0
    flight = Swung(t, np.arange(-0.05, t[-1] + 0.05, 0.01))
    if enough:
        assert flight.fitted().weight.shape == (100,)
        return
    with pytest.raises(UnusableFlight):
        flight.fitted()


def test_a_reading_with_a_part_missing_is_none() -> None:
    flight = swung(100.0, 10.0)
    part, whole = flight.logged.copy(), flight.logged.copy()
    part[500:503, 1], whole[500:503] = np.nan, np.nan
    one, other = flight.fitted(logged=part), flight.fitted(logged=whole)
    assert one.matrix.tolist() == other.matrix.tolist()
    assert np.isfinite(one.matrix).all()


def test_no_reading_at_all_is_refused_in_silence() -> None:
    flight = swung(100.0, 10.0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(UnusableFlight):
            flight.fitted(logged=np.full_like(flight.logged, np.nan))


def made(scales: ArrayLike, sd: ArrayLike, name: float) -> TriadByPose:
    """A fit with these scales and sd, which is known again by its delay."""
    rng = np.random.default_rng(int(name))
    value, variance = rng.normal(size=12), np.full(12, 1e-8)
    value[[0, 4, 8]], variance[[0, 4, 8]] = scales, np.square(sd)
    return TriadByPose(value[:9].reshape(3, 3), value[9:], np.diag(variance), name, 0.0, 0.0, np.ones(1), 1.0)


@pytest.mark.parametrize("way", [1.0, -1.0])
@pytest.mark.parametrize(
    ("far", "sd", "chosen"),
    [(0.5, 0.47, 2.0), (0.4, 0.47, 1.0), (0.44, 0.45, 1.0), (0.46, 0.44, 3.0), (0.43, 0.42, 3.0)],
)
def test_the_cut_off_is_that_of_the_least_error(way: float, far: float, sd: float, chosen: float) -> None:
    """Three fits: sharp and `far` from the last; 0.2 from it with an sd of 0.4, which is 0.447 together; the last with
    an sd of `sd`. Each in the scale that is worst."""
    last = np.array([1.0, 2.0, 3.0])
    for axis in range(3):
        off = way * np.eye(3)[axis]
        fits = [
            made(last + far * off, np.full(3, 0.01), 1.0),
            made(last + 0.2 * off, 0.4 * np.abs(off) + 1e-3, 2.0),
            made(last, sd * np.abs(off) + 1e-3, 3.0),
        ]
        best = accelerometer._best(fits, np.zeros(3), 1.0)
        assert best.delay_s == chosen


def test_half_of_the_spread_over_cut_offs_is_in_the_sd_and_all_is_in_logged_units() -> None:
    """Logged = centre + spread · centred, so that M = M′/spread and b = b′ − M centre, whatever the covariance."""
    rng, centre, spread = np.random.default_rng(3), np.array([1.0, -2.0, 3.0]), 0.25
    fits = [made((1.0, 2.0, 3.0), np.full(3, 0.1), 1.0), made((1.3, 2.1, 2.5), np.full(3, 0.9), 2.0)]
    best = accelerometer._best(fits, centre, spread)
    own = fits[int(best.delay_s) - 1]
    reading = rng.normal(size=3)
    expected = own.matrix @ ((reading - centre) / spread) + own.bias
    np.testing.assert_allclose(best.matrix @ reading + best.bias, expected, rtol=1e-12)
    spanned = [abs(a - b) for a, b in zip(*([*fit.matrix.flat, *fit.bias] for fit in fits), strict=True)]
    variance = np.diagonal(own.covariance) + np.square(spanned) / 4.0
    # What is uncertain of a calibrated reading is the same in either units.
    at = np.hstack([np.kron(np.eye(3), (reading - centre) / spread), np.eye(3)])
    logged = np.hstack([np.kron(np.eye(3), reading), np.eye(3)])
    np.testing.assert_allclose(logged @ best.covariance @ logged.T, at @ np.diag(variance) @ at.T, rtol=1e-9)


NOISE_MPS2, ROWS, OUTLIERS = 0.05, 1000, 100
SHARP = 0.12  # relative: an sd from a thousand residuals, of which a taper keeps the correlation of a tenth


TILT_KNOWN = 0.02  # relative: the tilt is taken from the truth, not from the fit


def linear(seed: int, noise: float = NOISE_MPS2) -> tuple[Array, Array, Array]:
    """Columns without any motion behind them, right-hand side with noise, and the numbers behind it (18,)."""
    rng = np.random.default_rng(seed)
    truth = np.r_[MATRIX.ravel(), BIAS, LATE_S, ARM, 0.02, -0.03]
    columns = rng.normal(size=(ROWS, 3, 26))
    columns[..., 24:] = -G * np.eye(3)[:, :2]
    columns[:, :, 9:12] = rng.normal(size=(ROWS, 3, 3))
    late = LATE_S * MATRIX.ravel()
    y = columns @ np.r_[MATRIX.ravel(), BIAS, late, ARM, 0.02, -0.03]
    y[:, 2] += G * (1.0 - np.sqrt(1.0 - 0.02**2 - 0.03**2))  # a tilted vertical is as long as a level one
    y += noise * rng.normal(size=y.shape)
    return columns, y, truth


def test_the_regression_is_least_squares_with_its_sd() -> None:
    """Against the normal equations written out at the truth: of columns and noise that are white."""
    z = []
    for seed in range(4):
        columns, y, truth = linear(seed)
        fit = accelerometer._solved(columns, y, G)
        x = np.concatenate([columns[..., :12], (columns[..., 12:21] @ truth[:9])[..., None], columns[..., 21:]], axis=2)
        flat = x.reshape(-1, 18)
        sd = NOISE_MPS2 * np.sqrt(np.diagonal(np.linalg.inv(flat.T @ flat)))
        assert fit.lever_arm_m is not None
        assert fit.lever_arm_sd_m is not None
        found = np.r_[fit.matrix.ravel(), fit.bias, fit.delay_s, fit.lever_arm_m]
        claimed = np.r_[np.sqrt(np.diagonal(fit.covariance)), fit.delay_sd_s, fit.lever_arm_sd_m]
        z.append((found - truth[:16]) / sd[:16])
        assert np.abs(np.log(claimed / sd[:16])).max() < 3.0 * SHARP
        assert np.abs(np.log(claimed / sd[:16])).mean() < SHARP
        assert fit.misfit == pytest.approx(np.sqrt(3.0) * NOISE_MPS2 / G, rel=SHARP)
        assert fit.colour == pytest.approx(1.0, abs=3.0 * SHARP)
    assert 0.75 < np.sqrt(np.mean(np.square(z))) < 1.25


def test_without_noise_it_ends_at_the_truth() -> None:
    columns, y, truth = linear(5, noise=0.0)
    fit = accelerometer._solved(columns, y, G)
    np.testing.assert_allclose(np.r_[fit.matrix.ravel(), fit.bias, fit.delay_s], truth[:13], atol=1e-9)


def test_a_tenth_of_wrong_rows_hardly_counts_and_what_is_told_is_of_the_weighed_rows() -> None:
    """The residuals of the solution as the equation of motion leaves them; covariance, misfit and colour by their
    definitions."""
    columns, y, truth = linear(7)
    y[:OUTLIERS] += 30.0
    fit = accelerometer._solved(columns, y, G)
    assert np.abs(np.r_[fit.matrix.ravel(), fit.bias] - truth[:12]).max() < 0.03
    assert fit.weight[:OUTLIERS].max() < 0.02
    assert fit.weight[OUTLIERS:].mean() > 0.9
    assert fit.lever_arm_m is not None
    assert fit.lever_arm_sd_m is not None
    x = columns[..., :18].copy()
    x[..., 12], x[..., 13:] = columns[..., 12:21] @ fit.matrix.ravel(), columns[..., 21:]
    known = x[..., :16] @ np.r_[fit.matrix.ravel(), fit.bias, fit.delay_s, fit.lever_arm_m]
    residual = y - known - x[..., 16:] @ truth[16:] - [0.0, 0.0, G * (1.0 - np.sqrt(1.0 - truth[16:] @ truth[16:]))]
    root = np.sqrt(fit.weight)[:, None]
    covariance = least_squares_covariance(x * root[..., None], residual * root)[1]
    np.testing.assert_allclose(np.diagonal(fit.covariance), np.diagonal(covariance)[:12], rtol=TILT_KNOWN)
    np.testing.assert_allclose(fit.lever_arm_sd_m, np.sqrt(np.diagonal(covariance)[13:16]), rtol=TILT_KNOWN)
    assert fit.misfit == pytest.approx(np.sqrt(np.sum((residual * root) ** 2) / np.sum(root**2)) / G, rel=TILT_KNOWN)
    assert fit.colour == pytest.approx(colour(residual * root), rel=TILT_KNOWN)


def test_a_wrong_row_is_told_on_the_quietest_axis() -> None:
    """Twenty sd of the quiet axis, two of the loud ones."""
    columns, y, _ = linear(11, noise=0.0)
    sd = np.array([0.05, 0.5, 0.5])
    y += sd * np.random.default_rng(1).normal(size=y.shape)
    y[::20, 0] += 1.0
    weight = accelerometer._solved(columns, y, G).weight
    assert weight[::20].max() < 0.5
    assert np.median(weight) > 0.9
