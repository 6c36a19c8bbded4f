"""One triad of a calibrated flight: scale, bias and zero of one method, and what they make of readings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
import polars as pl
from numpy.typing import ArrayLike

from fieldcal.api.estimate import Estimate
from fieldcal.exports.calibration import Triad
from fieldcal.geometry import sensor_model
from fieldcal.geometry.rotation import Array
from fieldcal.schemas.rows import CalibrationRow
from fieldcal.stages.tables import AXES
from fieldcal.words.rows import typed

PARAMETERS = ("scale", "bias", "zero")


@dataclass(frozen=True)
class SensorCalibration:
    """What one method found of one triad: z = Λ z_d + b (Eq. 5), sensor axes as logged.

    Attributes
    ----------
    sensor : {"magnetometer", "accelerometer", "gyroscope"}
    method : str or None
        "ellipsoid_robust", "equation_error", "output_error", "joint", …; None where no method got as far as numbers.
    scale : Estimate
        λ (3,), or Λ (3, 3) with cross-axis terms; calibrated unit per logged unit, polarity in its sign.
    bias : Estimate
        b (3,), calibrated unit: m/s², rad/s, or the unit of the configured field.
    zero : Estimate
        −Λ⁻¹ b (3,), the reading at zero input, logged unit.

    Examples
    --------
    >>> import tempfile
    >>> import fieldcal
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     log = fieldcal.write_flights(folder, fieldcal.Experiment(duration_s=20.0))[0]
    ...     gyroscope = fieldcal.calibrate(log).gyroscope
    >>> gyroscope.method, gyroscope.ok, gyroscope.bias.unit
    ('joint', True, 'rad/s')
    >>> gyroscope.apply(gyroscope.zero.value[None]).round(6) + 0.0
    array([[0., 0., 0.]])
    """

    sensor: str
    method: str | None
    scale: Estimate
    bias: Estimate
    zero: Estimate

    @property
    def ok(self) -> bool:
        """Whether no axis was refused."""
        return self.scale.ok and self.bias.ok and self.zero.ok

    @property
    def reason(self) -> str | None:
        """Why an axis was refused; None when none was."""
        return self.scale.reason

    def apply(self, logged: ArrayLike) -> Array:
        """Calibrated readings z (n, 3) of logged ones (n, 3), both in the sensor axes as logged. Raises `Refused`."""
        return sensor_model.calibrate(logged, self.scale.value, self.bias.value)

    def triad(self, why: str) -> Triad:
        """The constants to fly with, as of this flight's temperature; `why`: where they come from. Raises `Refused`."""
        scale = self.scale.value
        matrix = scale if scale.ndim == 2 else np.diag(scale)
        return Triad(
            scale=matrix,
            zero=self.zero.value,
            scale_per_degc=np.zeros((3, 3)),
            zero_per_degc=np.zeros(3),
            scale_sd=self.scale.sd if self.scale.sd.ndim == 1 else np.diagonal(self.scale.sd).copy(),
            zero_sd=self.zero.sd,
            unit=self.bias.unit,
            logged_unit=self.zero.unit,
            temperature_degc=25.0 if self.scale.temperature_degc is None else self.scale.temperature_degc,
            flown_degc=None,
            why=(why,),
        )


def sensor_calibration(rows: pl.DataFrame, sensor: str, method: str, reason: str | None) -> SensorCalibration:
    """A triad from its rows of table `calibration`, those of one method; `reason` is told where an axis is refused."""
    own = {parameter: estimate(rows, sensor, method, parameter, reason) for parameter in PARAMETERS}
    return SensorCalibration(sensor, method, own["scale"], own["bias"], own["zero"])


def not_calibrated(sensor: str, reason_code: str, reason: str) -> SensorCalibration:
    """A triad without any numbers, and why."""
    scale, bias, zero = (
        Estimate(
            sensor, None, p, "", np.full(3, np.nan), None, ("refused",) * 3, reason_code, reason, np.full(3, np.nan)
        )
        for p in PARAMETERS
    )
    return SensorCalibration(sensor, None, scale, bias, zero)


def estimate(rows: pl.DataFrame, sensor: str, method: str, parameter: str, reason: str | None) -> Estimate:
    """One parameter from its rows, an axis or a matrix element each."""
    own = typed(rows.filter(pl.col("parameter") == parameter).iter_rows(named=True), CalibrationRow)
    found = {row["axis"]: row for row in own}
    first = found["x"]
    codes = [found[axis]["reason_code"] for axis in AXES if found[axis]["status"] != "ok"]
    x, y, z = (found[axis]["status"] for axis in AXES)
    return Estimate(
        sensor=sensor,
        method=method,
        parameter=parameter,
        unit=first["unit"],
        sd=_numbers(found, "sd"),
        temperature_degc=first["temperature_degc"],
        status=(x, y, z),
        reason_code=codes[0] if codes else None,
        reason=reason if codes else None,
        _value=_numbers(found, "value"),
    )


def _numbers(found: Mapping[str, CalibrationRow], column: Literal["value", "sd"]) -> Array:
    """A column by axis, (3,), or by element where there are cross-axis terms, (3, 3); what is null is NaN."""
    full = "xy" in found
    names = [a + b for a in AXES for b in AXES] if full else AXES
    numbers = np.array([found[name][column] for name in names], dtype=float)
    return numbers.reshape(3, 3) if full else numbers
