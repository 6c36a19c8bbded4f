"""One calibrated parameter of a triad: value, unit, sd, temperature and status; out of reach once refused."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import DTypeLike

from fieldcal.errors import Refused
from fieldcal.geometry.rotation import Array
from fieldcal.reason_codes import ReasonCode
from fieldcal.stages.tables import AXES


@dataclass(frozen=True, repr=False)
class Estimate:
    """A parameter of one triad, as one method found it.

    `value` raises `Refused` where an axis was refused, and so does ``np.asarray(estimate)``; ``estimate["x"]`` asks for
    one axis. `refused_value` gives the numbers all the same, for looking at.

    Attributes
    ----------
    sensor, method, parameter : str
        Whose it is: "gyroscope", "output_error", "scale".
    unit : str
        Of value and sd: a scale's is the calibrated unit per logged unit.
    sd : (3,) or (3, 3) array
        One standard deviation, `unit`; NaN where it is not known. It is given for refused values too: it is often why.
    temperature_degc : float or None
        Mean IMU temperature of the samples used, °C; None when the log has none.
    status : tuple of {"ok", "refused"}
        Of the axes x, y, z.
    reason_code, reason : str or None
        Why, of the first axis that was refused; None when none was.

    Examples
    --------
    >>> scale = Estimate("gyroscope", "joint", "scale", "rad/s/counts", np.full(3, 1e-6), 25.0,
    ...                  ("ok", "refused", "ok"), "axis_not_turned", "Nothing turned about y.", np.full(3, 2e-4))
    >>> scale["x"]
    0.0002
    >>> scale.value
    Traceback (most recent call last):
    ...
    fieldcal.errors.Refused: The gyroscope's scale (y) by joint was refused. Nothing turned about y.
    >>> scale.refused_value()
    array([0.0002, 0.0002, 0.0002])
    """

    sensor: str
    method: str | None
    parameter: str
    unit: str
    sd: Array
    temperature_degc: float | None
    status: tuple[str, str, str]
    reason_code: str | None
    reason: str | None
    _value: Array

    @property
    def ok(self) -> bool:
        """Whether no axis was refused."""
        return all(status == "ok" for status in self.status)

    @property
    def value(self) -> Array:
        """The parameter: (3,) by axis; a scale with cross-axis terms (3, 3), row by calibrated axis.

        Raises
        ------
        Refused
            An axis was refused; `reason_code` and the sentence say why.
        """
        if not self.ok:
            raise self._refused([axis for axis, status in zip(AXES, self.status, strict=True) if status != "ok"])
        return self._value.copy()

    def refused_value(self) -> Array:
        """The numbers whatever their status, NaN where there are none. They are not to be flown with."""
        return self._value.copy()

    def __repr__(self) -> str:
        at = "" if self.temperature_degc is None else f" at {self.temperature_degc:.1f} °C"
        head = f"{self.sensor} {self.parameter}" + ("" if self.method is None else f" by {self.method}")
        if not self.ok:
            return f"<{head}: refused, {self.reason_code}>"
        return f"<{head}: {self._value} ± {self.sd} {self.unit}{at}>"

    def __getitem__(self, axis: str) -> float:
        """The value of one axis, "x", or of one element of a matrix, "xy" (row x). Raises `Refused`, `KeyError`."""
        if axis not in AXES and (len(axis) != 2 or axis[0] not in AXES or axis[1] not in AXES):
            raise KeyError(f'an axis is "x", "y" or "z", an element of a matrix "xy"; not {axis!r}')
        row, column = AXES.index(axis[0]), AXES.index(axis[-1])
        if self.status[row] != "ok":
            raise self._refused([axis[0]])
        if self._value.ndim == 1:
            return float(self._value[row]) if row == column else 0.0
        return float(self._value[row, column])

    def __array__(self, dtype: DTypeLike | None = None, copy: bool | None = None) -> Array:
        """The value, for numpy. Raises `Refused`."""
        return np.asarray(self.value, dtype=dtype)

    def _refused(self, axes: list[str]) -> Refused:
        which = "" if len(axes) == len(AXES) else f" ({', '.join(axes)})"
        by = "" if self.method is None else f" by {self.method}"
        sentence = f"The {self.sensor}'s {self.parameter}{which}{by} was refused. {self.reason or ''}"
        return Refused(ReasonCode(self.reason_code or ReasonCode.NO_CALIBRATION), sentence.strip())
