"""What the joint estimate finds beside scale and zero, as rows of the history: lever arm, delays, dip, sensitivity to
specific force. Each has its own unit and sd; none of them is asked for by a calibrated reading."""

from __future__ import annotations

from collections.abc import Collection, Mapping

import numpy as np

from fieldcal.errors import FieldcalError
from fieldcal.estimation.by_pose.triad import TriadByPose
from fieldcal.estimation.joint.fit import JointFit
from fieldcal.geometry.rotation import Array
from fieldcal.names import SENSORS, Method, Sensor
from fieldcal.stages.results import quantity_rows
from fieldcal.stages.tables import AXES, CalibrationRow

LEVER_ARM, VPS_LEVER_ARM, DELAY, DIP, G_SENSITIVITY = "lever_arm", "vps_lever_arm", "delay", "dip", "g_sensitivity"
# Sd beyond which a number says nothing and is no row, by parameter: m, s, rad, and the reading's unit per m/s².
LARGEST_SD = {LEVER_ARM: 0.5, VPS_LEVER_ARM: 0.5, DELAY: 0.05, DIP: 0.2, G_SENSITIVITY: np.inf}
BOTH_AXES = tuple(row + column for row in AXES for column in AXES)


def beside_rows(
    fit: JointFit,
    by_pose: Mapping[Sensor, TriadByPose | FieldcalError],
    axes: Array,
    sensors: Collection[Sensor],
    *,
    gyroscope_unit: str,
    temperature_degc: float | None,
) -> list[CalibrationRow]:
    """Rows of a fit and of the triads that a VPS's trajectory gave, if any; `axes` (3, 3) turns sensor axes into body
    axes; `sensors`: of which there may be rows."""
    rows: list[CalibrationRow] = []

    def add(sensor: Sensor, parameter: str, at: tuple[str, ...], value: Array, sd: Array, unit: str) -> None:
        if sensor not in sensors or not np.max(sd) <= LARGEST_SD[parameter]:
            return
        rows.extend(
            quantity_rows(sensor, Method.JOINT, parameter, at, value, sd, unit=unit, temperature_degc=temperature_degc)
        )

    def found(name: str) -> tuple[Array, Array]:
        return fit.state.values[name], fit.covariance[fit.layout[name], fit.layout[name]]

    if "lever_arm" in fit.layout:
        arm, covariance = found("lever_arm")
        add(Sensor.ACCELEROMETER, LEVER_ARM, AXES, axes @ arm, _sd(axes @ covariance @ axes.T), "m")
    if "dip" in fit.layout:
        dip, covariance = found("dip")
        add(Sensor.MAGNETOMETER, DIP, ("",), dip, _sd(covariance), "rad")
    if "gyroscope_g_sensitivity" in fit.layout:
        scaled, covariance = found("gyroscope_g_sensitivity")
        # Of the logged reading: z = Λ (d + G a) + b is free of it, so the reading itself has −G.
        spread = np.repeat(fit.model.triads["gyroscope"].spread, 3)
        unit = f"{gyroscope_unit} per m/s^2"
        add(Sensor.GYROSCOPE, G_SENSITIVITY, BOTH_AXES, -scaled * spread, _sd(covariance) * spread, unit)
    for sensor in SENSORS:
        triad = by_pose.get(sensor)
        if isinstance(triad, TriadByPose):
            add(sensor, DELAY, ("",), np.array([triad.delay_s]), np.array([triad.delay_sd_s]), "s")
            if triad.lever_arm_m is not None and triad.lever_arm_sd_m is not None:
                sd = np.sqrt(axes**2 @ triad.lever_arm_sd_m**2)
                add(sensor, VPS_LEVER_ARM, AXES, axes @ triad.lever_arm_m, sd, "m")
        elif f"{sensor}_delay" in fit.layout:
            delay, covariance = found(f"{sensor}_delay")
            add(sensor, DELAY, ("",), delay, _sd(covariance), "s")
    return rows


def _sd(covariance: Array) -> Array:
    return np.asarray(np.sqrt(np.diagonal(covariance)))
