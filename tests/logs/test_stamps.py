"""Stamps: what order and time say of a clock, alone and through the tidying of a log; nothing is made up in a gap."""

from __future__ import annotations

from itertools import chain
from typing import Any

import numpy as np
import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from test_tidy import Reader, counts, imu, rows

from fieldcal.config.stage_settings import ManoeuvreSettings, SmoothingSettings, taken_from
from fieldcal.logs import Columns, stamps
from fieldcal.logs.ingest import TidyLog
from fieldcal.logs.tidy import Disordered, TidySignal
from fieldcal.simulation.archive import settings as simulated_settings
from fieldcal.simulation.archive import signals
from fieldcal.simulation.experiment import simulate
from fieldcal.stages.preparation import find_manoeuvre, smooth
from fieldcal.stages.tables import matrix, triad

STEP_NS = 5_000_000
EPOCH_NS = 1_700_000_000_000_000_000
N = 4000
T_NS = np.arange(N) * STEP_NS


def tidied(columns: Columns, batch: int = 700, *, epoch: bool = False) -> tuple[pl.DataFrame, dict[str, Any]]:
    """The log read in batches, as a whole where streaming cannot put it in order."""
    for whole in (False, True):
        batches = [rows(columns, slice(i, i + batch)) for i in range(0, len(columns["t_ns"]), batch)]
        reader = Reader(*batches)
        reader.summary.epoch_known = epoch
        log = TidyLog(reader, "a.mcap", whole=whole)
        try:
            frame = pl.concat([part for _, part in log.tables()])
        except Disordered:
            continue
        return frame, log.facts()
    raise AssertionError("never in order")


def of_rows(frame: pl.DataFrame, columns: Columns) -> np.ndarray:
    """Which rows of `columns` came back, by a reading that is unique."""
    place = {value: row for row, value in enumerate(columns["gyroscope_x"].tolist())}
    return np.array([place[value] for value in frame["gyroscope_x"].to_list()])


@pytest.mark.parametrize("period_ns", stamps.COUNTER_PERIODS_NS)
def test_a_counter_that_began_again_goes_on(period_ns: int) -> None:
    true = T_NS + period_ns - 7_000_000_000
    columns = imu(true % period_ns)
    frame, facts = tidied(columns)
    assert np.array_equal(frame["t_ns"].to_numpy(), true)
    assert np.array_equal(of_rows(frame, columns), np.arange(N))
    assert (facts["verdict"], counts(facts)) == ("ok", {"clock_wrapped": 1})
    assert facts["duration_s"] == pytest.approx(N * 0.005, abs=0.01)


def test_a_late_message_about_the_wrap_is_sorted_in() -> None:
    period = stamps.COUNTER_PERIODS_NS[0]
    true = T_NS + period - 1000 * STEP_NS
    order = np.arange(N)
    order[999:1001] = [1000, 999]
    columns = imu((true % period)[order])
    frame, facts = tidied(columns)
    assert np.array_equal(frame["t_ns"].to_numpy(), true)
    assert facts["verdict"] == "ok"


@given(st.lists(st.integers(1, 3_000_000_000), min_size=20, max_size=60), st.integers(0, 2**32 * 1000 - 1))
@settings(max_examples=100, derandomize=True, deadline=None)
def test_unwrapping_gives_back_any_growing_stamps(steps: list[int], start: int) -> None:
    period = stamps.COUNTER_PERIODS_NS[0]
    true = start + np.cumsum(np.array(steps, np.int64))
    unwrap = stamps.Unwrapper()
    parts = [unwrap(part) for part in np.array_split(true % period, 5)]
    wrapped = np.concatenate(parts)
    assert np.array_equal(np.diff(wrapped), np.diff(true))


@pytest.mark.parametrize("back_s", [0.06, 0.3, 0.9])
def test_a_clock_set_back_a_little_costs_the_shorter_stretch(back_s: float) -> None:
    """Rows of two different moments are never laid beside each other."""
    t = T_NS - np.where(np.arange(N) >= 1500, round(back_s * 1e9) + 1, 0)
    columns = imu(t)
    frame, facts = tidied(columns)
    assert np.array_equal(of_rows(frame, columns), np.arange(1500, N))
    assert (facts["verdict"], facts["reason_code"], counts(facts)) == ("partial", "clock_set", {"clock_set": 1500})
    assert f"set back by {back_s:.3f} s" in facts["reason"]


@pytest.mark.parametrize("back_s", [1.5, 7.5])
@pytest.mark.parametrize("same_grid", [False, True])
def test_a_clock_that_was_reset_is_quarantined_with_its_number(back_s: float, same_grid: bool) -> None:
    t = T_NS - np.where(np.arange(N) >= 2000, round(back_s * 1e9) + (0 if same_grid else 1), 0)
    _, facts = tidied(imu(t))
    assert (facts["verdict"], facts["reason_code"]) == ("quarantined", "clock_reset")
    assert f"step back by {back_s:.3f} s" in facts["reason"]


def test_a_clock_set_from_boot_time_to_the_epoch() -> None:
    t = T_NS + np.where(np.arange(N) >= 1000, EPOCH_NS, 0)
    columns = imu(t)
    frame, facts = tidied(columns, epoch=True)
    assert np.array_equal(of_rows(frame, columns), np.arange(1000, N))
    assert (facts["verdict"], facts["reason_code"]) == ("partial", "clock_set")
    assert facts["duration_s"] < 20.0
    assert facts["started_at_ns"] == EPOCH_NS + 1000 * STEP_NS
    late = T_NS + np.where(np.arange(N) >= 3000, EPOCH_NS, 0)
    _, facts = tidied(imu(late), epoch=True)
    assert facts["started_at_ns"] is None


@pytest.mark.parametrize("where_ns", [10**16, -(10**15), 3_600_000_000_000])
def test_wild_stamps_are_masked(where_ns: int) -> None:
    t = T_NS.copy()
    t[[500, 1500, 1501]] = where_ns + np.arange(3)
    columns = imu(t)
    frame, facts = tidied(columns)
    assert np.array_equal(of_rows(frame, columns), np.delete(np.arange(N), [500, 1500, 1501]))
    assert (facts["verdict"], facts["reason_code"], counts(facts)) == ("partial", "wild_stamps", {"wild_stamps": 3})
    assert facts["duration_s"] < 20.0


def test_a_wild_stamp_inside_the_recording_is_masked_a_late_message_is_not() -> None:
    t = T_NS.copy()
    t[500] = T_NS[3000] + 1
    frame, facts = tidied(imu(t))
    assert (facts["verdict"], counts(facts)) == ("partial", {"wild_stamps": 1})
    order = np.r_[0:500, 501:3000, 500, 3000:N]
    columns = imu(T_NS)
    frame, facts = tidied(rows(columns, order))
    assert np.array_equal(frame["t_ns"].to_numpy(), T_NS)
    assert facts["verdict"] == "ok"


def test_stamps_that_stand_are_contradictory() -> None:
    _, facts = tidied(imu(T_NS // (100 * STEP_NS) * (100 * STEP_NS)))
    assert (facts["verdict"], facts["reason_code"]) == ("quarantined", "clock_stands")
    assert f"{N - N // 100} of {N} rows" in facts["reason"]


@pytest.mark.parametrize("factor", [1000, 1e-3])
def test_a_wrong_unit_of_time_is_told_by_the_rate(factor: float) -> None:
    _, facts = tidied(imu((T_NS * factor).astype(np.int64)))
    assert (facts["verdict"], facts["reason_code"]) == ("quarantined", "implausible_rate")
    assert f"{200 / factor:.4g} Hz" in facts["reason"]


def test_pauses_are_told_with_their_length() -> None:
    t = T_NS + np.where(np.arange(N) >= 1000, 23_000_000_000, 0) + np.where(np.arange(N) >= 3000, 2_000_000_000, 0)
    frame, facts = tidied(imu(t))
    assert len(frame) == N
    assert (facts["verdict"], counts(facts)) == ("ok", {"gaps": 2})
    assert "23.005 s" in facts["findings"][0]["sentence"]


def test_a_long_stream_that_turns_out_suspicious_is_read_as_a_whole() -> None:
    t = T_NS - np.where(np.arange(N) >= 3500, 200_000_001, 0)
    columns = imu(t)
    signal = TidySignal("imu", held_rows=100)
    batches = (signal.add(rows(columns, slice(i, i + 100))) for i in range(0, N, 100))
    with pytest.raises(Disordered):
        list(chain.from_iterable(batches))


@given(st.integers(0, 2**32), st.floats(0.0, 20.0))
@settings(max_examples=60, derandomize=True, deadline=None)
def test_any_late_messages_are_only_sorted(seed: int, spread: float) -> None:
    """Messages that come late by any number of places, each with its true stamp, are all kept."""
    rng = np.random.default_rng(seed)
    order = np.argsort(np.arange(600) + rng.uniform(0.0, spread, 600), kind="stable")
    columns = imu(T_NS[:600], seed=1)
    frame, facts = tidied(rows(columns, order), batch=97)
    assert np.array_equal(frame["t_ns"].to_numpy(), T_NS[:600])
    assert facts["verdict"] == "ok"


def test_a_magnetometer_that_pauses_is_not_interpolated_across() -> None:
    recording = simulate(seed=3, duration_s=20.0, sets=1, vps=False)
    tables = signals(recording)
    t = tables["imu"]["t_ns"].to_numpy()
    pause = (t > 8_000_000_000) & (t < 9_500_000_000)
    tables["magnetometer"] = tables["magnetometer"].filter(pl.Series(~pause))
    chosen = simulated_settings(recording.experiment)
    segments = find_manoeuvre({"imu": tables["imu"]}, taken_from(chosen, ManoeuvreSettings)).tables["segments"]
    samples = smooth({**tables, "segments": segments}, taken_from(chosen, SmoothingSettings)).tables["samples"]
    kept = samples["t_ns"].to_numpy()
    assert not ((kept > 8_000_000_000) & (kept < 9_500_000_000)).any()
    segment = samples["segment"].to_numpy()
    before, behind = segment[kept <= 8_000_000_000], segment[kept >= 9_500_000_000]
    assert not set(before.tolist()) & set(behind.tolist())
    logged = matrix(tables["magnetometer"], triad("magnetometer"))
    own = np.searchsorted(tables["magnetometer"]["t_ns"].to_numpy(), kept)
    assert np.array_equal(matrix(samples, triad("magnetometer")), logged[own])
