"""`fieldcal.Warehouse`: what the nights have found, asked in polars or SQL, and what people decide about it."""

from __future__ import annotations

import getpass
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, TypedDict, Unpack

import polars as pl

from fieldcal.names import Decision
from fieldcal.schemas.reference import REFERENCE_DEGC
from fieldcal.warehouse import query
from fieldcal.warehouse.questions import calibration_history, existing, those_asked_for

if TYPE_CHECKING:
    from fieldcal.exports.calibration import Constants, Export
    from fieldcal.exports.handed_out import HandedOut
    from fieldcal.exports.refit import Refit
    from fieldcal.trends.pooled.plan import Plan
    from fieldcal.warehouse.sql import Limits, SqlValue


class Part(TypedDict, total=False):
    """What of a target a decision is about; None: everything.

    Examples
    --------
    >>> Part(sensor="gyroscope", axis="z")
    {'sensor': 'gyroscope', 'axis': 'z'}
    """

    session: str | None
    unit: str | None
    sensor: str | None
    parameter: str | None
    axis: str | None


@dataclass(frozen=True)
class Decided:
    """What a decision was about.

    Attributes
    ----------
    decision : {"withdraw", "accept"}
    flight_ids : tuple of str
        Flights that it names.
    constants : int
        Constants that do not count any more, or count again.
    trends : tuple of str
        Vehicles whose trends became others by it.

    Examples
    --------
    >>> Decided(Decision.WITHDRAW, ("5f0c",), 36, ("quad-1",)).constants
    36
    """

    decision: Decision
    flight_ids: tuple[str, ...]
    constants: int
    trends: tuple[str, ...]


class Warehouse(query.Warehouse):
    """The results of all nights below a root. It only reads, but for what people decide and export.

    Parameters
    ----------
    root : Path or str, optional
        Data root, or its URL (``s3://``, ``gs://``, ``az://``): asked of a local copy, which is brought up to date
        here; else ``FIELDCAL_WAREHOUSE``, else ``./fieldcal-data``.

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
            One SELECT in DuckDB's dialect. Tables: flight, calibration, fit, sync, moments, run, information, drift,
            pooled, decision, export; views: latest_calibration, history, drift_by_temperature, worst_tic, refusals,
            active, calibration_at(°C).
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
            `not_found`: the history has no such vehicle, sensor or parameter; `wrong_option`: `since` is no date.
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

    def pooled(
        self,
        *,
        vehicle: str | None = None,
        sensor: str | None = None,
        parameter: str | None = None,
        at: datetime | None = None,
    ) -> pl.DataFrame:
        """What all flights of a unit know together, as the last night published it (table `pooled`).

        Flights that show a few directions of the constants alone, and whose rows are refused, count with what they
        know. A constant that no flight shows is refused, with the motion that would.

        Parameters
        ----------
        vehicle, sensor, parameter : str, optional
            Only these.
        at : datetime, optional
            What the constants were at another moment (UTC, unless it has a time zone), by all flights before and after
            it; at the last session else. Units whose flights have no dates have no rows then.
        """
        rows = those_asked_for(existing(self.root), "pooled", vehicle, sensor, parameter).collect()
        if at is None:
            return rows
        from fieldcal.trends.pooled.table import table_then

        return table_then(self.root, rows, at)

    def plan(self, vehicle: str) -> Plan:
        """Which half a minute of motion would tell most of a vehicle's constants, and the sd to expect after it.

        Its `manoeuvres`, the best first, have `words`, `expected` (constant, sd_now, sd_after, limit, unit),
        `refused_now` and `refused_after`: how many constants are not known well enough.

        Raises
        ------
        FieldcalError
            `not_found`, `no_calibration`: the history has no such vehicle, or no two flights of it with information.
        """
        from fieldcal.trends.pooled.plan import plan

        return plan(self.root, vehicle)

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

    def what_flies(self, vehicle: str, temperature_degc: float | None = None) -> Constants:
        """`calibration_at`, with where the readings of every sensor on board came from, also without constants of it:
        for `compare`, which tells what an autopilot has loaded there. Without any constants `triads` is empty.

        Raises
        ------
        FieldcalError
            `no_calibration`: the vehicle is not known.
        """
        from fieldcal.exports.calibration_at import what_flies

        return what_flies(self.root, vehicle, temperature_degc)

    def refit(
        self,
        vehicle: str | None = None,
        *,
        sessions: str | None = None,
        dumps: Sequence[Path | str] = (),
        full: bool = False,
        config: Path | str | None = None,
    ) -> list[Refit]:
        """Constants by many flights at once, from the moments that each left in the history; no log is read.

        Parameters
        ----------
        vehicle : str, optional
            Whose flights, those of its primary units; None: dumps alone.
        sessions : str, optional
            "A..B": from the first flight of session A to the last of session B; "A..", "..B", or "A" alone.
        dumps : sequence of Path or str, optional
            What boards have collected (`fieldcal.onboard.dump`), of the same vehicle.
        full : bool
            Symmetric scale matrices.
        config : Path or str, optional
            fieldcal.toml, for the limits of refusals, and for what a board knew of its vehicle.

        Returns
        -------
        list of Refit
            One a sensor and unit, with rows of method "moments".

        Raises
        ------
        FieldcalError
            `not_found`: no such vehicle or session, or no moments; `not_one_fit`: flights of other fields, units or
            polarities; `bad_dump`.
        """
        from fieldcal.api.onboard import settings_of_board
        from fieldcal.exports.refit import refit
        from fieldcal.onboard.dumps import read_dumps

        board = settings_of_board(vehicle, config)
        return refit(
            self.root,
            vehicle,
            sessions=sessions,
            dumped=[state for path in dumps for state in read_dumps(path)],
            board=board,
            full=full,
        )

    def withdraw(self, target: str, *, reason: str, author: str | None = None, **part: Unpack[Part]) -> Decided:
        """Decide that a flight, or a part of it, counts nowhere: not in trends, constants to fly with or exports. Its
        rows stay, with status `withdrawn`, also when a night publishes it anew.

        Parameters
        ----------
        target : str
            A flight's id, its beginning, or its log; or a vehicle, whose flights in the history today are meant.
        reason : str
            Why, for who reads it later.
        author : str, optional
            Who decides; else the user of this process.
        **part
            `session`: only flights of this one; `unit`, `sensor`, `parameter`, `axis`: only constants of these.

        Raises
        ------
        FieldcalError
            `no_warehouse`, `not_found`; `wrong_option`: there is no reason.
        """
        return self._decide(Decision.WITHDRAW, target, reason, author, part)

    def accept(self, target: str, *, reason: str, author: str | None = None, **part: Unpack[Part]) -> Decided:
        """Decide that a flight, or a part of it, counts: again, where it was withdrawn. What was refused stays refused.

        Parameters as in `withdraw`.
        """
        return self._decide(Decision.ACCEPT, target, reason, author, part)

    def record_export(
        self,
        constants: Constants,
        to: str,
        export: Export,
        *,
        author: str | None = None,
        temperature_degc: float | None = None,
    ) -> bool:
        """Remember that constants were exported in a format, so that the next logs tell whether they were loaded; False
        where the same text was the last one.

        Raises
        ------
        WarehouseError
            `busy`, or the disk's refusal.
        """
        from fieldcal.exports.handed_out import record_export
        from fieldcal.warehouse.remote.share import share

        at_degc = REFERENCE_DEGC if temperature_degc is None else temperature_degc
        is_new = record_export(self.root, constants, to, export, author=author or this_user(), at_degc=at_degc)
        share(self.root)
        return is_new

    def exports(self, vehicle: str) -> list[HandedOut]:
        """The latest export of each sensor of a vehicle to an autopilot, and what became of it by the logs since."""
        from fieldcal.exports.handed_out import handed_out

        return handed_out(self.root, vehicle)

    def _decide(self, decision: Decision, target: str, reason: str, author: str | None, part: Part) -> Decided:
        from fieldcal.batch.trends import update_trends
        from fieldcal.warehouse.decisions.decide import decide, flights_meant
        from fieldcal.warehouse.layout import SITE
        from fieldcal.warehouse.lock import fleet_lock
        from fieldcal.warehouse.remote.share import share

        columns = {"unit_id": part.get("unit"), **{name: part.get(name) for name in ("sensor", "parameter", "axis")}}
        named = {name: str(value) for name, value in columns.items() if value is not None}
        flights = flights_meant(self.root, target, part.get("session"))
        n = decide(self.root, flights, decision, reason=reason, author=author or this_user(), part=named)
        with fleet_lock(self.root):
            trends = tuple(sorted(update_trends(self.root)))
            if (self.root / SITE).is_dir():  # where nobody made one, none is made
                from fieldcal.site import write_site

                write_site(self.root)
            share(self.root)
        return Decided(decision, tuple(flights["flight_id"].to_list()), n, trends)


def this_user() -> str:
    """Who runs this process, as its machine knows."""
    try:
        return getpass.getuser()
    except (KeyError, OSError):  # a container's user without a name
        return "unknown"
