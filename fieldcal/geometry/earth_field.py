"""The local magnetic field: World Magnetic Model for a place and date, or what is configured."""

from __future__ import annotations

from datetime import UTC, datetime
from functools import lru_cache
from typing import Protocol

import numpy as np

from fieldcal.errors import ConfigurationError
from fieldcal.geometry.rotation import Array
from fieldcal.reason_codes import ReasonCode

UNIT_IN_TESLA = {"T": 1.0, "uT": 1e-6, "G": 1e-4}


def dip_rad(field: Array) -> float:
    """Dip of a field (3,), north, east, down (or level, level, down): its angle below the horizon, rad."""
    return float(np.arctan2(field[2], np.hypot(field[0], field[1])))


class _Field(Protocol):
    """North, east, down; nanotesla."""

    x: float
    y: float
    z: float


class _Model(Protocol):
    """pygeomag's, which has no types of its own; degrees, kilometres, decimal year."""

    def calculate(self, *, glat: float, glon: float, alt: float, time: float) -> _Field: ...


@lru_cache(maxsize=4)
def _model(year: int) -> _Model:
    """The five-year model that covers a year."""
    from pygeomag import GeoMag

    epoch = min(2025, max(2010, year - year % 5))
    model: _Model = GeoMag(coefficients_file=f"wmm/WMM_{epoch}.COF")
    return model


def world_magnetic_model(latitude_deg: float, longitude_deg: float, altitude_m: float, when: datetime) -> Array:
    """Field (north, east, down), tesla, at a geodetic position and UTC date (WMM 2010 to 2025).

    Raises
    ------
    ConfigurationError
        `field_outside_model`: the date lies outside the model's validity, or the position is no position.
    """
    when = when.astimezone(UTC)
    start = datetime(when.year, 1, 1, tzinfo=UTC)
    length = (datetime(when.year + 1, 1, 1, tzinfo=UTC) - start).total_seconds()
    year = when.year + (when - start).total_seconds() / length
    if not (-90 <= latitude_deg <= 90 and -180 <= longitude_deg <= 360):
        raise ConfigurationError(
            ReasonCode.FIELD_OUTSIDE_MODEL,
            f"latitude {latitude_deg}, longitude {longitude_deg} is no position on the Earth.",
        )
    try:
        result = _model(when.year).calculate(glat=latitude_deg, glon=longitude_deg, alt=altitude_m / 1000.0, time=year)
    except ValueError as error:
        raise ConfigurationError(
            ReasonCode.FIELD_OUTSIDE_MODEL,
            f"The World Magnetic Model does not cover {when.date()}: configure"
            f" field.north_east_down instead ({error}).",
        ) from error
    return np.array([result.x, result.y, result.z]) * 1e-9


def in_unit(field_tesla: Array, unit: str) -> Array:
    """A field in tesla in the unit asked for; "norm" makes it a unit vector."""
    if unit == "norm":
        return np.asarray(field_tesla / np.linalg.norm(field_tesla))
    return np.asarray(field_tesla / UNIT_IN_TESLA[unit])
