"""Columns ↔ arrays: how polars tables of signals, samples and results become numpy and back."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypedDict

import numpy as np
import polars as pl

from fieldcal.geometry.rotation import Array
from fieldcal.names import Method, Sensor, Status
from fieldcal.reason_codes import ReasonCode

AXES = ("x", "y", "z")
QUATERNION = ("qx", "qy", "qz", "qw")


def triad(name: str, prefix: str = "") -> list[str]:
    """Column names of a triad: gyroscope → gyroscope_x, …"""
    return [f"{prefix}{name}_{axis}" for axis in AXES]


def matrix(table: pl.DataFrame, columns: Sequence[str]) -> Array:
    """Columns as (n, m) float64; nulls become NaN."""
    return np.column_stack([table[c].to_numpy() for c in columns]).astype(np.float64, copy=False)


def seconds(t_ns: pl.Series, origin_ns: int) -> Array:
    """Stamps as float64 seconds from `origin_ns` (subtracted as integers first)."""
    return (t_ns.to_numpy() - origin_ns) * 1e-9


def columns_of(array: Array, names: Sequence[str]) -> dict[str, Array]:
    """(n, m) array as named columns."""
    return {name: np.ascontiguousarray(array[:, i]) for i, name in enumerate(names)}


class CalibrationRow(TypedDict):
    """A row of the `calibration` table as a stage writes it."""

    sensor: Sensor
    method: Method
    parameter: str
    axis: str
    value: float | None
    sd: float | None
    unit: str
    temperature_degc: float | None
    status: Status
    reason_code: ReasonCode | None


def calibration_rows(rows: list[CalibrationRow]) -> pl.DataFrame:
    """Rows of the `calibration` table as a stage writes it."""
    return pl.DataFrame(
        rows,
        schema={
            "sensor": pl.String,
            "method": pl.String,
            "parameter": pl.String,
            "axis": pl.String,
            "value": pl.Float64,
            "sd": pl.Float64,
            "unit": pl.String,
            "temperature_degc": pl.Float64,
            "status": pl.String,
            "reason_code": pl.String,
        },
    )


def covariance_table(covariance: Array) -> pl.DataFrame:
    """A (p, p) covariance as rows (row, column, value)."""
    row, column = np.indices(covariance.shape)
    return pl.DataFrame(
        {
            "row": row.ravel().astype(np.int32),
            "column": column.ravel().astype(np.int32),
            "value": np.ascontiguousarray(covariance).ravel(),
        }
    )


def covariance_of(table: pl.DataFrame) -> Array:
    """The (p, p) covariance of `covariance_table`'s rows."""
    size = round(len(table) ** 0.5)
    return np.asarray(table.sort("row", "column")["value"].to_numpy().reshape(size, size))


def constants(
    calibration: pl.DataFrame, sensor: Sensor, method: Method | None = None, *, refused_too: bool = False
) -> tuple[Array, Array] | None:
    """(Λ (3, 3), b (3,)) of a sensor from `calibration` rows; None where there are none, or (normally) one is
    refused."""
    asked = ("sensor", "method", "status", "parameter", "axis", "value")
    every = zip(*(calibration[name].to_list() for name in asked), strict=True)
    rows = [own for its, by, *own in every if its == sensor and method in (None, by)]
    if not rows or (not refused_too and any(status != Status.OK for status, *_ in rows)):
        return None
    value = {(parameter, axis): v for _, parameter, axis, v in rows}
    bias = np.array([value["bias", a] for a in AXES], dtype=float)
    if ("scale", "xy") in value:
        scale = np.array([[value["scale", r + c] for c in AXES] for r in AXES], dtype=float)
    else:
        scale = np.diag(np.array([value["scale", a] for a in AXES], dtype=float))
    return scale, bias
