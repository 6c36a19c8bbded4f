"""`fieldcal drift`: the trends of calibrated parameters as the last night published them."""

from __future__ import annotations

from typing import Literal

import fieldcal
from fieldcal.cli.options import AsCsv, AsJson, Root, UnusedConfig

SHOWN = (
    "vehicle_id",
    "unit_id",
    "sensor",
    "method",
    "parameter",
    "axis",
    "status",
    "n_flights",
    "value_at_25degc",
    "sd",
    "slope_per_degc",
    "slope_per_degc_sd",
    "slope_per_day",
    "slope_per_day_sd",
    "unit",
    "last_z",
    "fleet_z",
    "change_at",
    "reason",
)


def drift(
    *,
    vehicle: str | None = None,
    sensor: Literal["magnetometer", "accelerometer", "gyroscope", "vps", "fit"] | None = None,
    parameter: str | None = None,
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
    from fieldcal.cli.show import print_frame

    rows = fieldcal.Warehouse(warehouse).drift(vehicle=vehicle, sensor=sensor, parameter=parameter)
    print_frame(rows if as_json or as_csv else rows.select(SHOWN), as_json=as_json, as_csv=as_csv)
    return 0
