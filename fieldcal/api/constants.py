"""`fieldcal.export` and `fieldcal.apply`: constants into others' formats, and onto a log's readings."""

from __future__ import annotations

from pathlib import Path

from fieldcal.api.calibration import Calibration
from fieldcal.api.recording import Recording, as_recording
from fieldcal.exports import FORMATS
from fieldcal.exports.apply import CalibratedReadings, apply_constants
from fieldcal.exports.calibration import Constants, Export


def export(constants: Constants | Calibration, to: str = "json") -> Export:
    """Write constants as another program reads them.

    Parameters
    ----------
    constants : Constants or Calibration
        What to fly with: `Warehouse.calibration_at`, or one flight's own.
    to : {"px4", "ardupilot", "ros", "kalibr", "json", "c"}
        PX4 or ArduPilot parameters, ROS 2 or Kalibr YAML, JSON, a C header. Each module of `fieldcal.exports` states
        its target's conventions: units, signs, axes.

    Returns
    -------
    Export
        The text, and what the target cannot hold.

    Raises
    ------
    ValueError
        There is no such format.
    Refused
        The calibration has no sensor that was not refused.

    Examples
    --------
    >>> import tempfile
    >>> import fieldcal
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     log = fieldcal.write_flights(folder, fieldcal.Experiment(duration_s=20.0))[0]
    ...     calibration = fieldcal.calibrate(log)
    >>> print(fieldcal.export(calibration, "c").text.splitlines()[0])
    /* fieldcal: sim-1, IMU sim-1, as of 2026-01-12T08:00:00+00:00. Sensor axes as logged. */
    """
    if to not in FORMATS:
        raise ValueError(f"to is one of {', '.join(FORMATS)}, not {to!r}")
    return FORMATS[to](constants.constants() if isinstance(constants, Calibration) else constants)


def apply(
    log: Recording | Path | str,
    constants: Constants | Calibration,
    *,
    follow_temperature: bool = True,
    config: Path | str | None = None,
    vehicle: str | None = None,
) -> CalibratedReadings:
    """Put a log's readings through constants: z = Λ(T)(z_d − zero(T)) (Eq. 5 with its offset in logged units).

    Parameters
    ----------
    log : Recording, Path or str
        A recording, or a path as `read_log` takes it. It is only read.
    constants : Constants or Calibration
        `Warehouse.calibration_at`, or a flight's own.
    follow_temperature : bool
        Follow each sample's own temperature along the constants' slopes, where both are known; otherwise the constants'
        temperature holds.
    config, vehicle : optional
        As in `read_log`; with a recording they are its own.

    Returns
    -------
    CalibratedReadings

    Raises
    ------
    FieldcalError
        `not_found`; `not_usable`: nothing can be read; `unit_mismatch`: the log's readings are in another unit than the
        constants; `no_calibration`: no sensor of the log has constants.
    Refused
        The calibration has no sensor that was not refused.

    Examples
    --------
    >>> import numpy as np
    >>> import tempfile
    >>> import fieldcal
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     log = fieldcal.write_flights(folder, fieldcal.Experiment(duration_s=20.0))[0]
    ...     calibrated = fieldcal.apply(log, fieldcal.calibrate(log))
    >>> t_ns, z = calibrated.readings["accelerometer"]
    >>> bool(abs(np.median(np.linalg.norm(z, axis=1)) - 9.81) < 0.02)
    True
    """
    recording = as_recording(log, config, vehicle)
    own = constants.constants() if isinstance(constants, Calibration) else constants
    read = recording.source
    return apply_constants(
        recording.path.name, read.vehicle, read.signals, read.facts, own, follow_temperature=follow_temperature
    )
