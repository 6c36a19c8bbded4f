"""Where the rules about stamps begin and end: each limit met from both sides, batches of any size, a plain loop beside
what is computed for all stamps at once."""

from __future__ import annotations

import numpy as np
import pytest

from fieldcal.logs.stamps import Order, Unwrapper, judge, suspicious

S = 1_000_000_000
STEP = 5_000_000
COUNTERS_NS = {"us": 4_294_967_296_000, "ms": 4_294_967_296_000_000}
"""2³² microseconds are 4294.967296 s, 2³² milliseconds 49.7 days."""
DAY = 24 * 3600 * S


def judged(t_ns: np.ndarray, repeated: np.ndarray | None = None) -> Order:
    return judge(t_ns, np.zeros(len(t_ns), bool) if repeated is None else repeated)


def unwrapped(t_ns: np.ndarray, batch: int) -> tuple[np.ndarray, Unwrapper]:
    unwrap = Unwrapper()
    parts = [unwrap(t_ns[i : i + batch]) for i in range(0, len(t_ns), batch)]
    return np.concatenate(parts), unwrap


@pytest.mark.parametrize("batch", [1, 2, 7, 1000])
@pytest.mark.parametrize("period", COUNTERS_NS.values(), ids=COUNTERS_NS)
def test_counters_go_on_over_several_wraps(period: int, batch: int) -> None:
    """Steps of 7 s about each wrap, of a quarter period elsewhere."""
    about = [k * period + j * 7 * S - 10 * S for k in (1, 2, 3) for j in range(4)]
    true = np.sort(np.array([*about, *(k * period // 4 for k in range(1, 15) if k % 4)], np.int64))
    found, unwrap = unwrapped(true % period, batch)
    np.testing.assert_array_equal(found, true)
    assert (unwrap.wraps, unwrap.period_ns) == (3, period)


@pytest.mark.parametrize(("pause", "wraps"), [(10 * S, 1), (10 * S + 1, 0)])
@pytest.mark.parametrize("batch", [1, 4])
def test_ten_seconds_are_the_longest_pause_over_a_wrap(pause: int, wraps: int, batch: int) -> None:
    period = COUNTERS_NS["us"]
    true = period - 3 * S + np.array([0, S, S + pause, 2 * S + pause])
    found, unwrap = unwrapped(true % period, batch)
    assert unwrap.wraps == wraps
    assert np.array_equal(found, true) == bool(wraps)


@pytest.mark.parametrize(("late", "sorted_in"), [(10 * S, True), (10 * S + 1, False)])
@pytest.mark.parametrize("batch", [1, 3, 8])
def test_a_late_message_from_before_the_wrap(late: int, sorted_in: bool, batch: int) -> None:
    """It comes after one from behind the wrap, `late` before it; the ones after go on behind the wrap."""
    period = COUNTERS_NS["us"]
    ahead = 9 * S
    true = period + np.array([-S, ahead, ahead - late, ahead - 1])
    found, _ = unwrapped(true % period, batch)
    assert np.array_equal(found, true) == sorted_in


def test_a_late_message_needs_a_wrap_before_it() -> None:
    """A clock that is set forward by nearly a period has not wrapped."""
    t = np.array([S, COUNTERS_NS["us"] - S, COUNTERS_NS["us"] - S // 2])
    found, unwrap = unwrapped(t, 3)
    np.testing.assert_array_equal(found, t)
    assert unwrap.wraps == 0


@pytest.mark.parametrize("batch", [1, 8])
def test_only_stamps_a_counter_can_hold_wrap(batch: int) -> None:
    """It counts from 0 to its period less one."""
    period = COUNTERS_NS["us"]
    for t in (
        [period - S, period, 1],
        [period - S, period + 1, 1],
        [period - S, -1],
        [-S, -2 * S, -S],
    ):
        found, unwrap = unwrapped(np.array(t), batch)
        assert (found.tolist(), unwrap.wraps) == (t, 0)
    for t, true in (
        ([period - 1, 0], [period - 1, period]),
        ([period - 5, 3, 9], [period - 5, period + 3, period + 9]),
    ):
        found, unwrap = unwrapped(np.array(t), batch)
        assert (found.tolist(), unwrap.wraps) == (true, 1)


@pytest.mark.parametrize("batch", [1, 8])
@pytest.mark.parametrize(
    "jump", [(-S, COUNTERS_NS["us"] - 2 * S), (2 * S, COUNTERS_NS["us"]), (2 * S, COUNTERS_NS["us"] + S)]
)
def test_jumps_of_nearly_a_period_outside_the_counter_are_none_of_its_wraps(jump: tuple[int, int], batch: int) -> None:
    """After a wrap; one end of the jump lies outside what the counter holds."""
    period = COUNTERS_NS["us"]
    t = np.array([period - S, S, *jump])
    found, unwrap = unwrapped(t, batch)
    assert found.tolist() == [period - S, *(t[1:] + period).tolist()]
    assert unwrap.wraps == 1


def by_loop(t_ns: np.ndarray, previous: int | None, behind: np.ndarray, n_late: int) -> tuple[bool, int]:
    """`suspicious` one stamp after the other: ten growing ones in a row that lie behind, or a jump."""
    run, longest, jumps = n_late, n_late, False
    for i, t in enumerate(t_ns.tolist()):
        step = 0 if i == 0 and previous is None else t - (previous if i == 0 else int(t_ns[i - 1]))
        jumps |= step < -S or step > DAY
        run = run + 1 if behind[i] > 0 and step >= 0 else 0
        longest = max(longest, run)
    return jumps or longest >= 10, run


@pytest.mark.parametrize("seed", range(40))
def test_lateness_is_counted_across_batches(seed: int) -> None:
    """Random walks of a few nanoseconds back and forth, cut into batches of 1 to 12, the first stamp among them."""
    rng = np.random.default_rng(seed)
    t_ns = np.cumsum(rng.choice([-12, -1, 0, 1, 2], size=300, p=[0.08, 0.1, 0.12, 0.5, 0.2]))
    latest = np.maximum.accumulate(t_ns)
    behind = np.r_[0, np.maximum(latest[:-1] - t_ns[1:], 0)]
    n_late, seen, i, previous = 0, set(), 0, None
    while i < len(t_ns):
        j = min(i + int(rng.integers(1, 13)), len(t_ns))
        found = suspicious(t_ns[i:j], previous, behind[i:j], n_late)
        assert found == by_loop(t_ns[i:j], previous, behind[i:j], n_late)
        seen.add(found[0])
        n_late, previous, i = found[1], int(t_ns[j - 1]), j
    assert seen == {True, False}


@pytest.mark.parametrize(
    ("step", "odd"), [(-S, False), (-S - 1, True), (DAY, False), (DAY + 1, True), (0, False), (STEP, False)]
)
@pytest.mark.parametrize("previous", [None, 50 * S])
def test_a_jump_by_more_than_a_second_back_or_a_day_on_is_suspicious(
    step: int, odd: bool, previous: int | None
) -> None:
    t = np.array([50 * S, 50 * S + step, 50 * S + step])
    behind = np.maximum(50 * S - t, 0)
    assert suspicious(t, previous, behind, 0)[0] == odd
    assert suspicious(t[1:], 50 * S, behind[1:], 0)[0] == odd


def test_ten_growing_stamps_behind_are_suspicious() -> None:
    """The one that steps back is not of them."""
    for late, odd in ((9, False), (10, True)):
        t = 1000 + np.r_[0, 100, 10 + np.arange(late + 1)]
        behind = np.maximum(1100 - t, 0) * (np.arange(len(t)) > 1)
        assert suspicious(t, None, behind, 0) == (odd, late)


def stretch(n: int, start: int = 0, step: int = STEP) -> np.ndarray:
    return start + step * np.arange(n)


def test_ten_growing_stamps_are_a_run_nine_are_strays() -> None:
    """Two days on, amid a recording of a clock that goes on behind them."""
    before, behind = stretch(100), stretch(100, 100 * STEP)
    found = judged(np.r_[before, stretch(9, 2 * DAY), behind])
    assert (found.far, found.back_ns, found.stretch.any()) == (0, 0, False)
    assert found.wild.tolist() == [False] * 100 + [True] * 9 + [False] * 100
    found = judged(np.r_[before, stretch(10, 2 * DAY), behind])
    assert (found.far, found.back_ns, found.wild.any()) == (2, 0, False)
    assert found.stretch.tolist() == [0] * 100 + [1] * 10 + [2] * 100


@pytest.mark.parametrize("n", [9, 5])
def test_nothing_is_said_where_nothing_is_a_run(n: int) -> None:
    t = np.r_[stretch(n, 50 * S), stretch(n)]
    found = judged(t)
    assert not found.wild.any()
    assert (found.stretch.tolist(), found.back_ns, found.far) == ([0] * 2 * n, 0, 0)


def test_copies_do_not_make_a_run() -> None:
    t = np.r_[stretch(100), stretch(12, 2 * DAY)]
    repeated = np.zeros(len(t), bool)
    repeated[-3:] = True
    assert judged(t, repeated).far == 0
    assert judged(t).far == 1


@pytest.mark.parametrize("changes", [3, 5, 7, 199])
def test_five_changes_between_runs_claim_the_same_time(changes: int) -> None:
    """The clock is set back, and from then on a stamp lies behind each of the last ones of before: in order of time the
    runs change, with k stamps each that lie between, 2 k - 1 times. Four are not enough."""
    between = (changes + 1) // 2
    t = np.r_[stretch(100), stretch(100, (100 - between) * STEP + 1)]
    found = judged(t)
    set_back = changes >= 5
    assert found.stretch.tolist() == [0] * 100 + [int(set_back)] * 100
    # The overlap, from the first stamp of the second run to the last of the first, and an interval.
    assert found.back_ns == (between * STEP - 1 if set_back else 0)
    assert (found.far, found.wild.any()) == (0, False)


@pytest.mark.parametrize("gap", [10.0, 10.1])
def test_ten_intervals_without_a_stamp_end_a_run(gap: float) -> None:
    """6 + 6 stamps behind a day: one run of twelve, or two runs of six, which are strays."""
    jump = round(gap * STEP)
    t = np.r_[stretch(100), stretch(6, 2 * DAY), stretch(6, 2 * DAY + 5 * STEP + jump)]
    assert judged(t).far == int(gap == 10.0)


@pytest.mark.parametrize(("jump", "far"), [(DAY, 0), (DAY + 1, 1), (-DAY, 0), (-DAY - 1, 1)])
def test_more_than_a_day_between_runs_is_another_clock(jump: int, far: int) -> None:
    t = np.r_[stretch(50), stretch(50, 49 * STEP + jump), stretch(50, 49 * STEP + jump + 50 * STEP)]
    found = judged(t)
    assert (found.far, found.back_ns) == (far, 0)
    assert found.stretch.tolist() == [0] * 50 + [far] * 100


@pytest.mark.parametrize(("off", "wild"), [(S, False), (S + 1, True), (-S, False), (-S - 1, True)])
def test_a_stray_within_a_second_of_its_neighbours_is_late(off: int, wild: bool) -> None:
    """The median of the 21 about it is the next stamp on its side. There is no hole for it where it says it was."""
    t = stretch(1001)
    t[500] += off + (STEP if off > 0 else -STEP)
    found = judged(t)
    assert found.wild.tolist() == [wild and i == 500 for i in range(1001)]


@pytest.mark.parametrize(("hole", "wild"), [(1.4, True), (1.5, False), (2.0, False)])
def test_a_stray_that_finds_a_hole_is_late(hole: float, wild: bool) -> None:
    """Recorded 2 s after its time. The hole is measured between the stamps about it."""
    width = round(hole * STEP)
    t = np.r_[stretch(100), stretch(900, 99 * STEP + width)]
    stray = 99 * STEP + width // 2
    t = np.r_[t[:600], stray, t[600:]]
    found = judged(t)
    assert found.wild.tolist() == [wild and i == 600 for i in range(1001)]


@pytest.mark.parametrize(("beyond", "wild"), [(S, False), (S + 1, True)])
@pytest.mark.parametrize("side", ["first", "last"])
def test_a_stray_within_a_second_of_an_end_joins_it(beyond: int, wild: bool, side: str) -> None:
    """Recorded in the middle, 5 s away."""
    t = stretch(2001)
    stray = -beyond if side == "first" else int(t[-1]) + beyond
    t = np.r_[t[:1000], stray, t[1000:]]
    found = judged(t)
    assert found.wild.tolist() == [wild and i == 1000 for i in range(2002)]


@pytest.mark.parametrize("at", [1, 3, 5, 11])
def test_neighbours_of_a_stray_near_the_ends(at: int) -> None:
    """Ten to either side are looked at; where there are fewer, the outermost counts for those that lack."""
    t = stretch(100, 100 * S)
    t[at] = 7 * S
    t[-1 - at] = 900 * S
    assert np.flatnonzero(judged(t).wild).tolist() == [at, 99 - at]


@pytest.mark.parametrize("n", [1, 8, 9])
def test_nine_strays_in_a_row_do_not_outvote_their_neighbours(n: int) -> None:
    t = stretch(200, 100 * S)
    t[100 : 100 + n] = 300 * S + stretch(n, step=50 * S)
    assert np.flatnonzero(judged(t).wild).tolist() == list(range(100, 100 + n))


def test_ten_strays_in_a_row_do_not_outvote_their_neighbours_either() -> None:
    """Eleven of the 21 about each are sound, of whichever side. They step back, so they are no run."""
    t = stretch(200, 100 * S)
    t[100:110] = 300 * S - stretch(10, step=1_000_000)
    assert np.flatnonzero(judged(t).wild).tolist() == list(range(100, 110))


@pytest.mark.parametrize(("place", "wild"), [(0, False), (STEP // 2, True)])
@pytest.mark.parametrize("side", ["first", "last"])
def test_a_stray_at_an_end_repeats_it_and_within_the_outermost_interval_it_has_no_hole(
    place: int, wild: bool, side: str
) -> None:
    t = stretch(2001)
    stray = place if side == "first" else int(t[-1]) - place
    found = judged(np.r_[t[:1000], stray, t[1000:]])
    assert found.wild.tolist() == [wild and i == 1000 for i in range(2002)]


@pytest.mark.parametrize("step", [1, 2, STEP])
@pytest.mark.parametrize("times", [1, 3])
def test_a_clock_is_judged_in_its_own_intervals(step: int, times: int) -> None:
    """However fine they are, and when every stamp stands in several rows. A pause of eleven intervals begins another
    run; the clock, set back in the end, claims 20 intervals twice."""
    once = np.r_[stretch(50, 0, step), stretch(50, 60 * step, step), stretch(50, 90 * step, step)]
    t = np.repeat(once, times)
    found = judged(t)
    assert found.stretch.tolist() == [0] * 100 * times + [1] * 50 * times
    assert (found.back_ns, found.far, found.wild.any()) == (20 * step, 0, False)


def test_of_two_clocks_set_back_the_farther_is_told() -> None:
    t = np.r_[stretch(100), stretch(100, 94 * STEP + 1), stretch(100, 174 * STEP + 2), stretch(100, 268 * STEP + 3)]
    found = judged(t)
    assert found.stretch.tolist() == np.repeat(range(4), 100).tolist()
    assert found.back_ns == 20 * STEP - 1


def test_nanosecond_steps_alone_are_a_run() -> None:
    found = judged(np.r_[stretch(50, 0, 1), stretch(50, 30, 1)])
    assert found.stretch.tolist() == [0] * 50 + [1] * 50
    assert found.back_ns == 20
