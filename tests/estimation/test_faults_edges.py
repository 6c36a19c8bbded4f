"""Each limit of the channel checks met from both sides, with readings whose numbers are known by counting."""

from __future__ import annotations

import re

import numpy as np
import pytest

from fieldcal.estimation.faults import (
    Fault,
    accelerometer_unit,
    channel_faults,
    coarse_faults,
    gyroscope_unit,
    magnetometer_unit,
    sampling_faults,
)

TICK_S = 1.0 / 16.0
"""A sum of powers of two: times are exact."""
G = 9.80665


def of_x(x: np.ndarray, sensor: str = "magnetometer", si_scale: float | None = None) -> list[Fault]:
    """Faults of the x axis; y and z live."""
    t = TICK_S * np.arange(len(x))
    living = np.sin(np.arange(len(x)))
    found = channel_faults(sensor, t, np.stack([x, living, 2.0 * living], axis=1), "mG", si_scale)
    assert all(fault.axis == "x" for fault in found)
    return found


def holding(*holds: int) -> np.ndarray:
    """A channel that holds one value after the other for so many samples."""
    return np.repeat(np.sin(np.arange(len(holds))), holds)


@pytest.mark.parametrize("length", [2, 10, 500])
def test_a_channel_that_never_changes_is_dead(length: int) -> None:
    for value, code in ((0.0, "all_zero"), (1.0, "stuck"), (-0.125, "stuck")):
        x = np.stack([np.full(length, value), np.arange(length), np.arange(length)], axis=1)
        (fault,) = channel_faults("magnetometer", np.arange(length), x, "mG", None)
        assert (fault.code, fault.value, fault.limit, fault.fatal) == (code, 1.0, 0.02, True)
        assert f"reads {value:.6g} mG in all {length} samples" in fault.sentence


@pytest.mark.parametrize(("ticks", "stuck"), [(16, False), (17, True)])
def test_a_channel_that_changes_at_every_sample_may_stand_for_a_second(ticks: int, stuck: bool) -> None:
    found = of_x(holding(*[1] * 500, ticks + 1, *[1] * 500))
    assert [f.code for f in found] == (["stuck"] if stuck else [])


@pytest.mark.parametrize(("ticks", "stuck"), [(50, False), (51, True)])
def test_one_that_holds_its_values_may_stand_fifty_times_as_long(ticks: int, stuck: bool) -> None:
    """Held for one tick as a rule: two equal samples."""
    found = of_x(holding(*[2] * 500, ticks + 1, *[2] * 500))
    assert [f.code for f in found] == (["stuck"] if stuck else [])


@pytest.mark.parametrize(("long", "stuck"), [(10, True), (11, False)])
def test_the_ten_longest_do_not_say_how_long_values_are_held(long: int, stuck: bool) -> None:
    """Of thirty values; with eleven long ones among them holding long is what the channel does."""
    found = of_x(holding(*[41] * long, *[1] * (30 - long)))
    assert [f.code for f in found] == (["stuck"] if stuck else [])
    assert of_x(holding(1, 1, 40, 1, 1))[0].code == "stuck"


@pytest.mark.parametrize(("ticks", "fatal"), [(1001, False), (1000, False), (999, True)])
def test_standing_for_two_per_cent_of_the_recording_is_bearable(ticks: int, fatal: bool) -> None:
    """20 ticks of so many."""
    before = 300
    (fault,) = of_x(holding(*[1] * before, 21, *[1] * (ticks + 1 - 21 - before)))
    assert (fault.value, fault.limit, fault.fatal) == (20 / ticks, 0.02, fatal)


def test_all_that_it_stood_is_told_with_the_longest() -> None:
    x = holding(*[1] * 300, 33, *[1] * 100, 49, *[1] * 200, 25, *[1] * 300)
    (fault,) = of_x(x)
    ticks = len(x) - 1
    assert fault.value == pytest.approx((32 + 48 + 24) / ticks, rel=1e-12)
    value = float(np.sin(401))
    share = 100 * 104 / ticks
    assert f"stands at {value:.6g} mG for 3.0 s ({share:.1f} % of the recording" in fault.sentence


@pytest.mark.parametrize(("jump", "stuck"), [(99, False), (100, True), (120, True), (140, True), (141, False)])
def test_a_hold_is_a_stuck_channel_s_where_another_axis_moves_within_it(jump: int, stuck: bool) -> None:
    """From the 100th sample to the 140th; a coarse sensor that lies still takes a step or two of its resolution."""
    n = 300
    x = np.sin(np.arange(n))
    x[100:141] = x[100]
    still = np.arange(n) % 2.0
    still[jump] = 5.0
    found = channel_faults(
        "magnetometer", TICK_S * np.arange(n), np.stack([x, still, np.arange(n) % 3.0], axis=1), "mG", None
    )
    assert [f.code for f in found if f.axis == "x"] == (["stuck"] if stuck else [])


@pytest.mark.parametrize(("steps", "stuck"), [(2.0, False), (3.0, True)])
def test_two_steps_are_still(steps: float, stuck: bool) -> None:
    n = 300
    x = np.sin(np.arange(n))
    x[100:141] = x[100]
    beside = np.arange(n) % 2.0
    beside[120] = steps
    found = channel_faults(
        "magnetometer", TICK_S * np.arange(n), np.stack([x, beside, np.arange(n) % 2.0], axis=1), "mG", None
    )
    assert [f.code for f in found if f.axis == "x"] == (["stuck"] if stuck else [])


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_logger_that_froze_stands_on_all_axes(axis: int) -> None:
    x = np.stack([np.sin(np.arange(300.0) + i) for i in range(3)], axis=1)
    x[100:141] = x[100]
    found = channel_faults("magnetometer", TICK_S * np.arange(300), x, "mG", None)
    assert [(f.code, f.axis) for f in found if f.axis == "xyz"[axis]] == [("stuck", "xyz"[axis])]


@pytest.mark.parametrize("step", [1.0, 0.01, 50.0])
@pytest.mark.parametrize(("n_levels", "coarse"), [(34, True), (35, False)])
def test_a_step_of_a_tenth_of_the_spread_is_coarse(n_levels: int, coarse: bool, step: float) -> None:
    """So many levels, each held five times as long as a sample, up and down: their sd is √((n² − 1)/12) steps."""
    once = np.repeat(np.arange(float(n_levels)), 5)
    x = step * np.tile(np.r_[once, once[::-1]], 4)
    found = coarse_faults("gyroscope", np.stack([x, np.sin(np.arange(len(x))), x], axis=1), "rad/s")
    assert [(f.axis, f.code, f.fatal) for f in found] == (
        [("x", "coarse", True), ("z", "coarse", True)] if coarse else []
    )
    for fault in found:
        assert fault.value == pytest.approx(1.0 / np.sqrt((n_levels**2 - 1) / 12.0))
        assert fault.limit == 0.1
        assert f"in steps of {step:.3g} rad/s where it varies by {step / fault.value:.3g} rad/s" in fault.sentence


@pytest.mark.parametrize(("changes", "coarse"), [(300, True), (301, False)])
def test_noise_over_steps_is_noise_where_three_in_ten_readings_differ(changes: int, coarse: bool) -> None:
    changed = np.zeros(1000, bool)
    changed[np.round(np.linspace(0, 999, changes)).astype(int)] = True
    x = (-1.0) ** np.cumsum(np.r_[0, changed])
    found = coarse_faults("gyroscope", np.stack([x, x, x], axis=1), "rad/s")
    assert len(found) == (3 if coarse else 0)


def test_a_channel_that_never_changes_is_not_called_coarse() -> None:
    assert coarse_faults("gyroscope", np.ones((100, 3)), "rad/s") == []


def levels(*counts: int, seed: int = 1) -> np.ndarray:
    """So many samples of the levels 0, 1, 2 …, shuffled."""
    x = np.repeat(np.arange(float(len(counts))), counts)
    return np.random.default_rng(seed).permutation(x)


def clipped(*counts: int) -> list[Fault]:
    found = of_x(levels(*counts))
    assert all(fault.code == "saturated" for fault in found)
    return found


@pytest.mark.parametrize("upper", [False, True])
@pytest.mark.parametrize(("n", "told"), [(36, False), (37, True)])
def test_a_rail_holds_three_times_what_the_three_levels_before_it_do(upper: bool, n: int, told: bool) -> None:
    """3 + 4 + 5 samples; the fourth level has many."""
    counts = [n, 3, 4, 5, 300, *[50] * 16, 5, 5, 5, 5]
    (*found,) = clipped(*(counts[::-1] if upper else counts))
    assert bool(found) == told
    if told:
        assert f"clipped at {len(counts) - 1 if upper else 0} mG: {n} of" in found[0].sentence
        assert found[0].value == n / sum(counts)


@pytest.mark.parametrize(("n", "told"), [(9, False), (10, True)])
def test_ten_samples_make_a_rail(n: int, told: bool) -> None:
    assert bool(clipped(*[40] * 20, 1, 1, 1, n)) == told


@pytest.mark.parametrize(("n_levels", "told"), [(19, False), (20, True)])
def test_fewer_than_twenty_levels_show_no_rail(n_levels: int, told: bool) -> None:
    assert bool(clipped(*[10] * (n_levels - 4), 1, 1, 1, 90)) == told


@pytest.mark.parametrize(("total", "fatal"), [(12_001, False), (12_000, False), (11_999, True)])
def test_one_sample_in_a_thousand_at_a_rail_is_bearable(total: int, fatal: bool) -> None:
    middle = total - 12 - 3 - 19 * 100
    (fault,) = clipped(*[100] * 19, middle, 1, 1, 1, 12)
    assert (fault.value, fault.limit, fault.fatal) == (12 / total, 1e-3, fatal)
    assert f"12 of {total} samples (0.10 %)" in fault.sentence


def test_both_rails_are_told() -> None:
    (fault,) = clipped(70, 1, 1, 1, *[50] * 20, 1, 1, 1, 30)
    assert "clipped at 27 mG and 0 mG: 100 of 1106 samples (9.04 %)" in fault.sentence


def two_levels(changes: int, steps: int, size: float) -> np.ndarray:
    """±size, half of the samples each but for rounding, of whose successive pairs `changes` in `steps` differ: the
    standard deviation is size, the mean square of a step 4 size² · changes / steps."""
    changed = np.zeros(steps, bool)
    changed[np.round(np.linspace(0, steps - 1, changes)).astype(int)] = True
    x = size * (-1.0) ** np.cumsum(np.r_[0, changed])
    return x + 1e-9 * np.sin(np.arange(len(x)))


@pytest.mark.parametrize("scale", [1.0, 0.01])
@pytest.mark.parametrize(
    ("sensor", "size", "share", "told"),
    [
        ("gyroscope", 5.1, 0.41, True),
        ("gyroscope", 4.9, 0.41, False),
        ("gyroscope", 5.1, 0.39, False),
        ("accelerometer", 20.4, 0.41, True),
        ("accelerometer", 19.6, 0.41, False),
        ("magnetometer", 50.0, 0.41, False),
    ],
)
def test_loud_and_unrelated_readings_are_noise(
    sensor: str, size: float, share: float, told: bool, scale: float
) -> None:
    """`share` of the pairs changes sign: the ratio is twice that, 0.8 is the limit; 5 rad/s and 20 m/s² are loud."""
    steps = 2000
    found = of_x(two_levels(round(share * steps), steps, size / scale), sensor, scale)
    assert [f.code for f in found] == (["random"] if told else [])
    if told:
        assert found[0].value == pytest.approx(2 * share, abs=5e-3)
        assert (found[0].limit, found[0].fatal) == (0.8, True)
        assert f"scatter by {size:.3g} (SI)" in found[0].sentence


def test_counts_have_no_loudness() -> None:
    assert of_x(two_levels(1000, 2000, 50.0), "gyroscope", None) == []


def lengths(length: float) -> np.ndarray:
    return np.tile(length * np.array([2.0, -3.0, 6.0]) / 7.0, (5, 1))


@pytest.mark.parametrize("in_mps2", [1.0, G])
@pytest.mark.parametrize(
    ("ratio", "limit"), [(0.49, 0.5), (0.51, None), (1.0, None), (1.99, None), (2.01, 2.0), (7.0, 2.0), (0.0, 0.5)]
)
def test_a_flight_feels_half_to_twice_gravity(ratio: float, limit: float | None, in_mps2: float) -> None:
    fault = accelerometer_unit(lengths(ratio * 9.79 / in_mps2), "u", in_mps2, 9.79)
    assert (fault is None) == (limit is None)
    if fault is not None:
        assert fault.value == pytest.approx(ratio, rel=1e-12, abs=1e-12)
        assert (fault.limit, fault.fatal, fault.code) == (limit, True, "wrong_unit")
        assert f"{ratio:.3g} times as long as gravity when their unit is u" in fault.sentence


@pytest.mark.parametrize("field_t", [None, 30e-6])
@pytest.mark.parametrize(
    ("ratio", "limit"), [(0.099, 0.1), (0.101, None), (7.99, None), (8.01, 8.0), (0.0, 0.1), (40.0, 8.0)]
)
def test_the_field_is_a_tenth_to_eight_times_the_local_one(
    ratio: float, limit: float | None, field_t: float | None
) -> None:
    """Where that is not known, of 45 µT."""
    fault = magnetometer_unit(lengths(ratio * (field_t or 45e-6) / 1e-4), "G", 1e-4, field_t)
    assert (fault is None) == (limit is None)
    if fault is not None:
        assert fault.value == pytest.approx(ratio, rel=1e-12, abs=1e-12)
        assert (fault.limit, fault.fatal) == (limit, True)
        assert "times as long as the local field" in fault.sentence


@pytest.mark.parametrize(("unit", "length"), [("m/s^2", 9.8), ("g", 9.8 / G), ("mg", 9800 / G), ("cm/s^2", 980.0)])
def test_the_unit_that_fits_is_named(unit: str, length: float) -> None:
    """From readings of 9.8 m/s² in every other unit."""
    fault = accelerometer_unit(lengths(length), "u", 1e3, 9.8)
    assert fault is not None
    assert f"; in {unit} they would be 1.00" in fault.sentence


@pytest.mark.parametrize(("unit", "length"), [("T", 48e-6), ("G", 0.48), ("mG", 480.0), ("uT", 48.0), ("nT", 48e3)])
def test_the_magnetic_unit_that_fits_is_named(unit: str, length: float) -> None:
    fault = magnetometer_unit(lengths(length), "u", 1e3, 40e-6)
    assert fault is not None
    assert f"; in {unit} they would be 1.20" in fault.sentence


@pytest.mark.parametrize(("factor", "named"), [(2.7, True), (2.8, False), (1 / 2.7, True), (1 / 2.8, False)])
def test_no_unit_is_named_that_is_off_by_more_than_e(factor: float, named: bool) -> None:
    fault = accelerometer_unit(lengths(factor * 9.8), "u", 1e3, 9.8)
    assert fault is not None
    assert ("they would be" in fault.sentence) == named


def test_zeros_fit_no_unit() -> None:
    fault = accelerometer_unit(np.zeros((5, 3)), "u", 1.0, 9.8)
    assert fault is not None
    assert "they would be" not in fault.sentence


@pytest.mark.parametrize("in_radps", [1.0, np.deg2rad(1.0)])
@pytest.mark.parametrize(
    ("fastest", "like"), [(69.0, None), (70.5, "deg/s"), (4000.0, "deg/s"), (4020.0, "counts"), (30000.0, "counts")]
)
def test_no_gyroscope_measures_more_than_4000_degrees_a_second(
    fastest: float, like: str | None, in_radps: float
) -> None:
    """One reading in a thousand is not looked at: rates from 0 to `fastest` / 0.999, spread evenly."""
    rates = np.linspace(-fastest, fastest, 3 * 667).reshape(-1, 3) / 0.999 / in_radps
    fault = gyroscope_unit(rates, "u", in_radps)
    assert (fault is None) == (like is None)
    if fault is not None:
        assert fault.value == pytest.approx(fastest, rel=1e-6)
        assert (fault.limit, fault.fatal, fault.code) == (70.0, True, "wrong_unit")
        assert f"look like {like}." in fault.sentence
        assert "more than 70." in fault.sentence


def stamps(*intervals: float) -> np.ndarray:
    """Stamps whose steps are so many ticks."""
    return TICK_S * np.cumsum(np.r_[0.0, intervals])


@pytest.mark.parametrize(("gap", "missing"), [(1.5, 0), (1.6, 1), (2.0, 1), (6.0, 5), (16.0, 15), (16.5, 0), (40.0, 0)])
def test_gaps_up_to_a_second_are_lost_samples(gap: float, missing: int) -> None:
    found = sampling_faults("gyroscope", stamps(*[1.0] * 200, gap, *[1.0] * 200, gap))
    assert [f.code for f in found] == (["dropouts"] if missing else [])
    if missing:
        (fault,) = found
        assert fault.value == pytest.approx(2 * missing / (403 + 2 * missing), rel=1e-12)
        assert (fault.limit, fault.fatal) == (1e-3, False)
        sentence = f"lost about {2 * missing} samples ({100 * fault.value:.2f} %) in 2 dropouts, the longest"
        assert sentence in fault.sentence
        assert f"{gap * TICK_S:.3f} s" in fault.sentence


@pytest.mark.parametrize(("n", "told"), [(1000, False), (998, True)])
def test_one_lost_sample_in_a_thousand_is_bearable(n: int, told: bool) -> None:
    """The lost one among them."""
    t = stamps(*[1.0] * 400, 2.0, *[1.0] * (n - 403))
    assert len(t) == n - 1
    assert bool(sampling_faults("gyroscope", t)) == told


@pytest.mark.parametrize(("slower", "told"), [(1.25, False), (1.3125, True)])
def test_a_rate_may_change_by_a_third_less_a_bit(slower: float, told: bool) -> None:
    """Windows of 5 s, 80 ticks: one rate in the first four, another in the next."""
    found = sampling_faults("gyroscope", stamps(*[1.0] * 320, *[slower] * 320))
    assert [f.code for f in found] == (["rate_changes"] if told else [])
    if told:
        (fault,) = found
        assert fault.value == pytest.approx(slower, rel=1e-12)
        assert (fault.limit, fault.fatal) == (1.3, False)
        assert re.search(r"between 12\.19 and 16 Hz", fault.sentence)


@pytest.mark.parametrize(("fast", "told"), [(10, True), (9, False)])
def test_a_window_of_ten_samples_has_a_rate(fast: int, told: bool) -> None:
    """Windows of 80 ticks with ten slow steps each; in the second so many quick ones end, and one that leads out."""
    slow = [7.875] * 10
    t = stamps(*slow, 1.25, *[1.0] * (fast - 1), 81.0 - fast, *slow, *slow)
    assert bool(sampling_faults("gyroscope", t)) == told


def test_windows_are_five_seconds_long() -> None:
    """In each the quicker steps are one more than the others, 1.4 times as long; in half a second more there may be
    five more of the others."""
    quick = 80.0 / (31 + 30 * 1.4)
    assert sampling_faults("gyroscope", stamps(*([quick] * 31 + [1.4 * quick] * 30) * 8)) == []


def test_two_windows_are_enough_for_a_rate_to_change() -> None:
    """Five seconds of each rate; a single window has nothing to differ from."""
    slow, fast = np.arange(0.0, 5.0, 0.0625), 5.0 + np.arange(0.0, 5.0, 0.03125)
    found = sampling_faults("gyroscope", np.r_[slow, fast])
    assert [f.value for f in found if f.code == "rate_changes"] == [pytest.approx(2.0)]
    assert sampling_faults("gyroscope", slow) == []
