"""Logs that came out wrong on the aircraft: corrected ones, and ones in other axes and signs than an autopilot's.

They are the cases `autopilot-corrected`, `body-flu` and `gravity-sign-rotated` of the folder `cases/calibration`. Truth
is in axes forward, right, down of the sensor, at 25 °C: z = scale (raw − zero); the accelerometer's in the sign of
its log."""

from __future__ import annotations

from pathlib import Path

import autopilot_formulas as formulas
import numpy as np
import pytest
from example_logs import PARENT, needs_examples

import fieldcal

CASES = PARENT / "cases" / "calibration"
SCALE = {"accelerometer": (1.01, 0.99, 1.02), "magnetometer": (1.05, 0.95, 1.1)}
ZERO = {
    "gyroscope": (0.02, -0.03, 0.015),
    "accelerometer": (0.2, -0.3, 0.15),
    "magnetometer": (0.12, -0.08, 0.2),
}
PER_DEGC = {"gyroscope": (2e-4, -1e-4, 3e-4), "accelerometer": (4e-3, -6e-3, 4e-3), "magnetometer": (0.0, 0.0, 0.0)}
NAMES = {"gyroscope": "CAL_GYRO0_?", "accelerometer": "CAL_ACC0_?", "magnetometer": "CAL_MAG0_?"}
TOO_FAR_SD = 4.0


def calibrated(log: str) -> fieldcal.Calibration:
    return fieldcal.calibrate(CASES / Path(log))


@needs_examples
@pytest.mark.parametrize(
    "log", ["body-flu/flu/2026-03-05/f1", "gravity-sign-rotated/rot/2026-03-05/f1"], ids=lambda log: log.split("/")[0]
)
def test_parameters_are_in_the_autopilots_own_axes_and_sign(log: str) -> None:
    constants = calibrated(log).constants()
    p = formulas.read_qgroundcontrol(fieldcal.export(constants, "px4", logged_raw=True).text)
    for sensor, truth in ZERO.items():
        triad = constants.triads[sensor]
        warmer = (triad.temperature_degc - 25.0) * log.startswith("body-flu")
        sign = -1.0 if sensor == "accelerometer" and log.startswith("gravity-sign") else 1.0
        off = formulas.triple(p, f"{NAMES[sensor]}OFF") - sign * (truth + warmer * np.array(PER_DEGC[sensor]))
        assert np.all(np.abs(off) < TOO_FAR_SD * triad.zero_sd), (sensor, off, triad.zero_sd)
        if sensor in SCALE:
            off = formulas.triple(p, f"{NAMES[sensor]}SCALE") - SCALE[sensor]
            assert np.all(np.abs(off) < TOO_FAR_SD * triad.scale_sd), (sensor, off, triad.scale_sd)


@needs_examples
def test_what_an_autopilot_had_corrected_is_not_exported_as_if_it_were_raw() -> None:
    calibration = calibrated("autopilot-corrected/corr/2026-03-05/f1")
    for autopilot in ("px4", "ardupilot"):
        with pytest.raises(fieldcal.FieldcalError, match="does not tell whether") as caught:
            fieldcal.export(calibration, autopilot)
        assert caught.value.reason_code == "not_loadable"
