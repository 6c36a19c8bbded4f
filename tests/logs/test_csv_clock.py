"""The clock of a CSV file by itself: counters of every width, and each limit at which a step back is a turn or none."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from datetime import UTC, datetime

import numpy as np
import polars as pl
import pytest

from fieldcal.logs.csv.clock import FileClock

S = 10**9
DAY, WEEK = 86_400 * S, 604_800 * S
TICK = {"ns": 1, "us": 1000, "100us": 100_000, "ms": 10**6}


def series(cells: Iterable[object]) -> pl.Series:
    return pl.Series([str(cell) for cell in cells], dtype=pl.String)


def told(clock: FileClock) -> list[tuple[str, int, str]]:
    return [(str(f.code), f.count, f.sentence) for f in clock.findings("log")]


def code(
    cells: Sequence[int], unit: str | None = "ns", rate_hz: float | None = None, period_s: float | None = None
) -> str:
    """What is found in times, ns where there is no other unit."""
    clock = FileClock(unit, rate_hz, period_s)
    clock.times(series(cells))
    return ", ".join(reason for reason, *_ in told(clock)) or "none"


def at_the_end(period: int, step: int, rows: int = 20) -> list[int]:
    """Times that grow by `step` up to the one before `period`, which they step over as if nothing were."""
    return [(period + step * i - 1) % period for i in range(-rows, rows)]


@pytest.mark.parametrize("unit", TICK)
@pytest.mark.parametrize("bits", [7, 8, 15, 16, 24, 31, 32, 33])
def test_counters_of_8_to_32_bits_in_a_unit_of_time(unit: str, bits: int) -> None:
    period, step = 2**bits, min(max(2**bits // 64, 2), 9 * S // TICK[unit])
    clock = FileClock(unit, None, None)
    t, sound = clock.times(series(at_the_end(period, step)))
    assert sound.all()
    whole = (np.diff(t) == step * TICK[unit]).all()
    assert whole == (8 <= bits <= 32)
    if whole:
        (one,) = told(clock)
        assert one[:2] == ("clock_wrapped", 1)
        assert f"after {period * TICK[unit] / S:.3f} s" in one[2]


@pytest.mark.parametrize(
    ("unit", "period", "known"),
    [
        *(("s", 2**bits * tick, True) for bits in (24, 32) for tick in (1000, 10**6)),
        ("s", 2**16 * 10**6, True),
        *(("s", 2**bits * tick, False) for bits in (23, 25, 31) for tick in (1000, 10**6)),
        ("s", DAY, True),
        ("s", WEEK, True),
        ("ms", WEEK, True),
        ("us", DAY, True),
        ("time_of_day", DAY, True),
        ("s", 2 * DAY, False),
        ("iso8601", DAY, False),
    ],
)
def test_periods_that_clocks_have(unit: str, period: int, known: bool) -> None:
    t_ns = at_the_end(period, 10_000_000)
    if unit in ("iso8601", "time_of_day"):
        form = "1970-01-01T%H:%M:%S" if unit == "iso8601" else "%H:%M:%S"
        cells = [f"{datetime.fromtimestamp(t // S, UTC):{form}}.{t % S:09d}" for t in t_ns]
    else:
        digits = {"s": 9, "ms": 6, "us": 3}[unit]
        cells = [f"{t // 10**digits}.{t % 10**digits:0{digits}d}" for t in t_ns]
    t, sound = FileClock(unit, None, None).times(series(cells))
    assert sound.all()
    assert (np.diff(t) == 10_000_000).all() == known


@pytest.mark.parametrize("bits", [7, 8, 12, 32, 33])
def test_sample_numbers(bits: int) -> None:
    clock = FileClock(None, 100.0, None)
    t, _ = clock.times(series(at_the_end(2**bits, 1)))
    assert (np.diff(t) == 10_000_000).all() == (8 <= bits <= 32)
    if 8 <= bits <= 32:
        assert f"after {2**bits / 100:.3f} s" in told(clock)[0][2]


def test_numbers_without_unit_or_rate_count_seconds() -> None:
    clock = FileClock(None, None, None)
    t, _ = clock.times(series([253, 255, 0, 2]))
    assert t.tolist() == [253 * S, 255 * S, 256 * S, 258 * S]
    assert "after 256.000 s" in told(clock)[0][2]


@pytest.mark.parametrize(
    ("unit", "rate_hz", "period", "step", "pause"),
    [
        ("us", None, 2**32, 10_000, 2**32 / 1000),  # a thousandth of the period
        ("us", None, 2**24, 10_000, 80_000),  # eight intervals
        ("ms", None, 2**32, 10, 10_000),  # ten seconds at most
        ("s", None, DAY // S, 1, 600),  # but ten minutes over midnight
        ("ms", None, WEEK // 10**6, 10, 600_000),
        (None, 100.0, 2**32, 1, 1000),
    ],
)
def test_a_pause_over_the_turn(unit: str | None, rate_hz: float | None, period: int, step: int, pause: float) -> None:
    for over, wraps in ((int(pause), True), (int(pause) + 1, False)):
        cells = [period - 40 * step + i * step for i in range(39)]
        cells += [cells[-1] + over - period + i * step for i in range(20)]
        assert (code(cells, unit, rate_hz) == "clock_wrapped") is wraps


@pytest.mark.parametrize(
    ("cells", "found"),
    [
        ([253, 254, 255, 0, 1, 2], "clock_wrapped"),  # a turn may end at 0
        ([253, 254, 256, 0, 1, 2], "clock_reset"),  # a counter of 8 bits has no 256
        ([253, 254, 255, -1, 1, 2], "none"),
        ([40 * i % 256 for i in range(20)], "clock_wrapped"),  # hardly seven rows a turn
        ([*[v for v in range(150, 250, 10) for _ in range(3)], *[40] * 3, *[50] * 3, *[60] * 3], "clock_wrapped"),
        ([120, 160, 60, 200, 240, 24, 64, 104], "clock_wrapped"),  # a late row is no turn
        ([120, 160, 32, 200, 240, 24, 64, 104], "clock_wrapped"),
        ([255, 0], "clock_reset"),  # of two rows nothing can be told
    ],
)
def test_what_a_turn_of_8_bits_looks_like(cells: list[int], found: str) -> None:
    assert code(cells, None, 100.0) == found


@pytest.mark.parametrize(
    ("behind", "wraps"),
    [
        ([1, 251, 2, 252, 3, 253, 4, 254], False),  # half of eight rows are late ones
        ([1, 251, 2, 252, 3, 253, 4, 254, 5], False),
        ([1, 251, 2, 252, 3, 253, 4, 5], True),
        ([1, 2, 3, 4, 5, 255, 255, 255, 6], True),
        ([1, 122, 122, 122, 122, 122, 122, 122], False),  # half a turn behind is not behind it
        ([1, 121, 121, 121, 121, 121, 121, 121], True),
    ],
)
def test_most_of_eight_rows_behind_a_turn_begin_again(behind: list[int], wraps: bool) -> None:
    assert (code([*range(230, 251), *behind], None, 100.0) == "clock_wrapped") is wraps


@pytest.mark.parametrize("split", range(1, 12))
def test_a_turn_is_found_whatever_the_blocks(split: int) -> None:
    """A late row from before the turn is between two from behind it; half a turn on or back is neither."""
    cells = [100, 228, 252, 254, 255, 0, 1, 253, 2, 3, 131, 250, 255, 0, 128]
    true = [100, 228, 252, 254, 255, 256, 257, 253, 258, 259, 387, 506, 511, 512, 640]
    clock = FileClock(None, 1.0, None)
    clock.times(series([251, 252, 253, 254, 255, *range(0, 256)]))  # the period is known from here on
    t = np.concatenate([clock.times(series(part))[0] for part in (cells[:split], cells[split:])])
    assert (t // S).tolist() == [256 + v for v in (cells[0] + 256, *[v + 256 for v in true[1:]])]
    assert told(clock)[0][1] == 4


def test_half_a_turn_is_none_in_either_direction() -> None:
    clock = FileClock(None, 1.0, None)
    first, _ = clock.times(series([1, 200, *range(201, 256), 0, 1, 2]))  # a jump before any turn is a jump
    assert (first[[0, 1, -1]] // S).tolist() == [1, 200, 258]
    t, _ = clock.times(series([200, 72, 172, 72, 250, 122, 250, 121]))
    assert (t // S - 256).tolist() == [
        200 - 256,
        72 - 256,
        172 - 256,
        72 - 256,
        250 - 512,
        122 - 512,
        250 - 512,
        121 - 256,
    ]


@pytest.mark.parametrize("period_s", [1.0, 3.7])
def test_a_period_that_is_given_may_be_stepped_over_by_half_of_it(period_s: float) -> None:
    period = round(period_s * S)
    cells = [period - 30, period - 20, period - 10]
    for over, wraps in ((period // 2 - 1, True), (period // 2, False)):
        behind = [over - 10] * 8
        assert (code([*cells, *behind], "ns", None, period_s) == "clock_wrapped") is wraps


@pytest.mark.parametrize(
    ("cells", "found"),
    [
        ([0, 10, 20, 30], "none"),
        ([5, 5 * S, 5 * S + 1, 3], "clock_reset"),
        ([5, 5 * S, 5 * S + 1, 5], "none"),  # back where it was is not before it
        ([3 * S, 3 * S + 10, 3 * S + 20, *range(0, 90, 10)], "clock_reset"),
        ([3 * S, 3 * S + 10, 3 * S + 20, *range(80, 170, 10)], "clock_reset"),  # within eight intervals of 0
        ([3 * S, 3 * S + 10, 3 * S + 20, *range(81, 171, 10)], "none"),
        ([3 * S, 3 * S + 10, 3 * S + 20, -1, 9, 19], "none"),
        ([S - 20, S - 10, S, 0, 10, 20], "none"),  # a second and no more
        ([S - 19, S - 9, S + 1, 0, 10, 20], "clock_reset"),
    ],
)
def test_a_clock_that_begins_again_near_zero(cells: list[int], found: str) -> None:
    assert code(cells) == found


def test_what_is_told_of_a_restart_is_when_the_first_of_them_was() -> None:
    clock = FileClock(None, 100.0, None)
    clock.times(series([1, 2, 3, 700, 0]))
    ((reason, count, sentence),) = told(clock)
    assert (reason, count) == ("clock_reset", 1)
    assert "after 7.000 s" in sentence
    assert all(finding.fatal for finding in clock.findings("log"))


def test_a_cell_that_is_no_time_is_remembered_and_does_not_move_the_clock() -> None:
    clock = FileClock("s", None, None)
    t, sound = clock.times(series(["1", "x", "2", "y"]))
    assert t[sound].tolist() == [S, 2 * S]
    assert sound.tolist() == [True, False, True, False]
    clock.times(series(["z"]))
    assert clock.bad_cell == "x"
