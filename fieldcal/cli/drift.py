"""`fieldcal drift`: the trends of calibrated parameters as the last night published them."""

from __future__ import annotations

from typing import Literal

import fieldcal
from fieldcal.cli.options import AsCsv, AsJson, Root, UnusedConfig, Wide


def drift(
    *,
    vehicle: str | None = None,
    sensor: Literal["magnetometer", "accelerometer", "gyroscope", "vps", "fit"] | None = None,
    parameter: str | None = None,
    wide: Wide = False,
    as_json: AsJson = False,
    as_csv: AsCsv = False,
    warehouse: Root = None,
    config: UnusedConfig = None,
) -> int:
    """Trends of calibrated parameters over temperature and time, what is not stable first.

    Parameters
    ----------
    vehicle
        Only units that this vehicle carries.
    sensor
        Only this sensor; vps: lag and skew of its clock, fit: Theil coefficients.
    parameter
        scale, bias, zero, zero_bias, lag, skew, tic_attitude, ...
    """
    from fieldcal.cli.present.drift import print_drift
    from fieldcal.cli.present.history import as_written
    from fieldcal.cli.present.screen import console
    from fieldcal.cli.show import print_frame

    rows = fieldcal.Warehouse(warehouse).drift(vehicle=vehicle, sensor=sensor, parameter=parameter)
    if as_json or as_csv:
        print_frame(rows, as_json=as_json, as_csv=as_csv)
    elif wide:
        print_frame(as_written(rows, "value_at_25degc"), as_json=False, as_csv=False, wide=True)
    else:
        from fieldcal.report.standing.memory import following

        print_drift(console(), rows, following(fieldcal.Warehouse(warehouse).root, rows["vehicle_id"].unique()))
    return 0
