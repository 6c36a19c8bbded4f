"""`fieldcal.Warehouse`: what the nights have found, asked in polars or SQL."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime
from typing import TYPE_CHECKING, Unpack

import polars as pl

from fieldcal.warehouse import query
from fieldcal.warehouse.questions import calibration_history, existing

if TYPE_CHECKING:
    from fieldcal.exports.calibration import Constants
    from fieldcal.warehouse.sql import Limits, SqlValue


class Warehouse(query.Warehouse):
    """The results of all nights below a root. It only reads.

    Parameters
    ----------
    root : Path or str, optional
        Data root; else ``FIELDCAL_WAREHOUSE``, else ``./fieldcal-data``.

    Raises
    ------
    WarehouseError
        `no_warehouse`, by every question but `scan`: there is nothing at the root.

    Examples
    --------
    >>> import fieldcal
    >>> fieldcal.Warehouse("nowhere").scan("calibration").collect().height
    0
    >>> fieldcal.Warehouse("nowhere").sql("SELECT count(*) FROM flight")
    Traceback (most recent call last):
    ...
    fieldcal.warehouse.errors.WarehouseError: There is no warehouse at nowhere; ...
    """

    def sql(self, query: str, parameters: Sequence[SqlValue] | None = None, **limits: Unpack[Limits]) -> pl.DataFrame:
        """Answer one SELECT over the history tables and views; it can only read.

        Parameters
        ----------
        query : str
            One SELECT in DuckDB's dialect. Tables: flight, calibration, fit, sync, run, drift; views:
            latest_calibration, history, drift_by_temperature, worst_tic, refusals, calibration_at(°C).
        parameters : sequence, optional
            Fill its ``?`` marks.
        **limits
            `timeout_s`, `memory_mb`, `max_result_mb`.

        Raises
        ------
        WarehouseError
            `sql_refused`, `sql_wrong`, `sql_timeout`, `sql_too_large`.
        """
        existing(self.root)
        return super().sql(query, parameters, **limits)

    def history(
        self,
        *,
        vehicle: str | None = None,
        sensor: str | None = None,
        parameter: str | None = None,
        since: datetime | str | None = None,
    ) -> pl.DataFrame:
        """Calibrated parameters, flight by flight, refused ones with their status; oldest flight first.

        Parameters
        ----------
        vehicle, sensor, parameter : str, optional
            Only these; parameters are scale, bias, zero and zero_bias.
        since : datetime or str, optional
            Only flights that started then or later, UTC unless it has a zone; ISO 8601 as text.

        Raises
        ------
        FieldcalError
            `wrong_option`: `since` is no date.
        """
        moment = since.isoformat() if isinstance(since, datetime) else since
        return calibration_history(self.root, vehicle, sensor, parameter, moment)

    def drift(
        self, *, vehicle: str | None = None, sensor: str | None = None, parameter: str | None = None
    ) -> pl.DataFrame:
        """Trends of the parameters over temperature and time as the last night published them, what is not stable
        first.

        Parameters
        ----------
        vehicle, sensor, parameter : str, optional
            Only these. Sensor "vps": lag and skew of its clock; "fit": Theil coefficients.
        """
        from fieldcal.trends.drift_table import drift_rows

        return drift_rows(self.root, vehicle, sensor, parameter)

    def calibration_at(
        self, vehicle: str, temperature_degc: float | None = None, *, unit: str | None = None
    ) -> Constants:
        """What a vehicle flies with at a temperature, °C, 25 unless given: the primary units that flew last on it, by
        their trend over temperature and time where one is known. `unit`: another one on board, by its `unit_id`.

        Raises
        ------
        FieldcalError
            `no_calibration`: no sensor of the vehicle has all its axes calibrated, or the vehicle is not known.
        """
        from fieldcal.exports.calibration_at import constants_of

        return constants_of(self.root, vehicle, temperature_degc, unit)
