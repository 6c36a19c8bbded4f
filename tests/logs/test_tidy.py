"""Tidying: what is sorted, what is left out, what is told of it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import polars as pl
import pytest

from fieldcal.errors import UnreadableLog
from fieldcal.logs import Columns, LogSummary
from fieldcal.logs.ingest import TidyLog
from fieldcal.logs.tidy import Disordered, TidySignal

STEP_NS = 5_000_000


def imu(t_ns: np.ndarray, seed: int = 0) -> Columns:
    rng = np.random.default_rng(seed)
    names = [f"{sensor}_{axis}" for sensor in ("gyroscope", "accelerometer") for axis in "xyz"]
    return {"t_ns": t_ns.astype(np.int64), **{name: rng.normal(size=len(t_ns)) for name in names}}


def rows(columns: Columns, index: Any) -> Columns:
    return {name: values[index] for name, values in columns.items()}


class Reader:
    """A log made of the given batches of one signal."""

    def __init__(self, *batches: Columns, table: str = "imu") -> None:
        self.summary = LogSummary("csv")
        self._batches = batches
        self._table = table

    def batches(self) -> Iterator[tuple[str, Columns]]:
        for batch in self._batches:
            self.summary.count_rows(self._table, batch)
            yield self._table, batch


def tidy(*batches: Columns) -> tuple[pl.DataFrame, dict[str, Any]]:
    log = TidyLog(Reader(*batches), "a.csv")
    frame = pl.concat([part for _, part in log.tables()])
    return frame, log.facts()


def counts(facts: dict[str, Any]) -> dict[str, int]:
    return {finding["code"]: finding["count"] for finding in facts["findings"]}


T_NS = np.arange(1000) * STEP_NS
CLEAN = imu(T_NS)


def test_a_clean_log_passes_as_it_is() -> None:
    frame, facts = tidy(CLEAN)
    assert (facts["verdict"], facts["findings"], facts["n_samples"]) == ("ok", [], 1000)
    assert facts["imu_rate_hz"] == 200.0
    assert facts["duration_s"] == pytest.approx(4.995)
    for name, values in CLEAN.items():
        assert np.array_equal(frame[name].to_numpy(), values)


def test_disorder_is_sorted_and_told_but_loses_nothing() -> None:
    order = np.arange(1000)
    order[[10, 11]] = order[[11, 10]]
    frame, facts = tidy(rows(CLEAN, order[:500]), rows(CLEAN, order[500:]))
    assert frame.equals(tidy(CLEAN)[0])
    assert (facts["verdict"], counts(facts)) == ("ok", {"out_of_order": 1})


def test_copies_are_taken_once_and_contradictions_lose_data() -> None:
    copied = rows(CLEAN, np.r_[0:500, 498:500, 500:1000])
    frame, facts = tidy(copied)
    assert frame.equals(tidy(CLEAN)[0])
    assert (facts["verdict"], counts(facts)["duplicate_rows"]) == ("ok", 2)
    other = {**rows(CLEAN, slice(300, 301)), "gyroscope_x": np.array([99.0])}
    frame, facts = tidy(rows(CLEAN, slice(0, 301)), other, rows(CLEAN, slice(301, 1000)))
    assert frame.equals(tidy(CLEAN)[0])
    assert (facts["verdict"], facts["reason_code"]) == ("partial", "repeated_stamps")


def test_rows_that_are_not_numbers_are_left_out() -> None:
    spoiled = {name: values.copy() for name, values in CLEAN.items()}
    spoiled["accelerometer_y"][5] = np.nan
    spoiled["gyroscope_z"][7] = np.inf
    frame, facts = tidy(spoiled)
    assert frame.equals(tidy(rows(CLEAN, np.delete(np.arange(1000), [5, 7])))[0])
    assert (facts["verdict"], facts["reason_code"], counts(facts)) == ("partial", "not_finite", {"not_finite": 2})


def test_a_sensor_the_log_lacks_is_null_and_no_loss() -> None:
    frame, facts = tidy({name: values for name, values in CLEAN.items() if "gyroscope" not in name})
    assert frame["gyroscope_x"].null_count() == 1000
    assert facts["verdict"] == "ok"


def test_a_gap_is_no_loss() -> None:
    t_ns = T_NS + np.where(np.arange(1000) < 500, 0, 23_000_000_000)
    assert tidy(imu(t_ns))[1]["verdict"] == "ok"


def test_a_clock_that_was_reset_is_quarantined_a_straggler_is_not() -> None:
    long = imu(np.arange(4000) * STEP_NS)
    after = imu(np.arange(2000) * STEP_NS + 1, seed=1)
    _, facts = tidy(long, after)
    assert (facts["verdict"], facts["reason_code"]) == ("quarantined", "clock_reset")
    late = np.r_[0:100, 101:2000, 100, 2000:4000]
    frame, facts = tidy(rows(long, late))
    assert frame.equals(tidy(long)[0])
    assert facts["verdict"] == "ok"


def test_parts_in_another_order_are_no_reset() -> None:
    t_ns = np.r_[np.arange(500) * STEP_NS + 20_000_000_000, np.arange(500) * STEP_NS]
    frame, facts = tidy(imu(t_ns))
    assert frame["t_ns"].is_sorted()
    assert facts["verdict"] == "ok"


def test_a_log_without_an_imu_sample_is_refused() -> None:
    nothing = {**CLEAN, "gyroscope_x": np.full(1000, np.nan)}
    with pytest.raises(UnreadableLog, match="1000 rows"):
        tidy(nothing)


def test_streaming_gives_what_the_whole_log_gives() -> None:
    rng = np.random.default_rng(2)
    order = np.argsort(np.arange(1000) + rng.uniform(0, 15, 1000))
    shuffled = rows(CLEAN, order)
    streamed = TidySignal("imu", held_rows=40)
    parts = [part for i in range(0, 1000, 50) for part in streamed.add(rows(shuffled, slice(i, i + 50)))]
    parts += streamed.finish()
    assert len(parts) > 5
    assert pl.concat(parts).equals(tidy(CLEAN)[0])
    assert streamed.rate_hz() == 200.0
    hopeless = TidySignal("imu", held_rows=10)
    list(hopeless.add(rows(CLEAN, slice(500, 1000))))
    with pytest.raises(Disordered):
        list(hopeless.add(rows(CLEAN, slice(0, 500))))


def test_a_log_that_takes_too_long_is_given_up() -> None:
    batches = [rows(CLEAN, slice(i, i + 10)) for i in range(0, 1000, 10)]
    log = TidyLog(Reader(*batches), "a.csv", seconds=0.0)
    with pytest.raises(UnreadableLog, match="still being read") as caught:
        list(log.tables())
    assert caught.value.reason_code == "too_slow"
