"""`fieldcal onboard`: the C that calibrates on a flight controller."""

from __future__ import annotations

from pathlib import Path

import fieldcal
from fieldcal.cli.options import Config, UnusedRoot
from fieldcal.reason_codes import ReasonCode


def onboard(
    folder: Path,
    /,
    *,
    vehicle: str | None = None,
    imu_rate: float = 100.0,
    magnetometer_rate: float = 100.0,
    full: bool = False,
    forgetting: float = 1.0,
    config: Config = None,
    warehouse: UnusedRoot = None,
) -> int:
    """Write the C that calibrates on a flight controller: a header, a source, and the vehicle's configuration.

    Parameters
    ----------
    folder
        Where they go; files of their names are replaced.
    vehicle
        Its name in fieldcal.toml; else what holds for a vehicle that it does not name.
    imu_rate, magnetometer_rate
        Readings a second that will be fed.
    full
        Symmetric scale matrices instead of three scales.
    forgetting
        Factor for each of the gyroscope's equations that is a tenth of a second older; 1: nothing is forgotten.
    """
    try:
        written = fieldcal.write_onboard(
            folder,
            vehicle=vehicle,
            config=config,
            imu_rate_hz=imu_rate,
            magnetometer_rate_hz=magnetometer_rate,
            full=full,
            forgetting=forgetting,
        )
    except ValueError as error:
        raise fieldcal.FieldcalError(ReasonCode.WRONG_OPTION, f"{error}.") from error
    for path in written:
        print(path)
    return 0
