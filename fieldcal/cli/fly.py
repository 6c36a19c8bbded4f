"""`fieldcal export` and `fieldcal apply`: the constants to fly with, elsewhere and on a log."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from fieldcal.cli.options import AsJson, Config, Output, Root, UnusedConfig
from fieldcal.reason_codes import ReasonCode

Format = Literal["px4", "ardupilot", "ros", "kalibr", "json", "c"]


def export(
    vehicle: str,
    /,
    *,
    to: Annotated[Format, Parameter(name=["--format", "-f"])] = "json",
    at_temperature: float | None = None,
    output: Output = None,
    warehouse: Root = None,
    config: UnusedConfig = None,
) -> int:
    """The constants to fly with: what the target cannot hold is told on stderr.

    Parameters
    ----------
    vehicle
        The vehicle that flies; the constants are those of the IMU that flew last on it.
    to
        PX4 or ArduPilot parameters, ROS 2 or Kalibr YAML, JSON, a C header.
    at_temperature
        °C; 25 unless given. Slopes on temperature go along where the target has a place for them.
    output
        File to write; else stdout.
    """
    from fieldcal.exports import FORMATS
    from fieldcal.exports.calibration_at import constants_of
    from fieldcal.warehouse import Warehouse
    from fieldcal.warehouse.files import write_bytes
    from fieldcal.words.talk import say

    result = FORMATS[to](constants_of(Warehouse(warehouse).root, vehicle, at_temperature))
    for warning in result.warnings:
        say(warning)
    if output is None:
        print(result.text, end="")
    else:
        write_bytes(output, result.text.encode())
    return 0


def apply(
    log: Path,
    /,
    *,
    output: Annotated[Path, Parameter(name=["--output", "-o"])],
    vehicle: str | None = None,
    at_temperature: float | None = None,
    as_json: AsJson = False,
    warehouse: Root = None,
    config: Config = None,
) -> int:
    """Calibrated readings of a log by the constants its vehicle flies with; the log stays as it is.

    Parameters
    ----------
    log
        An MCAP or CSV file, or a folder with imu.csv.
    output
        NAME.mcap: ROS 2 Imu and MagneticField in body axes (REP-103). Anything else: a folder for imu.parquet and
        magnetometer.parquet, in the sensor axes as logged.
    vehicle
        The vehicle; else the folder two levels above the log.
    at_temperature
        °C; else each sample's own temperature, 25 where the log has none.
    """
    from fieldcal.cli.show import print_json
    from fieldcal.exports.apply import apply_constants, write_parquet, write_ros
    from fieldcal.warehouse import Warehouse
    from fieldcal.words.talk import say

    _keep(log, output)
    calibrated = apply_constants(log, Warehouse(warehouse).root, config, vehicle, at_temperature)
    warnings = list(calibrated.warnings)
    if output.suffix.lower() == ".mcap":
        warnings += write_ros(calibrated, output)
        written = [output]
    else:
        written = write_parquet(calibrated, output)
    for warning in warnings:
        say(warning)
    if as_json:
        print_json({"written": [str(path) for path in written], "warnings": warnings})
    else:
        for path in written:
            print(path)
    return 0


def _keep(log: Path, output: Path) -> None:
    """Refuse to write over the log or into it, by whatever name."""
    from fieldcal.errors import FieldcalError

    own, place = log.resolve(), output.resolve()
    if place == own or own in place.parents or (output.exists() and log.exists() and output.samefile(log)):
        raise FieldcalError(
            ReasonCode.WRONG_OPTION, f"{output} is the log itself, which is only ever read; name another place."
        )
