"""What every form of the joint estimate hands on: constants with their refusals, what is known beforehand, the
attitude as a table."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import polars as pl

from fieldcal.estimation.joint.problem import PriorConstants
from fieldcal.geometry import sensor_model
from fieldcal.geometry.rotation import Array, from_matrix, multiply
from fieldcal.names import SENSORS, Approach, Method, Sensor, Status
from fieldcal.reason_codes import ReasonCode
from fieldcal.stages.inputs import Tables, mean_temperature, reference_reading
from fieldcal.stages.joint.judgement import judged_zeros
from fieldcal.stages.results import triad_rows
from fieldcal.stages.tables import AXES, QUATERNION, CalibrationRow, columns_of, matrix, triad

if TYPE_CHECKING:
    from fieldcal.config.stage_settings import JointSettings

QUATERNION_STEP = 2.0**-22
"""To which attitudes are rounded: far below what any estimate knows."""
UNITS = {Sensor.MAGNETOMETER: "", Sensor.ACCELEROMETER: "m/s^2", Sensor.GYROSCOPE: "rad/s"}


@dataclass(frozen=True)
class Found:
    """A triad's constants in logged units, matrix (3, 3) and bias (3,), with the covariance (6, 6) of its diagonal and
    bias, the sd (3, 3) of a full matrix, and why an axis' scale or zero is refused."""

    matrix: Array
    bias: Array
    covariance: Array
    cross_sd: Array | None
    codes: list[ReasonCode | None]
    zero_codes: list[ReasonCode | None]


def found_of(
    matrix: Array,
    bias: Array,
    covariance: Array,
    cross_sd: Array | None,
    codes: list[ReasonCode | None],
    prior: PriorConstants | None,
) -> Found:
    """The same with refusals of the scales by axis, `codes`; those of the zeros follow."""
    scale = np.diagonal(matrix)
    slope = np.hstack([np.diag(bias / scale**2), np.diag(-1.0 / scale)])
    zero_sd = np.sqrt(np.maximum(np.diagonal(slope @ covariance @ slope.T), 0.0))
    return Found(matrix, bias, covariance, cross_sd, codes, judged_zeros(codes, zero_sd, prior))


def chosen(s: JointSettings) -> tuple[Sensor, ...]:
    """Sensors whose constants this method is to give."""
    return tuple(name for name in SENSORS if s.method[name] != Approach.SERIAL)


def priors(s: JointSettings) -> dict[str, PriorConstants]:
    """What is known of each sensor whose unit, or nominal scale, is."""
    zero = {
        Sensor.GYROSCOPE: np.radians(s.prior_gyroscope_zero_dps),
        Sensor.ACCELEROMETER: s.prior_accelerometer_zero_mps2,
        Sensor.MAGNETOMETER: s.prior_magnetometer_zero * float(np.linalg.norm(s.field_ned)),
    }
    out = {}
    for sensor in SENSORS:
        nominal = s.nominal_scale[sensor]
        if nominal is None:
            continue
        scale = np.asarray(nominal) * np.asarray(s.polarity[sensor], dtype=float)
        covariance = np.diag(np.r_[(s.prior_scale_sd * scale) ** 2, np.full(3, zero[sensor] ** 2)])
        if sensor == Sensor.MAGNETOMETER:
            covariance[:3, :3] += s.prior_magnetometer_scale_sd**2 * np.outer(scale, scale)
        out[str(sensor)] = PriorConstants(scale, np.zeros(3), covariance)
    return out


def axes_of(s: JointSettings) -> Array:
    """Sensor axes into body axes, (3, 3)."""
    return sensor_model.frd_from_sensor(s.rotation_body_from_sensor, s.body)


def constant_rows(
    triads: Mapping[Sensor, Found], method: Method, tables: Tables, s: JointSettings
) -> list[CalibrationRow]:
    """Scale, bias and zero of each triad, with its refusals."""
    rows: list[CalibrationRow] = []
    for sensor, found in triads.items():
        rows += triad_rows(
            sensor,
            method,
            found.matrix,
            found.bias,
            found.covariance,
            unit=UNITS[sensor] or s.field_unit,
            logged_unit=s.units[sensor],
            reference_reading=reference_reading(s, sensor, matrix(tables["samples"], triad(sensor))),
            temperature_degc=mean_temperature(tables),
            reason_code=found.codes,
            zero_reason_code=found.zero_codes,
            cross_sd=found.cross_sd,
        )
    return rows


def refusals(triads: Mapping[Sensor, Found]) -> list[tuple[str, ReasonCode]]:
    """(axis, why) of each scale that is refused."""
    return [(f"{name} {axis}", c) for name, v in triads.items() for axis, c in zip(AXES, v.codes, strict=True) if c]


def status_of(triads: Mapping[Sensor, Found]) -> Status:
    """Refused where every scale and zero is."""
    every = all(code for found in triads.values() for code in (*found.codes, *found.zero_codes))
    return Status.REFUSED if every else Status.OK


def trajectory_table(attitude: Array, tables: Tables, axes: Array) -> pl.DataFrame:
    """Attitude of the body at every sample, to half a microradian: its table would be three times as large else."""
    samples = tables["samples"]
    q = np.round(multiply(attitude, from_matrix(axes)) / QUATERNION_STEP) * QUATERNION_STEP
    return samples.select("t_ns", "segment").with_columns(
        **{name: pl.Series(values) for name, values in columns_of(q, QUATERNION).items()}
    )
