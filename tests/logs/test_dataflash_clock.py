"""Stamps, times of sampling, the date by GPS and parameters over time, each at the limits at which they change."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from dataflash_support import rows_of

from fieldcal.logs.dataflash.clock import epoch, leap_seconds, sampled_ns, stamps_ns
from fieldcal.logs.dataflash.corrections import Thermal, magnetometer
from fieldcal.logs.dataflash.orientation import ROLL_PITCH_YAW_DEG, orientation_matrix
from fieldcal.logs.dataflash.parameters import Parameters, compass_names, inertial_names

S = 10**9
LATEST = 4 * 10**15
GPS_EPOCH = np.datetime64("1980-01-06", "ns").astype(np.int64)
LEAPS = {"1999-01-01": 13, "2006-01-01": 14, "2009-01-01": 15, "2012-07-01": 16, "2015-07-01": 17, "2017-01-01": 18}
"""GPS time less UTC from each day on (IERS Bulletin C)."""


@pytest.mark.parametrize(
    ("name", "letters", "columns", "expected"),
    [
        ("IMU", "Q", {"TimeUS": [0, 1, LATEST, LATEST + 1, 2**64 - 1]}, [0, 1000, *[LATEST * 1000] * 3]),
        ("IMU", "q", {"TimeUS": [-(2**63), -1, 0, 1, LATEST + 1]}, [0, 0, 0, 1000, LATEST * 1000]),
        ("IMU", "II", {"TimeMS": [7, 2**32 - 1], "T": [1, 2]}, [7_000_000, (2**32 - 1) * 1_000_000]),
        ("GPS", "II", {"TimeMS": [7], "T": [9]}, [9_000_000]),
        ("GPS", "IH", {"TimeMS": [7], "Week": [9]}, [7_000_000]),
        ("GPS", "QII", {"TimeUS": [3], "TimeMS": [7], "T": [9]}, [3000]),
        ("IMU", "I", {"T": [7]}, None),
    ],
)
def test_stamps(name: str, letters: str, columns: dict[str, list[int]], expected: list[int] | None) -> None:
    found = stamps_ns(rows_of(name, letters, columns))
    assert (None if found is None else found.tolist()) == expected


@pytest.mark.parametrize("bits", [32, 64])
@pytest.mark.parametrize(
    ("t_us", "sample_us", "taken"),
    [
        (10**7, 9 * 10**6, True),  # a second late, the most there is
        (10**7, 9 * 10**6 - 1, False),
        (10**7, 11 * 10**6, True),
        (10**7, 11 * 10**6 + 1, False),
        (500_000, 1, True),
        (500_000, 0, False),  # 0 says nothing
        (10**7, 1, False),
    ],
)
def test_a_time_of_sampling_is_taken_within_a_second(bits: int, t_us: int, sample_us: int, taken: bool) -> None:
    t_ns, sample = np.array([t_us * 1000 + 321]), np.array([sample_us])
    assert sampled_ns(t_ns, sample, bits).tolist() == [sample_us * 1000 if taken else t_us * 1000 + 321]


def test_a_counter_of_32_bits_wraps_between_sample_and_message_and_one_of_64_does_not() -> None:
    t_us, late_us = np.array([(1 << 32) + 400, (1 << 32) - 400, 5 << 32]), np.array([500, -500, 7])
    sample_us = t_us - late_us
    assert sampled_ns(t_us * 1000, sample_us % (1 << 32), 32).tolist() == (sample_us * 1000).tolist()
    assert sampled_ns(t_us[2:] * 1000, sample_us[2:] % (1 << 32), 64).tolist() == [t_us[2] * 1000]


def test_leap_seconds_change_with_the_nanosecond() -> None:
    for (_, before), (day, since) in pairwise([("", 13), *LEAPS.items()]):
        begins = int(np.datetime64(day, "ns").astype(np.int64))
        assert [leap_seconds(begins - 1), leap_seconds(begins)] == [before, since], day
    assert leap_seconds(0) == 13


def gps(**columns: list[int]) -> dict[str, list[int]]:
    """A fix a second from 100 s after boot on, in week 2300."""
    whole = {"TimeUS": [100 * 10**6, 101 * 10**6], "Status": [3, 3], "GWk": [2300, 2300], "GMS": [50_000, 51_000]}
    return whole | columns


@pytest.mark.parametrize(
    ("columns", "fixes"),
    [
        (gps(), 2),
        (gps(Status=[2, 3]), 1),
        (gps(Status=[2, 2]), 0),
        (gps(Status=[6, 5]), 2),
        (gps(GWk=[0, 2300]), 1),
        (gps(GWk=[1, 1]), 2),
        (gps(GMS=[604_800_000, 1000]), 1),
        (gps(GMS=[604_799_999, 0]), 2),
        (gps(Status=[2, 3], GWk=[2300, 0]), 0),
        (gps(GWk=[0, 2300], GMS=[0, 604_800_000]), 0),
    ],
)
def test_messages_that_tell_the_date(columns: dict[str, list[int]], fixes: int) -> None:
    found = epoch(rows_of("GPS", "QBHI", columns))
    assert (0 if found is None else found.fixes) == fixes


@pytest.mark.parametrize("missing", ["TimeUS", "Status", "GWk", "GMS"])
def test_the_date_needs_every_column(missing: str) -> None:
    kept = {name: (letter, gps()[name]) for name, letter in zip(gps(), "QBHI", strict=True) if name != missing}
    rows = rows_of("GPS", "".join(letter for letter, _ in kept.values()), {n: v for n, (_, v) in kept.items()})
    assert epoch(rows) is None
    assert epoch(None) is None


def test_the_date_is_the_median_to_the_nanosecond() -> None:
    t_us, late_ms = np.array([123_457, 1_123_461, 2_123_473]), np.array([9, 4, 7])
    ms = 50_000 + late_ms + t_us // 1000
    found = epoch(rows_of("GPS", "QBHI", gps(TimeUS=t_us.tolist(), Status=[3] * 3, GWk=[2300] * 3, GMS=ms.tolist())))
    assert found is not None
    begin = int(GPS_EPOCH) + 2300 * 604_800 * S - 18 * S
    ahead = sorted(begin + int(m) * 10**6 - int(t) * 1000 for m, t in zip(ms, t_us, strict=True))
    assert (found.offset_ns, found.fixes, found.leap_s) == (ahead[1], 3, 18)
    one = epoch(rows_of("GPS", "QBHI", {name: column[:1] for name, column in gps().items()}))
    assert one is not None
    assert one.offset_ns == begin + 50 * S - 100 * S


def test_parameters_hold_from_their_change_on() -> None:
    rows = rows_of("PARM", "Nf", {"Name": [b"X", b"X", b"X", b"X", b"Y", b"X"], "Value": [1, 1, np.nan, 2, np.nan, 3]})
    parameters = Parameters(rows, [10, 20, 30, 40, 50, 60])
    assert [parameters.value("X", t) for t in (0, 39, 40, 59, 60, 99)] == [1, 1, 2, 2, 3, 3]
    assert parameters.changes_ns(["X", "Y"]) == [40, 60]
    assert ("X" in parameters, "Y" in parameters, "Z" in parameters) == (True, False, False)
    assert (parameters.first("X"), parameters.first("Y"), parameters.first("Y", 7.0)) == (1, 0, 7)
    assert (parameters.value("Y", 5), parameters.value("Y", 5, 7.0)) == (0, 7)
    assert parameters.last(["X", "Y"]) == {"X": 3}
    assert parameters.held(["X", "Y"], 45) == {"X": 2}


@pytest.mark.parametrize("columns", [{"Name": [b"X"]}, {"Value": [1.0]}, {"Name": [1.0], "Value": [1.0]}])
def test_parameters_need_name_and_value(columns: dict[str, list[object]]) -> None:
    letters = "".join("N" if isinstance(values[0], bytes) else "f" for values in columns.values())
    assert "X" not in Parameters(rows_of("PARM", letters, columns), [1])


def test_what_is_told_of_a_calibration_in_memory() -> None:
    gyroscope, accelerometer, compass = inertial_names("GYR", 1), inertial_names("ACC", 1), compass_names(1)
    assert "INS_GYR_CAL" in gyroscope.loaded()
    assert "INS_GYR_CAL" not in accelerometer.loaded()
    assert {"INS_GYR2_ID", "INS_USE2", "INS_TCAL2_ENABLE", "INS_GYR2_CALTEMP"} <= {*gyroscope.loaded()}
    assert {"COMPASS_MOTCT", "COMPASS_LEARN", "COMPASS_MOT2_Z", "COMPASS_USE2"} <= {*compass.loaded()}


def test_right_angles_are_exact() -> None:
    """A reading that is only turned by them stays exactly as it is, but for order and sign."""
    for number, angles in enumerate(ROLL_PITCH_YAW_DEG):
        matrix = orientation_matrix(number, lambda name: 0.0)
        assert matrix is not None
        if all(angle % 90 == 0 for angle in angles):
            assert np.array_equal(np.abs(matrix).sum(axis=0), np.ones(3))
            assert np.array_equal(matrix, np.round(matrix))


@pytest.mark.parametrize(("degc", "sloping"), [(9.999, False), (10.0, True), (50.0, True), (50.001, False)])
def test_a_thermal_offset_slopes_up_to_its_limits(degc: float, sloping: bool) -> None:
    slope = Thermal(np.diag([1e6, 0.0, 0.0]), 30.0, 10.0, 50.0).slope(degc)
    assert slope.tolist() == [1.0 * sloping, 0.0, 0.0]


@pytest.mark.parametrize(
    ("scale", "applied"),
    [
        (1.5, 1.5),
        (np.nextafter(1.5, 2), 1.0),
        (1.0 / 1.5, 1.0 / 1.5),
        (np.nextafter(1.0 / 1.5, 0), 1.0),
        (-1.0, 1.0),
    ],
)
def test_a_scale_applies_up_to_its_limits(scale: float, applied: float) -> None:
    affine = magnetometer(np.eye(3), [1.0, 2.0, 3.0], [1.0, 0.0, 2.0], np.zeros(3), scale)
    assert np.allclose(affine.matrix, applied * np.diag([1.0, 0.0, 2.0]), rtol=1e-15)
    assert np.allclose(affine.offset, applied * np.array([1.0, 0.0, 6.0]), rtol=1e-15)
