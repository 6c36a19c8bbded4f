"""`fieldcal.export` and `fieldcal.apply`: constants into others' formats, and onto a log's readings."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from fieldcal.api.calibration import Calibration
from fieldcal.api.recording import Recording, as_recording
from fieldcal.exports import AUTOPILOTS, FORMATS, export_to
from fieldcal.exports.apply import CalibratedReadings, apply_constants
from fieldcal.exports.autopilots.comparison import Compared, compared
from fieldcal.exports.autopilots.loading import Request
from fieldcal.exports.autopilots.parameter_file import read_parameters
from fieldcal.exports.calibration import Constants, Export


def export(
    constants: Constants | Calibration,
    to: str = "json",
    *,
    parameters: Mapping[str, float] | Path | str | None = None,
    logged_raw: bool = False,
    system_id: int = 1,
) -> Export:
    """Write constants as another program reads them.

    Parameters
    ----------
    constants : Constants or Calibration
        What to fly with: `Warehouse.calibration_at`, or one flight's own.
    to : {"px4", "ardupilot", "ros", "imu_calib", "imu_pipeline", "kalibr", "json", "c"}
        PX4 or ArduPilot parameters, ROS 2 or Kalibr YAML, files of two ROS packages, JSON, a C header. Each module of
        `fieldcal.exports` states its target's conventions: units, signs, axes.
    parameters : mapping of str to float, or Path or str, optional
        For an autopilot: its parameters while the log was recorded, or the file of a ground station with them. Needed
        where the log does not tell them.
    logged_raw : bool
        For an autopilot: it is known that nothing had corrected the readings before they were logged.
    system_id : int
        For PX4: MAVLink's, of the vehicle.

    Returns
    -------
    Export
        The text, and what the target cannot hold.

    Raises
    ------
    ValueError
        There is no such format, or it is no autopilot's and something is asked of it that only concerns those.
    FieldcalError
        `not_loadable`: an autopilot cannot take the constants, or must not without knowing more; `not_found`,
        `wrong_option`: the file of parameters.
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
    if to not in AUTOPILOTS and (parameters is not None or logged_raw):
        raise ValueError(f"parameters and logged_raw are for {' and '.join(AUTOPILOTS)}, not for {to!r}")
    return export_to(to, _constants(constants), Request(_parameters(parameters), logged_raw, system_id))


def compare(
    constants: Constants | Calibration,
    *,
    parameters: Mapping[str, float] | Path | str | None = None,
    logged_raw: bool = False,
) -> list[Compared]:
    """What a vehicle's autopilot flies with beside its constants, axis by axis, and what the difference does.

    Parameters
    ----------
    constants : Constants or Calibration
        `Warehouse.what_flies`, `Warehouse.calibration_at`, or one flight's own.
    parameters, logged_raw : optional
        As in `export`; without `parameters` those in the log of an autopilot.

    Returns
    -------
    list of Compared
        `estimate` and `sd` are NaN where nothing is estimated.

    Raises
    ------
    FieldcalError
        `not_loadable`: what it flies with is not known; `not_found`, `wrong_option`: the file of parameters.
    Refused
        The calibration has no sensor that was not refused.

    Examples
    --------
    >>> import fieldcal
    >>> try:
    ...     fieldcal.compare(fieldcal.Constants("quad-1", "quad-1", {}, ""))
    ... except fieldcal.FieldcalError as error:
    ...     print(error.reason_code)
    not_loadable
    """
    return comparison(constants, parameters=parameters, logged_raw=logged_raw)[0]


def comparison(
    constants: Constants | Calibration,
    *,
    parameters: Mapping[str, float] | Path | str | None = None,
    logged_raw: bool = False,
) -> tuple[list[Compared], tuple[str, ...]]:
    """`compare`, and what is to be said of sensors that have no place there."""
    return compared(_constants(constants), Request(_parameters(parameters), logged_raw))


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
    read = recording.source
    return apply_constants(
        recording.path.name,
        read.vehicle,
        read.signals,
        read.facts,
        _constants(constants),
        follow_temperature=follow_temperature,
    )


def _constants(given: Constants | Calibration) -> Constants:
    return given.constants() if isinstance(given, Calibration) else given


def _parameters(given: Mapping[str, float] | Path | str | None) -> Mapping[str, float] | None:
    return read_parameters(Path(given)) if isinstance(given, Path | str) else given
