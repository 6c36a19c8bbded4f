"""Each number of the tidying met from both sides, alone and in batches: what is held, yielded, counted and told."""

from __future__ import annotations

from itertools import chain, pairwise

import numpy as np
import polars as pl
import pytest
from test_tidy import imu, rows

from fieldcal.errors import UnreadableLog
from fieldcal.logs import Columns, tidy
from fieldcal.logs.tidy import Disordered, TidySignal

S = 1_000_000_000
STEP_NS = 5_000_000


def steady(n: int, step_ns: int = STEP_NS, start: int = 0) -> np.ndarray:
    return start + step_ns * np.arange(n)


def told(signal: TidySignal) -> dict[str, int]:
    return {finding.code: finding.count for finding in signal.findings("a.csv")}


def sentence(signal: TidySignal, code: str) -> str:
    return next(finding.sentence for finding in signal.findings("a.csv") if finding.code == code)


def tidied(columns: Columns, batch: int | None = None, table: str = "imu") -> tuple[pl.DataFrame, TidySignal]:
    """The whole signal in batches of so many rows, held to the end."""
    signal = TidySignal(table, None)
    n = len(columns["t_ns"])
    batches = [rows(columns, slice(i, i + (batch or n))) for i in range(0, n, batch or n)]
    assert list(chain.from_iterable(signal.add(b) for b in batches)) == []
    return pl.concat(list(signal.finish())), signal


def warm(t_ns: np.ndarray) -> Columns:
    """The narrowest table."""
    return {"t_ns": t_ns, "temperature_degc": np.arange(len(t_ns), dtype=float)}


def test_what_is_held_back_and_when() -> None:
    """Twice as many rows as are held may gather; then all but those are handed on."""
    signal = TidySignal("imu", 10)
    columns, handed, place = imu(steady(100)), [], 0
    for n in (20, 1, 9, 1, 15, 1, 1):
        parts = list(signal.add(rows(columns, slice(place, place + n))))
        handed.append(sum(len(part) for part in parts))
        place += n
    assert handed == [0, 11, 0, 0, 25, 0, 0]
    assert sum(len(part) for part in signal.finish()) == place - sum(handed)
    assert list(signal.finish()) == []
    assert signal.rows == place
    assert told(signal) == {}


def test_a_hundred_and_thirty_thousand_rows_are_held_unless_told_otherwise() -> None:
    """2¹⁷: so late a row may come without the log being read a second time."""
    signal = TidySignal("temperature")
    t_ns = steady(2 * 131_072 + 1)
    t_ns[[5, 6]] = t_ns[[6, 5]]
    assert list(signal.add(warm(t_ns[:-1]))) == []
    (part,) = signal.add(warm(t_ns[-1:]))
    assert len(part) == 131_073


def test_six_million_rows_may_be_held() -> None:
    signal = TidySignal("temperature", None)
    for i in range(10):
        assert list(signal.add(warm(steady(600_000, start=600_000 * STEP_NS * i)))) == []
    with pytest.raises(UnreadableLog, match="more than 6000000 rows") as caught:
        list(signal.add(warm(np.array([6_000_000 * STEP_NS]))))
    assert caught.value.reason_code == "too_disordered"


@pytest.mark.parametrize(("t_ns", "disordered"), [(21 * STEP_NS, False), (10 * STEP_NS, True), (9 * STEP_NS, True)])
def test_a_row_not_behind_those_handed_on_is_disorder(t_ns: int, disordered: bool) -> None:
    """Eleven of 21 rows were handed on, the last of them of ten steps."""
    signal = TidySignal("imu", 10)
    (part,) = signal.add(imu(steady(21)))
    assert part["t_ns"][-1] == 10 * STEP_NS
    late = imu(np.array([22 * STEP_NS, t_ns, 23 * STEP_NS]))
    if disordered:
        with pytest.raises(Disordered):
            list(signal.add(late))
    else:
        assert list(signal.add(late)) == []


@pytest.mark.parametrize("batch", [1, 2, 7, 100])
def test_late_rows_are_counted_over_all_batches(batch: int) -> None:
    """Streaming hands on what it can; the count is of the rows behind an earlier one."""
    order = np.arange(100)
    order[[10, 11]], order[[40, 41]], order[[80, 81]] = [11, 10], [41, 40], [81, 80]
    columns = imu(steady(100))
    for held, streamed in ((10, True), (None, False)):
        signal = TidySignal("imu", held)
        batches = [rows(columns, order[i : i + batch]) for i in range(0, 100, batch)]
        parts = [part for b in batches for part in signal.add(b)]
        assert bool(parts) == streamed
        parts += signal.finish()
        assert pl.concat(parts)["t_ns"].to_list() == columns["t_ns"].tolist()
        assert (signal.disordered, told(signal)) == (3, {"out_of_order": 3})


@pytest.mark.parametrize("batch", [1, 5, 400])
def test_a_clean_stream_has_nothing_to_tell(batch: int) -> None:
    signal = TidySignal("imu", 20)
    columns = imu(steady(400))
    parts = [part for i in range(0, 400, batch) for part in signal.add(rows(columns, slice(i, i + batch)))]
    parts += signal.finish()
    assert pl.concat(parts)["gyroscope_x"].to_list() == columns["gyroscope_x"].tolist()
    assert (signal.disordered, signal.rows, told(signal)) == (0, 400, {})
    assert (signal.first_ns, signal.last_ns) == (0, 399 * STEP_NS)


@pytest.mark.parametrize("held", [None, 500])
def test_the_first_of_each_stamp_is_kept(held: int | None) -> None:
    """Every stamp thrice, in an order that is shuffled a little."""
    rng = np.random.default_rng(3)
    t_ns = np.repeat(steady(2000), 3)[np.argsort(np.arange(6000) + rng.uniform(0, 8, 6000), kind="stable")]
    columns = imu(t_ns)
    signal = TidySignal("imu", held)
    parts = [part for i in range(0, 6000, 600) for part in signal.add(rows(columns, slice(i, i + 600)))]
    frame = pl.concat([*parts, *signal.finish()])
    first = np.unique(t_ns, return_index=True)[1]
    assert frame["t_ns"].to_list() == steady(2000).tolist()
    assert frame["gyroscope_x"].to_list() == columns["gyroscope_x"][first].tolist()
    assert signal.conflicts == 4000


ROUNDED = {  # how many readings each stamp has
    "of 120 rows 12 contradict, a tenth": ([2] * 12 + [1] * 96, False),
    "of 120 rows 13 contradict": ([2] * 13 + [1] * 94, True),
    "19 of 20 stamps have as many": ([5] + [1] * 19, False),
    "18 of 20 stamps have as many": ([5, 4] + [1] * 18, True),
}


@pytest.mark.parametrize("case", ROUNDED)
@pytest.mark.parametrize("copied", [False, True])
def test_many_contradictions_in_stamps_of_unlike_numbers_are_rounded_stamps(case: str, copied: bool) -> None:
    """The middle reading of each stamp counts; otherwise the first, and where a row is there twice in any case."""
    sizes, expected = ROUNDED[case]
    t_ns = np.repeat(steady(len(sizes)), sizes)
    columns = imu(t_ns)
    if copied:
        columns = rows(columns, np.r_[0, 0, 2 : len(t_ns)])
    frame, signal = tidied(columns)
    firsts = columns["gyroscope_x"][np.unique(t_ns, return_index=True)[1]].tolist()
    assert signal.rounded == (expected and not copied)
    assert (frame["gyroscope_x"].to_list() == firsts) != signal.rounded


def test_of_rounded_stamps_the_kept_reading_is_as_old_as_its_stamp() -> None:
    """185 Hz, stamps of two decimals: the kept readings' true times are on average those of their stamps."""
    true = np.rint(np.arange(7400) / 185.0 * S).astype(np.int64)
    rounded = (true + S // 200) // (S // 100) * (S // 100)
    columns = {**imu(rounded), "gyroscope_x": true.astype(float)}
    frame, signal = tidied(columns)
    late = frame["gyroscope_x"].to_numpy() - frame["t_ns"].to_numpy()
    assert abs(late.mean()) < 0.05e-3 * S
    first = np.unique(rounded, return_index=True)[1]
    assert (true[first] - rounded[first]).mean() < -2e-3 * S
    assert frame["t_ns"].to_list() == np.unique(rounded).tolist()
    assert signal.conflicts == 7400 - len(first)
    assert "the middle one of each stamp was kept" in sentence(signal, "repeated_stamps")


def test_two_sensors_in_one_table_are_not_mixed() -> None:
    """Every stamp twice, but for a few lost rows: the first of each is kept."""
    t_ns = np.delete(np.repeat(steady(500), 2), np.arange(20) * 50)
    columns = imu(t_ns)
    frame, signal = tidied(columns)
    first = np.unique(t_ns, return_index=True)[1]
    assert frame["gyroscope_x"].to_list() == columns["gyroscope_x"][first].tolist()
    assert "the first of each stamp was kept" in sentence(signal, "repeated_stamps")


def test_milliseconds_read_as_seconds_are_told() -> None:
    _, signal = tidied(imu(steady(100, S)))
    assert "at 1 Hz; were their unit 1000 times finer (ms instead of s), it would be 1000 Hz" in sentence(
        signal, "implausible_rate"
    )
    _, signal = tidied(imu(steady(100, 5000 * S)))
    assert "10⁶ times finer (us instead of s), it would be 200 Hz" in sentence(signal, "implausible_rate")
    _, signal = tidied(imu(steady(100, 1000)))
    assert "were their unit" not in sentence(signal, "implausible_rate")


@pytest.mark.parametrize(("repeats", "code"), [(500, "repeated_stamps"), (501, "clock_stands")])
def test_a_clock_stands_when_most_rows_repeat_a_stamp(repeats: int, code: str) -> None:
    """Of 1000."""
    n = 1000 - repeats
    t_ns = np.sort(np.r_[steady(n), steady(n)[np.arange(repeats) % n]])
    _, signal = tidied(imu(t_ns))
    assert told(signal)[code] == repeats
    assert f"{repeats} " in sentence(signal, code)


@pytest.mark.parametrize("table", ["vps", "position"])
def test_what_may_be_unknown_may_be_nan(table: str) -> None:
    names = [n for n in tidy.SIGNAL_COLUMNS[table] if n != "t_ns"]
    columns = {"t_ns": steady(10), **{n: np.ones(10) for n in names}}
    unknown = [n for n in names if n in ("px_m", "py_m", "pz_m", "altitude_m")]
    assert unknown
    for name in names:
        spoiled = {**columns, name: np.where(np.arange(10) == 4, np.nan, 1.0)}
        frame, signal = tidied(spoiled, table=table)
        lost = 0 if name in unknown else 1
        assert (len(frame), signal.not_finite) == (10 - lost, lost), name


def test_the_longest_stretch_is_that_of_most_rows_without_copies() -> None:
    """The clock is set back: 30 rows before, 20 behind, and 25 of these once more."""
    before, behind = imu(steady(20), seed=1), imu(steady(30, start=15 * STEP_NS + 1), seed=2)
    assert told(tidied(joined(before, behind))[1])["clock_set"] == 20
    copied = joined(before, rows(before, np.repeat(np.arange(20), 2)), behind)
    frame, _ = tidied(copied)
    assert frame["t_ns"].to_list() == behind["t_ns"].tolist()


def joined(*parts: Columns) -> Columns:
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


@pytest.mark.parametrize(("gap_ns", "gaps"), [(S, 0), (S + 1, 1), (1_050_000_000, 1), (7 * S, 1)])
@pytest.mark.parametrize("batch", [1, 50, None])
def test_a_pause_of_over_a_second_is_told(gap_ns: int, gaps: int, batch: int | None) -> None:
    t_ns = np.r_[steady(200), steady(200, start=199 * STEP_NS + gap_ns)]
    _, signal = tidied(imu(t_ns), batch)
    assert told(signal) == ({"gaps": 1} if gaps else {})
    assert signal.longest_gap_ns == gap_ns
    if gaps:
        wanted = f"pauses 1 time(s) for over 1 s, at the longest for {gap_ns * 1e-9:.3f} s"
        assert wanted in sentence(signal, "gaps")


@pytest.mark.parametrize(("rate_hz", "told_of"), [(10, False), (11, True), (200, True)])
def test_a_pause_is_ten_intervals_at_least(rate_hz: int, told_of: bool) -> None:
    step = S // rate_hz
    t_ns = np.r_[steady(200, step), steady(200, step, 199 * step + 3 * S)]
    assert ("gaps" in told(tidied(imu(t_ns))[1])) == told_of


def test_pauses_are_counted_over_what_is_handed_on_in_parts() -> None:
    signal = TidySignal("imu", 20)
    t_ns = steady(400) + 2 * S * (np.arange(400) // 100) + 4 * S * (np.arange(400) >= 200)
    parts = [part for i in range(0, 400, 10) for part in signal.add(rows(imu(t_ns), slice(i, i + 10)))]
    assert len([*parts, *signal.finish()]) > 10
    assert told(signal) == {"gaps": 3}
    assert "3 time(s) for over 1 s, at the longest for 6.005 s" in sentence(signal, "gaps")


@pytest.mark.parametrize(
    ("step_ns", "plausible"),
    [(990_000_000, True), (S, False), (1_050_000_000, False), (20_000, True), (19_000, False), (STEP_NS, True)],
)
def test_an_imu_samples_more_than_once_and_up_to_fifty_thousand_times_a_second(step_ns: int, plausible: bool) -> None:
    _, signal = tidied(imu(steady(100, step_ns)))
    assert signal.rate_hz() == pytest.approx(S / step_ns, rel=1e-12)
    assert ("implausible_rate" in told(signal)) == (not plausible)


@pytest.mark.parametrize("batch", [1, 2, 3, None])
def test_the_rate_is_of_the_median_interval(batch: int | None) -> None:
    """4 and 6 ms in turn, one more of the longer: half way or the longer."""
    t_ns = np.cumsum(np.r_[0, np.tile([4_000_000, 6_000_000], 50)])
    assert tidied(imu(t_ns), batch)[1].rate_hz() == pytest.approx(200.0, rel=1e-12)
    assert tidied(imu(np.r_[t_ns, t_ns[-1] + 6_000_000]), batch)[1].rate_hz() == pytest.approx(S / 6e6, rel=1e-12)
    assert tidied(imu(np.array([5])))[1].rate_hz() is None


@pytest.mark.parametrize(("slow", "rate_hz"), [(0.45, 100.0), (0.55, 10.0)])
def test_the_rate_of_a_long_log_is_of_intervals_spread_over_it(
    slow: float, rate_hz: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Few intervals are kept, yet no part of the log counts for more: quick first, then slow."""
    monkeypatch.setattr(tidy, "MOST_INTERVALS", 2000)
    n = 20_000
    steps = np.where(np.arange(n) < (1.0 - slow) * n, S // 100, S // 10)
    t_ns = np.cumsum(np.r_[0, steps])
    signal = TidySignal("temperature", 20)
    columns = warm(t_ns)
    for i, j in pairwise([*range(0, n, 160), n + 1]):
        list(signal.add(rows(columns, slice(i, j))))
    list(signal.finish())
    assert signal.rate_hz() == rate_hz


@pytest.mark.parametrize(("back_ns", "code"), [(S, "clock_set"), (1_050_000_000, "clock_reset")])
def test_a_clock_set_back_by_over_a_second_was_reset(back_ns: int, code: str) -> None:
    """The step between the rows about it is less by an interval: the first one behind would have come one later."""
    n = 1000
    t_ns = np.r_[steady(n), steady(2 * n, start=n * STEP_NS - back_ns - 1) + 1]
    _, signal = tidied(imu(t_ns))
    assert told(signal) == {code: n}
    assert f"by {back_ns * 1e-9:.3f} s" in sentence(signal, code)


def test_the_period_of_a_counter_is_told_in_seconds() -> None:
    """2³² µs."""
    t_ns = (4_294_967_296_000 - 100 * STEP_NS + steady(400)) % 4_294_967_296_000
    _, signal = tidied(imu(t_ns), 7)
    assert told(signal) == {"clock_wrapped": 1}
    assert "began again 1 time(s) after 4294.967 s" in sentence(signal, "clock_wrapped")


@pytest.mark.parametrize("held", [50, None])
def test_of_rows_with_one_stamp_the_first_recorded_is_kept_in_disorder_too(held: int | None) -> None:
    """Four rows a stamp, every second stamp before the one that it follows."""
    stamp = np.repeat(np.arange(200) ^ 1, 4)
    columns = imu(STEP_NS * stamp)
    columns["gyroscope_x"] = np.arange(800.0)
    signal = TidySignal("imu", held)
    parts = [part for i in range(0, 800, 80) for part in signal.add(rows(columns, slice(i, i + 80)))]
    kept = pl.concat([*parts, *signal.finish()])
    assert kept["t_ns"].to_list() == steady(200).tolist()
    assert kept["gyroscope_x"].to_list() == [4.0 * (i ^ 1) for i in range(200)]
