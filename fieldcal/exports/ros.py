"""ROS: parameters with the whole model, and files for two packages that hold part of it. Sensor axes as logged.

ros            parameters of ROS 2 for any node: calibrated = S (raw − zero), S = scale + scale_per_degc (T − T0) and
               zero likewise, matrices row by row
imu_calib      the file of package imu_calib (node apply_calib): accelerometer = SM · raw − bias, SM row by row. Its
               gyroscope's zero it measures itself, at rest
imu_pipeline   parameters of package imu_pipeline: imu_transformer turns readings into body axes by a transform, which
               static_transform_publisher sends. No node of it takes constants: they are applied before
"""

from __future__ import annotations

import json

import numpy as np
from scipy.spatial.transform import Rotation

from fieldcal.errors import FieldcalError
from fieldcal.exports.calibration import Constants, Export
from fieldcal.exports.yaml_text import number, row
from fieldcal.names import INERTIAL_FIRST, Sensor
from fieldcal.reason_codes import ReasonCode

BODY_FRAME, SENSOR_FRAME = "base_link", "imu_link"


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
            f"        scale: {row(triad.scale.ravel())}",
            f"        zero: {row(triad.zero)}",
            f"        scale_per_degc: {row(triad.scale_per_degc.ravel())}",
            f"        zero_per_degc: {row(triad.zero_per_degc)}",
            f"        zero_per_degc2: {row(triad.zero_per_degc2)}",
            f"        zero_per_degc3: {row(triad.zero_per_degc3)}",
            f"        scale_sd: {row(triad.scale_sd)}",
            f"        zero_sd: {row(triad.zero_sd)}",
        ]
    return Export("\n".join(lines) + "\n", ())


def imu_calib(constants: Constants) -> Export:
    """The file that imu_calib's node apply_calib loads.

    Raises
    ------
    FieldcalError
        `not_loadable`: the accelerometer has no constants, or none in m/s².
    """
    triad = constants.triads.get(Sensor.ACCELEROMETER)
    if triad is None or (triad.unit, triad.logged_unit) != ("m/s^2", "m/s^2"):
        told = "has no constants" if triad is None else f"is in {triad.logged_unit}"
        raise FieldcalError(
            ReasonCode.NOT_LOADABLE,
            f"imu_calib corrects an accelerometer in m/s²; that of {constants.vehicle_id} {told}.",
        )
    lines = [
        f"# {constants.heading}",
        f"SM: {row(triad.scale.ravel())}",
        f"bias: {row(triad.scale @ triad.zero)}",
    ]
    warnings = []
    if Sensor.GYROSCOPE in constants.triads:
        warnings.append("gyroscope: imu_calib measures its zero itself, at rest, and has no scale; left out.")
    if triad.follows_temperature:
        warnings.append(f"accelerometer: imu_calib knows no temperature; it is that at {triad.temperature_degc:g} °C.")
    if Sensor.MAGNETOMETER in constants.triads:
        warnings.append("magnetometer: imu_calib has none; left out.")
    return Export("\n".join(lines) + "\n", tuple(warnings))


def imu_pipeline(constants: Constants) -> Export:
    """Parameters of imu_transformer, and of the publisher of the transform that it needs.

    Raises
    ------
    FieldcalError
        `not_loadable`: how the sensor is mounted is not known.
    """
    origin = next(iter(constants.origins.values()), None)
    if origin is None:
        raise FieldcalError(
            ReasonCode.NOT_LOADABLE, f"How the IMU of {constants.vehicle_id} is mounted is not known; run a night."
        )
    x, y, z, w = Rotation.from_matrix(np.array(origin.rotation_body_from_sensor)).as_quat()
    told = {"x": x, "y": y, "z": z, "w": w}
    lines = [
        f"# {constants.heading}",
        "imu_transformer:",
        "  ros__parameters:",
        f"    target_frame: {json.dumps(BODY_FRAME)}",
        "static_transform_publisher:",
        "  ros__parameters:",
        f"    frame_id: {json.dumps(BODY_FRAME)}",
        f"    child_frame_id: {json.dumps(SENSOR_FRAME)}",
        *(f"    translation.{axis}: 0.0" for axis in "xyz"),
        *(f"    rotation.{axis}: {number(float(value))}" for axis, value in told.items()),
    ]
    warnings = [
        "imu_pipeline has no place for constants: apply them before it (fieldcal apply, or a node with --format ros)."
    ]
    return Export("\n".join(lines) + "\n", tuple(warnings))
