"""Dumps: read again as they were, and refused when anything of them is wrong."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import fieldcal
from fieldcal.names import Sensor
from fieldcal.onboard import Moments, RateEquations, dump, read_dumps

PAIR_OF_FLOATS = 2.0**-46


def board_state() -> tuple[Moments, RateEquations]:
    flight = fieldcal.simulate(seed=2, duration_s=20.0)
    moments, rates = Moments(), RateEquations(18)
    moments.feed(flight.counts["magnetometer"])
    rates.feed(np.rint(flight.t * 1e6), flight.q, flight.counts["gyroscope"])
    return moments, rates


def test_what_is_read_is_what_was_dumped(tmp_path: Path) -> None:
    moments, rates = board_state()
    path = tmp_path / "board.bin"
    path.write_bytes(dump("magnetometer", moments) + dump("gyroscope", rates))
    (sensor, one), (other, two) = read_dumps(path)
    assert (sensor, other) == (Sensor.MAGNETOMETER, Sensor.GYROSCOPE)
    assert isinstance(one, Moments)
    assert isinstance(two, RateEquations)
    np.testing.assert_allclose(one.values, moments.values, rtol=PAIR_OF_FLOATS)
    np.testing.assert_allclose(two.values, rates.values, rtol=PAIR_OF_FLOATS)
    np.testing.assert_allclose(one.noise.squares, moments.noise.squares, rtol=PAIR_OF_FLOATS)
    assert (two.block_samples, two.n_samples, two.noise.n_differences) == (18, 3700, rates.noise.n_differences)


def test_nothing_collected_is_nothing_merged() -> None:
    ((_, state),) = read_dumps(dump("accelerometer", Moments()))
    moments, _ = board_state()
    before = moments.values.copy()
    assert isinstance(state, Moments)
    moments.merge(state)
    np.testing.assert_array_equal(moments.values, before)


def test_damage_is_refused_by_what_is_where(tmp_path: Path) -> None:
    moments, _ = board_state()
    whole = dump("magnetometer", moments)
    rng = np.random.default_rng(1)
    for at in rng.choice(len(whole), 40, replace=False):
        damaged = bytearray(whole)
        damaged[at] ^= 1 << int(rng.integers(8))
        with pytest.raises(fieldcal.UnreadableLog, match="no whole dump"):
            read_dumps(bytes(damaged))
    path = tmp_path / "cut.bin"
    path.write_bytes(whole + whole[:-1])
    with pytest.raises(fieldcal.UnreadableLog, match=rf"cut\.bin: what begins at byte {len(whole)} is"):
        read_dumps(path)
    with pytest.raises(fieldcal.UnreadableLog, match="is empty"):
        read_dumps(b"")
    with pytest.raises(ValueError, match="forgotten"):
        dump("gyroscope", RateEquations(18, 0.9))
