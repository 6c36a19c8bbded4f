"""`fieldcal.write_onboard`: the C for a flight controller, with a vehicle's configuration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from fieldcal.config.find import configuration_of, find_source
from fieldcal.config.flight_settings import flight_settings
from fieldcal.names import Sensor, Triple
from fieldcal.onboard.board import BoardSettings
from fieldcal.onboard.handout import write_sources

UNNAMED = "board"
"""A vehicle that the configuration does not name."""
GRAVITY_SIGNS = {"gravity": 1.0, "specific_force": -1.0}


def write_onboard(
    folder: Path | str,
    *,
    vehicle: str | None = None,
    config: Path | str | None = None,
    imu_rate_hz: float = 100.0,
    magnetometer_rate_hz: float = 100.0,
    full: bool = False,
    forgetting: float = 1.0,
) -> list[Path]:
    """Write the C that calibrates on board: one header, one source, and the vehicle's configuration as a header.

    Parameters
    ----------
    folder : Path or str
        Made where it is missing; files of these names are replaced.
    vehicle : str, optional
        Its name in the configuration; else what holds for a vehicle that the configuration does not name.
    config : Path or str, optional
        fieldcal.toml: the local field, gravity and its sign, polarities, the limits of refusals.
    imu_rate_hz, magnetometer_rate_hz : float
        Readings a second that will be fed.
    full : bool
        Symmetric scale matrices instead of three scales: 80 bytes a triad more, three times the work to solve.
    forgetting : float
        Factor for each equation of the gyroscope that is older by a tenth of a second; 1: nothing is forgotten, and
        flights can be merged.

    Returns
    -------
    list of Path
        What was written.

    Raises
    ------
    ConfigurationError
        The configuration is wrong, or not there.
    ValueError
        A rate is not positive, or the forgetting not in (0, 1].

    Examples
    --------
    >>> import tempfile
    >>> import fieldcal
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     [path.name for path in fieldcal.write_onboard(folder, imu_rate_hz=400.0)]
    ['fieldcal_onboard.h', 'fieldcal_onboard.c', 'fieldcal_onboard_config.h']
    """
    if not (imu_rate_hz > 0 and magnetometer_rate_hz > 0 and 0 < forgetting <= 1):
        raise ValueError("rates are positive and forgetting is in (0, 1]")
    settings = replace(
        settings_of_board(vehicle, config),
        imu_rate_hz=imu_rate_hz,
        magnetometer_rate_hz=magnetometer_rate_hz,
        full=full,
        forgetting=forgetting,
    )
    return write_sources(folder, settings, told=vehicle or "")


def settings_of_board(vehicle: str | None, config: Path | str | None) -> BoardSettings:
    """What a board must know of a vehicle, as its configuration has it."""
    configuration = configuration_of(find_source(None if config is None else Path(config), None))
    s = flight_settings(configuration.vehicle(vehicle or UNNAMED), units={})
    north, east, down = np.asarray(s.field_ned, dtype=float) / np.linalg.norm(s.field_ned)
    parameters = s.parameters
    return BoardSettings(
        field_norm=float(np.linalg.norm(s.field_ned)),
        field_unit=s.field_unit,
        gravity_mps2=s.gravity_mps2,
        field_ned=(float(north), float(east), float(down)),
        gravity_sign=GRAVITY_SIGNS[s.gravity_sign],
        magnetometer_polarity=_signs(s.polarity[Sensor.MAGNETOMETER]),
        accelerometer_polarity=_signs(s.polarity[Sensor.ACCELEROMETER]),
        gyroscope_polarity=_signs(s.polarity[Sensor.GYROSCOPE]),
        max_condition=parameters.ellipsoid_max_condition,
        max_scale_sd=parameters.ellipsoid_max_scale_sd,
        max_residual=parameters.ellipsoid_max_residual,
        gyroscope_max_scale_sd=parameters.gyro_max_scale_sd,
    )


def _signs(signs: Sequence[int]) -> Triple:
    x, y, z = signs
    return float(x), float(y), float(z)
