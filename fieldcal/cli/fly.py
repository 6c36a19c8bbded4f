"""`fieldcal export` and `fieldcal apply`: the constants to fly with, elsewhere and on a log."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

import fieldcal
from fieldcal.cli.options import AsJson, Config, Output, Place, Root, UnusedConfig, Whole, Wide
from fieldcal.reason_codes import ReasonCode

Format = Literal["px4", "ardupilot", "ros", "imu_calib", "imu_pipeline", "kalibr", "json", "c"]
"""The names in `exports.FORMATS`, which itself would make every `--help` slow."""


def export(
    vehicle: str,
    /,
    *,
    to: Annotated[Format, Parameter(name=["--format", "-f"])] = "json",
    at_temperature: float | None = None,
    unit: str | None = None,
    params: Path | None = None,
    logged_raw: bool = False,
    system_id: Whole = 1,
    author: str | None = None,
    output: Output = None,
    warehouse: Root = None,
    config: UnusedConfig = None,
) -> int:
    """The constants to fly with: what the target cannot hold is told on stderr. The history remembers what was exported
    when, so that `fieldcal compare` tells whether it was loaded.

    Parameters
    ----------
    vehicle
        The vehicle that flies; the constants are those of the primary units that flew last on it.
    to
        PX4 or ArduPilot parameters, ROS 2 or Kalibr YAML, files of ROS packages, JSON, a C header.
    at_temperature
        °C; 25 unless given. Slopes on temperature go along where the target has a place for them.
    unit
        Another unit on board, by its unit_id (fieldcal history --json tells them).
    params
        PX4, ArduPilot: the autopilot's parameters while the logs were recorded, as QGroundControl, Mission Planner or
        MAVProxy saves them; else those in the logs.
    logged_raw
        PX4, ArduPilot: states that nothing had corrected the readings before they were logged.
    system_id
        PX4: MAVLink's, of the vehicle.
    author
        Who exports; else the user who runs this.
    output
        File to write; else stdout.
    """
    from fieldcal.exports import AUTOPILOTS
    from fieldcal.remote.url import RemoteError
    from fieldcal.warehouse.files import write_bytes
    from fieldcal.words.talk import say

    if to not in AUTOPILOTS and (params is not None or logged_raw):
        told = f"--params and --logged-raw are for {' and '.join(AUTOPILOTS)}; {to} takes the constants as they are."
        raise fieldcal.FieldcalError(ReasonCode.WRONG_OPTION, told)

    root = fieldcal.Warehouse(warehouse)
    constants = root.calibration_at(vehicle, at_temperature, unit=unit)
    result = fieldcal.export(constants, to, parameters=params, logged_raw=logged_raw, system_id=system_id)
    for warning in result.warnings:
        say(warning)
    if output is None:
        print(result.text, end="")
    else:
        write_bytes(output, result.text.encode())
    try:
        root.record_export(constants, to, result, author=author, temperature_degc=at_temperature)
    except (fieldcal.WarehouseError, RemoteError) as error:
        say(f"That it was exported is not remembered. {error}")
    return 0


def compare(
    vehicle: str,
    /,
    *,
    params: Path | None = None,
    logged_raw: bool = False,
    at_temperature: float | None = None,
    wide: Wide = False,
    as_json: AsJson = False,
    warehouse: Root = None,
    config: UnusedConfig = None,
) -> int:
    """What a vehicle's autopilot flies with beside what the history says, and whether it matters; of what was exported
    last, whether it was loaded. Nothing is written.

    Parameters
    ----------
    vehicle
        The vehicle that flies: the units that were on board last.
    params
        What is loaded, as QGroundControl, Mission Planner or MAVProxy saves it; else the parameters in the last log.
    logged_raw
        States that nothing had corrected the readings of other logs than an autopilot's.
    at_temperature
        °C; 25 unless given.
    """
    from dataclasses import asdict

    from fieldcal.api.constants import comparison
    from fieldcal.cli.present.compared import print_compared
    from fieldcal.cli.present.screen import console
    from fieldcal.cli.show import print_json
    from fieldcal.words.talk import say

    root = fieldcal.Warehouse(warehouse)
    constants = root.what_flies(vehicle, at_temperature)
    rows, told = comparison(constants, parameters=params, logged_raw=logged_raw)
    exports = root.exports(vehicle)
    if as_json:
        of = {(one.unit_id, one.sensor): asdict(one) for one in exports}
        as_told = [(row, {k: None if v != v else v for k, v in asdict(row).items()}) for row in rows]
        print_json([{**cells, "exported": of.get((row.unit_id, row.sensor))} for row, cells in as_told])
        return 0
    screen = console(wide=wide)
    print_compared(screen, rows, vehicle)
    for sentence in told:
        say(sentence)
    if none := sorted({row.sensor for row in rows if row.parameter == "zero" and row.estimate != row.estimate}):
        screen.print(f'Not estimated: {", ".join(none)}; `fieldcal sql "FROM refusals"` says why.')
    for one in exports:
        screen.print(one.sentence)
    return 0


def apply(
    log: Place,
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
        A log: MCAP, ROS bag (file or folder), PX4 ULog, ArduPilot .bin or CSV, or a folder with imu.csv.
    output
        NAME.mcap: ROS 2 Imu and MagneticField in body axes (REP-103). NAME.csv, NAME.parquet: one table, in the sensor
        axes as logged. A name without an ending: a folder for imu.parquet and magnetometer.parquet.
    vehicle
        The vehicle; else the folder two levels above the log.
    at_temperature
        °C; else each sample's own temperature, 25 where the log has none.
    """
    from fieldcal.cli.show import print_json
    from fieldcal.remote.places import log_at
    from fieldcal.words.talk import say

    own = log_at(log)
    _keep(own, output)
    recording = fieldcal.read_log(own, config=config, vehicle=vehicle)
    constants = fieldcal.Warehouse(warehouse).calibration_at(recording.vehicle_id, at_temperature)
    calibrated = fieldcal.apply(recording, constants, follow_temperature=at_temperature is None)
    written, unsaid = calibrated.write(output)
    warnings = [*calibrated.warnings, *unsaid]
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
    own, place = log.resolve(), output.resolve()
    if place == own or own in place.parents or (output.exists() and log.exists() and output.samefile(log)):
        told = f"{output} is the log itself, which is only ever read; name another place."
        raise fieldcal.FieldcalError(ReasonCode.WRONG_OPTION, told)
