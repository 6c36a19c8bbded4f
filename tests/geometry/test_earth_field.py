"""The World Magnetic Model against the test values published with it."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta, timezone

import numpy as np
import pytest

from fieldcal.errors import ConfigurationError
from fieldcal.geometry.earth_field import in_unit, world_magnetic_model

NANOTESLA = 1e-9
PRINTED_TO_T = 0.06 * NANOTESLA  # the published values are rounded to 0.1 nT
EPOCH, MID = datetime(2025, 1, 1, tzinfo=UTC), datetime(2027, 7, 2, 12, tzinfo=UTC)  # 2025.0 and 2027.5
# WMM2025 test values (NOAA NCEI / BGS): date, height km, latitude, longitude, X, Y, Z nT
PUBLISHED = [
    (EPOCH, 0, 80, 0, 6521.6, 145.9, 54791.5),
    (EPOCH, 0, 0, 120, 39677.8, -109.6, -10580.2),
    (EPOCH, 0, -80, 240, 6117.5, 15751.9, -52022.5),
    (EPOCH, 100, 80, 0, 6216.0, 92.4, 52598.8),
    (EPOCH, 100, 0, 120, 37688.6, -96.2, -10152.1),
    (EPOCH, 100, -80, 240, 5907.6, 14780.3, -49540.7),
    (MID, 0, 80, 0, 6500.8, 294.5, 54869.4),
    (MID, 0, 0, 120, 39701.6, -167.4, -10381.8),
    (MID, 0, -80, 240, 6200.7, 15730.3, -51783.7),
    (MID, 100, 80, 0, 6196.7, 233.8, 52670.5),
    (MID, 100, 0, 120, 37711.5, -148.7, -9969.8),
    (MID, 100, -80, 240, 5984.0, 14760.1, -49317.7),
]


@pytest.mark.parametrize(("when", "height_km", "latitude", "longitude", "x", "y", "z"), PUBLISHED)
def test_published_values(
    when: datetime, height_km: float, latitude: float, longitude: float, x: float, y: float, z: float
) -> None:
    field = world_magnetic_model(latitude, longitude, 1000.0 * height_km, when)
    np.testing.assert_allclose(field, np.array([x, y, z]) * NANOTESLA, atol=PRINTED_TO_T)


def test_earlier_dates_take_their_own_model() -> None:
    """WMM2020's first published value; WMM2025 run backwards would miss it by hundreds of nT."""
    field = world_magnetic_model(80.0, 0.0, 0.0, datetime(2020, 1, 1, tzinfo=UTC))
    np.testing.assert_allclose(field, np.array([6570.4, -146.3, 54606.0]) * NANOTESLA, atol=PRINTED_TO_T)


def test_the_same_instant_in_another_zone() -> None:
    elsewhere = MID.astimezone(timezone(timedelta(hours=9)))
    np.testing.assert_array_equal(world_magnetic_model(52, 13, 34, elsewhere), world_magnetic_model(52, 13, 34, MID))


@pytest.mark.parametrize("year", [1990, 2009, 2031])
def test_dates_outside_the_models_are_refused(year: int) -> None:
    with pytest.raises(ConfigurationError, match=f"{year}-03-01") as refusal:
        world_magnetic_model(52.0, 13.0, 0.0, datetime(year, 3, 1, tzinfo=UTC))
    assert refusal.value.reason_code == "field_outside_model"
    assert "north_east_down" in refusal.value.sentence


@pytest.mark.parametrize("latitude", [-90.0, 0.0, 90.0])
@pytest.mark.parametrize(("longitude", "same"), [(-180.0, 180.0), (360.0, 0.0)])
def test_longitudes_go_round(latitude: float, longitude: float, same: float) -> None:
    """Up to the poles."""
    found, wanted = (world_magnetic_model(latitude, place, 0.0, MID) for place in (longitude, same))
    np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-3 * NANOTESLA)


@pytest.mark.parametrize(
    ("latitude", "longitude"), [(91.0, 0.0), (-90.1, 0.0), (0.0, 360.5), (0.0, -180.5), (float("nan"), 0.0)]
)
def test_no_position_on_the_earth(latitude: float, longitude: float) -> None:
    with pytest.raises(ConfigurationError, match="no position"):
        world_magnetic_model(latitude, longitude, 0.0, MID)


def test_units() -> None:
    field = np.array([20e-6, -1e-6, 44e-6])
    np.testing.assert_allclose(in_unit(field, "uT"), [20.0, -1.0, 44.0])
    np.testing.assert_allclose(in_unit(field, "G"), [0.2, -0.01, 0.44])
    np.testing.assert_allclose(np.linalg.norm(in_unit(field, "norm")), 1.0)
    np.testing.assert_array_equal(in_unit(field, "T"), field)
