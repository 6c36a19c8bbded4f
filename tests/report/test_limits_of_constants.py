"""Limits of a magnetometer's zero by what it does to the heading, against the turn of a compass needle."""

from __future__ import annotations

import numpy as np
import pytest

from fieldcal.config.configuration import Tolerances
from fieldcal.report.standing.due import Flown, Limit, limit_in

DIP_RAD = 1.1
TOTAL_G = 0.5
FLOWN = Flown({}, (), TOTAL_G * np.cos(DIP_RAD), np.cos(DIP_RAD))
IN_GAUSS = {"norm": TOTAL_G, "G": 1.0, "uT": 0.01, "T": 1e4}


@pytest.mark.parametrize("unit", IN_GAUSS)
@pytest.mark.parametrize("heading_deg", [0.5, 2.0, 10.0])
def test_a_zero_at_the_limit_turns_a_level_compass_by_so_much(unit: str, heading_deg: float) -> None:
    found = limit_in("magnetometer", unit, Tolerances(heading_deg=heading_deg), FLOWN)
    assert found is not None
    north, east, _ = np.array([np.cos(DIP_RAD), 0.0, np.sin(DIP_RAD)]) * TOTAL_G + [
        0.0,
        found.value * IN_GAUSS[unit],
        0.0,
    ]
    assert np.degrees(np.arctan2(east, north)) == pytest.approx(heading_deg, rel=1e-12)
    assert found.told == f"{heading_deg:g}° of heading"


def test_in_units_of_the_field_nothing_is_told_without_its_dip_and_nothing_in_microtesla() -> None:
    both = Tolerances(heading_deg=2.0, magnetometer_ut=1.0)
    assert limit_in("magnetometer", "norm", both, Flown({}, (), 0.2, None)) is None
    assert limit_in("magnetometer", "counts", both, FLOWN) is None
    assert limit_in("magnetometer", "norm", Tolerances(magnetometer_ut=1.0), FLOWN) is None


@pytest.mark.parametrize(("microtesla", "told"), [(0.5, "0.5 µT"), (1.0, "2° of heading")])
def test_the_tighter_limit_decides(microtesla: float, told: str) -> None:
    """Two degrees in 0.227 G are 0.79 µT."""
    found = limit_in("magnetometer", "G", Tolerances(heading_deg=2.0, magnetometer_ut=microtesla), FLOWN)
    assert found is not None
    assert found.told == told


def test_inertial_sensors_have_limits_in_their_own_unit_only() -> None:
    limits = Tolerances(gyroscope_degps=0.5, accelerometer_mg=10.0, heading_deg=2.0)
    assert limit_in("gyroscope", "rad/s", limits) == Limit(np.radians(0.5), "0.5 °/s")
    found = limit_in("accelerometer", "m/s^2", limits)
    assert found is not None
    assert (found.value, found.told) == (pytest.approx(0.0980665), "10 mg")
    assert limit_in("gyroscope", "counts", limits) is None
    assert limit_in("gyroscope", "rad/s", Tolerances(heading_deg=2.0)) is None
