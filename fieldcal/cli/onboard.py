"""`fieldcal onboard` and `fieldcal refit`: the C that calibrates on board, and what boards and flights add up to."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

import fieldcal
from fieldcal.cli.options import AsCsv, AsJson, Config, Root, UnusedRoot, Wide
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


def refit(
    *,
    vehicle: str | None = None,
    sessions: str | None = None,
    dump: Annotated[list[Path] | None, Parameter(help="A dump that was collected on board; may be repeated.")] = None,
    full: bool = False,
    wide: Wide = False,
    as_json: AsJson = False,
    as_csv: AsCsv = False,
    warehouse: Root = None,
    config: Config = None,
) -> int:
    """Constants by many flights at once, from the moments that nights have kept or boards have dumped; no log is read.

    Parameters
    ----------
    vehicle
        Whose flights; without one the dumps alone count.
    sessions
        A..B: from the first flight of session A to the last of session B; A.., ..B, or A alone.
    full
        Symmetric scale matrices instead of three scales.
    """
    from fieldcal.cli.present.history import as_written, print_constants
    from fieldcal.cli.present.screen import console
    from fieldcal.cli.show import print_frame
    from fieldcal.exports.refit import frame_of
    from fieldcal.words.talk import say

    if vehicle is None and not dump:
        raise fieldcal.FieldcalError(ReasonCode.WRONG_OPTION, "Name a --vehicle, a --dump, or both.")
    found = fieldcal.Warehouse(warehouse).refit(vehicle, sessions=sessions, dumps=dump or (), full=full, config=config)
    for one in found:
        flights = "1 flight" if one.n_flights == 1 else f"{one.n_flights} flights"
        say(f"{one.sensor.capitalize()} of {one.unit_id}: {flights}, {one.n_samples} samples.")
    rows = frame_of(found)
    if as_json or as_csv:
        print_frame(rows, as_json=as_json, as_csv=as_csv)
    elif wide:
        print_frame(as_written(rows), as_json=False, as_csv=False, wide=True)
    else:
        print_constants(console(), rows)
    return 0
