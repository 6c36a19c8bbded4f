"""Kalibr: the file of an IMU that `kalibr_calibrate_imu_camera --imu FILE` reads, with the intrinsics of its model.

Conventions (kalibr, IccSensors.py, model scale-misalignment): in the IMU's frame i,

    accelerometer  raw = M_a a_i + bias                    M_a lower triangular: the frame is the accelerometer's
    gyroscope      raw = M_g C_gyro_i ω_i + A a_i + bias   M_g lower triangular, C_gyro_i a rotation

From ours, raw = Λ⁻¹ z + zero in sensor axes, Λ⁻¹ = M Q, Q a rotation: C_gyro_i = Q_g Q_aᵀ, and the frame i is turned by
Q_a against the sensor's axes, as T_i_b says. Kalibr estimates the biases along the recording and has no place for one,
nor for temperature or a magnetometer. It starts its estimate at M = 1: the matrices are what it would find.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import rq

from fieldcal.exports.calibration import Constants, Export
from fieldcal.exports.yaml_text import number, row, rows
from fieldcal.geometry.rotation import Array
from fieldcal.names import Sensor

TYPICAL = {
    "accelerometer_noise_density": 0.01,
    "accelerometer_random_walk": 0.0002,
    "gyroscope_noise_density": 0.005,
    "gyroscope_random_walk": 4.0e-06,
}
"""Of an ADIS16448, as Kalibr's documentation has them: m/s²/√Hz, m/s³/√Hz, rad/s/√Hz, rad/s²/√Hz."""
TYPICAL_RATE_HZ = 200.0
TOPIC = "/imu0"
BLOCKS = {Sensor.ACCELEROMETER: "accelerometers", Sensor.GYROSCOPE: "gyroscopes"}


def kalibr(constants: Constants) -> Export:
    """One IMU, as Kalibr's ImuParameters reads it."""
    warnings = [
        "Kalibr needs noise densities and random walks, which fieldcal does not estimate: those in the file are an"
        f" ADIS16448's. rostopic is {TOPIC} until you change it."
    ]
    if constants.imu_rate_hz is None:
        warnings.append(f"The rate of the readings is not known: update_rate is {TYPICAL_RATE_HZ:g} Hz.")
    split = {
        sensor: lower_and_rotation(np.linalg.inv(triad.scale))
        for sensor in BLOCKS
        if (triad := constants.triads.get(sensor)) is not None
    }
    frame = split[Sensor.ACCELEROMETER][1] if Sensor.ACCELEROMETER in split else np.eye(3)
    turned = np.eye(4)
    turned[:3, :3] = frame
    lines = [
        f"# {constants.heading}",
        f'rostopic: "{TOPIC}"',
        f"update_rate: {number(constants.imu_rate_hz or TYPICAL_RATE_HZ)}",
        *(f"{name}: {number(value)}" for name, value in TYPICAL.items()),
        'model: "scale-misalignment"',
        "time_offset: 0.0",
        "T_i_b:",
        *rows(turned, ""),
    ]
    for sensor, (lower, turn) in split.items():
        triad = constants.triads[sensor]
        zero = f"  # zero ({' '.join(triad.logged_unit.split())}): {row(triad.zero)}"
        lines += [f"{BLOCKS[sensor]}:", zero, "  M:", *rows(lower, "  ")]
        if sensor == Sensor.GYROSCOPE:
            lines += ["  A:", *rows(np.zeros((3, 3)), "  "), "  C_gyro_i:", *rows(turn @ frame.T, "  ")]
        warnings.append(f"{sensor}: Kalibr estimates the bias itself; the zero is a comment only.")
        if triad.follows_temperature:
            warnings.append(f"{sensor}: Kalibr knows no temperature; M is that at {triad.temperature_degc:g} °C.")
    if Sensor.MAGNETOMETER in constants.triads:
        warnings.append("magnetometer: Kalibr has none; left out.")
    return Export("\n".join(lines) + "\n", tuple(warnings))


def lower_and_rotation(matrix: Array) -> tuple[Array, Array]:
    """matrix = lower · rotation: lower triangular with a positive diagonal, and orthogonal.

    An upper triangular R of `rq` is a lower one with the order of the axes reversed on both sides."""
    upper, turn = rq(matrix[::-1, ::-1])
    lower, turn = upper[::-1, ::-1], turn[::-1, ::-1]
    signs = np.sign(np.diagonal(lower))
    return np.asarray(lower * signs), np.asarray(signs[:, None] * turn)
