"""Results as table rows: those of a fitted triad in `calibration`, faults, and the result of a stage."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TypedDict, cast, overload

import numpy as np
import polars as pl
from numpy.typing import ArrayLike

from fieldcal.estimation.faults import Fault
from fieldcal.geometry.rotation import Array
from fieldcal.names import Json, Method, Sensor, Status
from fieldcal.reason_codes import ReasonCode
from fieldcal.stages.tables import AXES, CalibrationRow


@dataclass(frozen=True)
class StageResult:
    """Tables that a stage made, how it ended and the numbers that decided it.

    Tables of a refused stage may still carry refused values; an error of ours is described in `reason`.
    """

    tables: dict[str, pl.DataFrame] = field(default_factory=dict)
    status: Status = Status.OK
    reason_code: ReasonCode | None = None
    reason: str | None = None
    measured: Mapping[str, Json] = field(default_factory=dict)


ZERO_SLOPE = "zero_per_degc"
FAULT_SCHEMA = {
    "sensor": pl.String,
    "axis": pl.String,
    "reason_code": pl.String,
    "number": pl.Float64,
    "limit": pl.Float64,
    "fatal": pl.Boolean,
    "reason": pl.String,
}


class FaultRow(TypedDict):
    """A row of `faults`."""

    sensor: str
    axis: str
    reason_code: str
    number: float
    limit: float
    fatal: bool
    reason: str


def fault_rows(faults: Sequence[Fault]) -> pl.DataFrame:
    """Faults as the table `faults`."""
    rows = [(f.sensor, f.axis, f.code, f.value, f.limit, f.fatal, f.sentence) for f in faults]
    return pl.DataFrame(rows, schema=FAULT_SCHEMA, orient="row")


def fatal_fault(faults: pl.DataFrame, sensors: tuple[str, ...]) -> FaultRow | None:
    """The first fatal row of `faults` that concerns one of `sensors`, or None."""
    if not faults["fatal"].any():  # so of most flights, and a filter takes far longer
        return None
    found = faults.filter(pl.col("fatal") & pl.col("sensor").is_in(list(sensors)))
    return cast(FaultRow, found.row(0, named=True)) if found.height else None


def triad_rows(
    sensor: Sensor,
    method: Method,
    scale: ArrayLike,
    bias: ArrayLike,
    covariance: Array,
    *,
    unit: str,
    logged_unit: str,
    reference_reading: ArrayLike,
    temperature_degc: float | None,
    reason_code: Sequence[ReasonCode | None] = (None, None, None),
    zero_reason_code: Sequence[ReasonCode | None] | None = None,
    cross_sd: Array | None = None,
) -> list[CalibrationRow]:
    """Rows scale, bias, zero and zero_bias of one triad with their standard deviations.

    `scale` (3, 3), `bias` (3,), `covariance` (6, 6) of (λx, λy, λz, bx, by, bz). zero = −b/λ in logged units;
    zero_bias = λ d0 + b at `reference_reading` d0 (3,). Off-diagonal scales (full form) have the sd
    of `cross_sd` (3, 3), if any. An axis with a reason code is refused; `zero_reason_code` where bias, zero and
    zero_bias have others than the scale.
    """
    matrix, b, d0 = (np.asarray(v, dtype=float) for v in (scale, bias, reference_reading))
    divisor = f"({logged_unit})" if "/" in logged_unit else logged_unit
    scale_unit = "1" if unit == logged_unit else f"{unit}/{divisor}"
    rows: list[CalibrationRow] = []

    def add(parameter: str, axis: str, i: int, value: float, variance: float | None, row_unit: str) -> None:
        code = (reason_code if parameter == "scale" or zero_reason_code is None else zero_reason_code)[i]
        finite = variance is not None and np.isfinite(variance) and variance >= 0
        rows.append(
            {
                "sensor": sensor,
                "method": method,
                "parameter": parameter,
                "axis": axis,
                "value": float(value) if np.isfinite(value) else None,
                "sd": float(np.sqrt(variance)) if finite and variance is not None else None,
                "unit": row_unit,
                "temperature_degc": temperature_degc,
                "status": Status.REFUSED if code else Status.OK,
                "reason_code": code,
            }
        )

    full = not np.array_equal(matrix, np.diag(np.diagonal(matrix)))
    zero_full = -np.linalg.solve(matrix, b) if full else -b / np.diagonal(matrix)
    offset_full = matrix @ d0 + b
    for i, axis in enumerate(AXES):
        lam, pair = matrix[i, i], np.ix_([i, 3 + i], [i, 3 + i])
        c = covariance[pair]
        add("scale", axis, i, lam, c[0, 0], scale_unit)
        add("bias", axis, i, b[i], c[1, 1], unit)
        to_zero = np.array([b[i] / lam**2, -1.0 / lam])
        add("zero", axis, i, zero_full[i], to_zero @ c @ to_zero, logged_unit)
        to_offset = np.array([d0[i], 1.0])
        add("zero_bias", axis, i, offset_full[i], to_offset @ c @ to_offset, unit)
    if full:
        for i, row in enumerate(AXES):
            for j, column in enumerate(AXES):
                own_variance = None if cross_sd is None else float(cross_sd[i, j] ** 2)
                variance = covariance[i, i] if i == j else own_variance
                add("scale", row + column, i, matrix[i, j], variance, scale_unit)
    return rows


def quantity_rows(
    sensor: Sensor,
    method: Method,
    parameter: str,
    axes: Sequence[str],
    value: ArrayLike,
    sd: ArrayLike,
    *,
    unit: str,
    temperature_degc: float | None,
    reason_code: Sequence[ReasonCode | None] | None = None,
) -> list[CalibrationRow]:
    """Rows of a parameter beside scale and zero: an axis ("" where it has none), value and sd each; one with a reason
    code is refused."""
    codes = [None] * len(axes) if reason_code is None else reason_code
    return [
        {
            "sensor": sensor,
            "method": method,
            "parameter": parameter,
            "axis": axis,
            "value": float(own),
            "sd": float(own_sd),
            "unit": unit,
            "temperature_degc": temperature_degc,
            "status": Status.REFUSED if code else Status.OK,
            "reason_code": code,
        }
        for axis, own, own_sd, code in zip(axes, np.asarray(value), np.asarray(sd), codes, strict=True)
    ]


def zero_slope_rows(
    sensor: Sensor,
    method: Method,
    slope: ArrayLike,
    sd: ArrayLike,
    *,
    logged_unit: str,
    temperature_degc: float | None,
    reason_code: Sequence[ReasonCode | None] = (None, None, None),
) -> list[CalibrationRow]:
    """Rows zero_per_degc of one triad: slope (3,) of its zero on temperature and sd (3,), logged units per °C; an axis
    with a reason code is refused."""
    return quantity_rows(
        sensor,
        method,
        ZERO_SLOPE,
        AXES,
        slope,
        sd,
        unit=f"({logged_unit})/degC" if "/" in logged_unit else f"{logged_unit}/degC",
        temperature_degc=temperature_degc,
        reason_code=reason_code,
    )


@overload
def plain(value: Mapping[str, object]) -> dict[str, Json]: ...
@overload
def plain(value: object) -> Json: ...
def plain(value: object) -> Json:
    """Plain JSON of a value: numpy numbers become Python's, what is not finite becomes None.

    Raises
    ------
    TypeError
        It is, or holds, something that JSON cannot express.
    """
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if value is None or isinstance(value, str | float | int):
        return value
    raise TypeError(f"{type(value).__name__} has no place in plain JSON")
