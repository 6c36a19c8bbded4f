"""ROS 2 and Kalibr YAML, written as text: both use little of the language, strings are quoted as JSON is.

ROS 2 parameters hold the whole model: calibrated = S (raw − zero), S = scale + scale_per_degc (T − T0) and zero
likewise, matrices row by row.

Kalibr (scale-misalignment model, as its imu-*.yaml): raw = M · true + bias, so M = Λ⁻¹. It estimates the bias itself
along the recording and has no place for one, nor for temperature or a magnetometer.
"""

from __future__ import annotations

import json
from collections.abc import Iterable

import numpy as np

from fieldcal.exports.calibration import Constants, Export
from fieldcal.geometry.rotation import Array
from fieldcal.names import INERTIAL_FIRST, Sensor


def ros(constants: Constants) -> Export:
    """A ROS 2 parameter file for any node (`/**`)."""
    lines = [
        "# calibrated = S (raw - zero); S = scale + scale_per_degc (T - temperature_degc), 3 x 3 row by row;",
        "# zero likewise, + zero_per_degc2 (T - ...)^2 + zero_per_degc3 (T - ...)^3; sensor axes as logged",
        "/**:",
        "  ros__parameters:",
        "    fieldcal:",
        f"      vehicle_id: {json.dumps(constants.vehicle_id)}",
        f"      imu_id: {json.dumps(constants.imu_id)}",
        f"      as_of: {json.dumps(constants.as_of)}",
    ]
    for sensor in INERTIAL_FIRST:
        if (triad := constants.triads.get(sensor)) is None:
            continue
        lines += [
            f"      {sensor}:",
            f"        unit: {json.dumps(triad.unit)}",
            f"        raw_unit: {json.dumps(triad.logged_unit)}",
            f"        temperature_degc: {float(triad.temperature_degc)!r}",
            f"        scale: {_list(triad.scale.ravel())}",
            f"        zero: {_list(triad.zero)}",
            f"        scale_per_degc: {_list(triad.scale_per_degc.ravel())}",
            f"        zero_per_degc: {_list(triad.zero_per_degc)}",
            f"        zero_per_degc2: {_list(triad.zero_per_degc2)}",
            f"        zero_per_degc3: {_list(triad.zero_per_degc3)}",
            f"        scale_sd: {_list(triad.scale_sd)}",
            f"        zero_sd: {_list(triad.zero_sd)}",
        ]
    return Export("\n".join(lines) + "\n", ())


def kalibr(constants: Constants) -> Export:
    """The `imu0` block of a Kalibr IMU chain."""
    warnings = ["Kalibr needs noise densities and random walks, which fieldcal does not estimate: add the four lines."]
    blocks = {Sensor.ACCELEROMETER: "accelerometers", Sensor.GYROSCOPE: "gyroscopes"}
    lines = [
        f"# {constants.heading}",
        "imu0:",
        "  model: scale-misalignment",
        "  T_i_b:",
        *_rows(np.eye(4), "  "),
        "  time_offset: 0.0",
        "  # accelerometer_noise_density, accelerometer_random_walk, gyroscope_noise_density, gyroscope_random_walk,",
        "  # rostopic and update_rate: yours",
    ]
    for sensor, block in blocks.items():
        if (triad := constants.triads.get(sensor)) is None:
            continue
        lines += [
            f"  {block}:",
            f"    # zero ({_comment(triad.logged_unit)}): {_list(triad.zero)}",
            "    M:",
            *_rows(np.linalg.inv(triad.scale), "    "),
        ]
        if sensor == Sensor.GYROSCOPE:
            lines += ["    A:", *_rows(np.zeros((3, 3)), "    "), "    C_gyro_i:", *_rows(np.eye(3), "    ")]
        warnings.append(f"{sensor}: Kalibr estimates the bias itself; the zero is a comment only.")
        if np.any(triad.scale_per_degc != 0.0) or np.any(triad.zero_per_degc != 0.0):
            warnings.append(f"{sensor}: Kalibr knows no temperature; M is that at {triad.temperature_degc:g} °C.")
    if "magnetometer" in constants.triads:
        warnings.append("magnetometer: Kalibr has none; left out.")
    return Export("\n".join(lines) + "\n", tuple(warnings))


def _rows(matrix: Array, indent: str) -> Iterable[str]:
    return [f"{indent}- {_list(row)}" for row in matrix]


def _list(values: Array) -> str:
    return "[" + ", ".join(_number(float(v)) for v in values) + "]"


def _number(value: float) -> str:
    """A float as YAML 1.1 reads it: 1e-05 without a dot would be text."""
    if not np.isfinite(value):
        return ".nan"
    text = repr(value)
    return text.replace("e", ".0e", 1) if "e" in text and "." not in text else text


def _comment(text: str) -> str:
    return " ".join(text.split())
