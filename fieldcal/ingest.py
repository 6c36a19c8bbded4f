"""From a reader's batches to tidy signals, the flight's facts and a verdict on the log.

Tidy: sorted by stamp, no row twice, one row a stamp, finite readings. Whatever is left out is counted and told.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from fieldcal.configuration import Vehicle
from fieldcal.errors import UnreadableLog
from fieldcal.flight import flight_settings
from fieldcal.logs import SIGNAL_COLUMNS, Columns, Finding, LogReader, LogSummary, batch_frame, open_log

SENSOR_TABLES = ("imu", "magnetometer", "vps")
MAY_BE_UNKNOWN = ("px_m", "py_m", "pz_m", "altitude_m")
HELD_ROWS = 1 << 17
CLOCK_RESET_NS = 1_000_000_000
MOST_STRAGGLERS = 0.01
MOST_INTERVALS = 1 << 20
EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


class Disordered(Exception):
    """A row belongs before rows that were handed on already: the log must be tidied as a whole."""


class TidySignal:
    """One signal being tidied. Rows are held back so that small disorder is sorted while streaming.

    Parameters
    ----------
    table : str
        Signal table.
    held_rows : int or None
        How many of the latest rows are held back; None holds all until the end.
    """

    def __init__(self, table: str, held_rows: int | None = HELD_ROWS) -> None:
        self.table = table
        self.rows = self.not_finite = self.duplicates = self.conflicts = self.disordered = self.reset = 0
        self.largest_step_back_ns = 0
        self._run = self._switches = 0
        self._runs: set[int] = set()
        self._last_run: int | None = None
        self.first_ns: int | None = None
        self.last_ns: int | None = None
        self._held_rows = held_rows
        self._held: list[pl.DataFrame] = []
        self._n_held = 0
        self._latest_ns: int | None = None
        self._previous_ns: int | None = None
        self._intervals = np.empty(0, np.int64)
        self._keep_every = 1

    def add(self, columns: Columns) -> Iterator[pl.DataFrame]:
        """Take a batch; rows that no later one can come before.

        Raises
        ------
        Disordered
            A row comes before rows that were yielded already.
        """
        frame = self._finite(batch_frame(self.table, columns))
        if frame.is_empty():
            return
        t = frame["t_ns"].to_numpy()
        if self.last_ns is not None and int(t.min()) <= self.last_ns:
            raise Disordered(self.table)
        latest = np.maximum.accumulate(t if self._latest_ns is None else np.r_[self._latest_ns, t])
        before = latest[:-1] if self._latest_ns is not None else np.r_[t[0], latest[:-1]]
        behind = np.maximum(before - t, 0)
        self.disordered += int(np.count_nonzero(behind))
        previous = np.r_[t[0] if self._previous_ns is None else self._previous_ns, t[:-1]]
        run = self._run + np.cumsum(np.abs(t - previous) > CLOCK_RESET_NS)
        self._latest_ns, self._previous_ns, self._run = int(latest[-1]), int(t[-1]), int(run[-1])
        self._held.append(frame.with_columns(behind=pl.Series(behind), run=pl.Series(run)))
        self._n_held += len(frame)
        if self._held_rows is not None and self._n_held > 2 * self._held_rows:
            held = pl.concat(self._held).sort("t_ns", maintain_order=True)
            stamps = held["t_ns"].to_numpy()
            cut = int(np.searchsorted(stamps, stamps[-self._held_rows]))
            self._held, self._n_held = [held[cut:]], len(held) - cut
            if cut:
                yield self._one_a_stamp(held[:cut])

    def finish(self) -> Iterator[pl.DataFrame]:
        """The rows still held."""
        if self._n_held:
            held = pl.concat(self._held).sort("t_ns", maintain_order=True)
            self._held, self._n_held = [], 0
            yield self._one_a_stamp(held)

    def rate_hz(self) -> float | None:
        """Median rate; None below two samples."""
        if self._intervals.size == 0:
            return None
        return float(1e9 / np.median(self._intervals))

    def _finite(self, frame: pl.DataFrame) -> pl.DataFrame:
        names = [n for n in SIGNAL_COLUMNS[self.table] if n != "t_ns" and n not in MAY_BE_UNKNOWN]
        whole = frame.filter(pl.all_horizontal(pl.col(names).is_finite().fill_null(True)))
        self.not_finite += len(frame) - len(whole)
        return whole

    def _one_a_stamp(self, frame: pl.DataFrame) -> pl.DataFrame:
        """Of the sorted rows the first of every stamp; the others are counted as copies or contradictions."""
        t = frame["t_ns"].to_numpy()
        first = np.r_[True, t[1:] != t[:-1]]
        if not first.all():
            leaders = np.flatnonzero(first)[np.cumsum(first) - 1]
            others = np.flatnonzero(~first)
            names = SIGNAL_COLUMNS[self.table]
            one, other = frame[leaders[others]], frame[others]
            same = np.logical_and.reduce([other[n].eq_missing(one[n]).to_numpy() for n in names])
            self.duplicates += int(np.count_nonzero(same))
            self.conflicts += int(np.count_nonzero(~same))
            frame = frame.filter(pl.Series(first))
        behind = frame["behind"].to_numpy()
        self.reset += int(np.count_nonzero(behind > CLOCK_RESET_NS))
        self.largest_step_back_ns = max(self.largest_step_back_ns, int(behind.max()))
        self._account(frame["t_ns"].to_numpy())
        run = frame["run"].to_numpy()
        switches = run[1:] != run[:-1]
        self._switches += int(np.count_nonzero(switches)) + (self._last_run not in (None, int(run[0])))
        self._runs |= set(np.unique(run).tolist())
        self._last_run = int(run[-1])
        return frame.drop("behind", "run")

    def clock_was_reset(self) -> bool:
        """Whether stretches recorded one after the other claim the same time, beyond a few stragglers."""
        interleaved = self._switches > len(self._runs) - 1
        return interleaved and self.reset > MOST_STRAGGLERS * self.rows

    def _account(self, t: np.ndarray) -> None:
        intervals = np.diff(t if self.last_ns is None else np.r_[self.last_ns, t])[:: self._keep_every]
        self._intervals = np.concatenate([self._intervals, intervals])
        while self._intervals.size > MOST_INTERVALS:
            self._intervals, self._keep_every = self._intervals[::2], self._keep_every * 2
        self.first_ns = int(t[0]) if self.first_ns is None else self.first_ns
        self.last_ns = int(t[-1])
        self.rows += len(t)

    def findings(self, name: str) -> Iterator[Finding]:
        """What was met, as findings on the log called `name`."""
        table, sensors = self.table, self.table in SENSOR_TABLES
        if self.clock_was_reset():
            yield Finding(
                "clock_reset",
                self.reset,
                f"{name}: the stamps of {table} step back by {self.largest_step_back_ns * 1e-9:.3f} s into time "
                f"that is recorded already ({self.reset} rows): the clock was reset. Split the log where it was.",
                fatal=sensors,
            )
        elif self.disordered:
            yield Finding(
                "out_of_order",
                self.disordered,
                f"{name}: {self.disordered} rows of {table} came after later ones and were sorted in.",
            )
        if self.not_finite:
            yield Finding(
                "not_finite",
                self.not_finite,
                f"{name}: {self.not_finite} rows of {table} hold NaN or infinity and were left out.",
                loses_data=sensors,
            )
        if self.conflicts:
            yield Finding(
                "repeated_stamps",
                self.conflicts,
                f"{name}: {self.conflicts} rows of {table} repeat a time stamp with other values; the first of each "
                "stamp was kept.",
                loses_data=sensors,
            )
        if self.duplicates:
            yield Finding(
                "duplicate_rows",
                self.duplicates,
                f"{name}: {self.duplicates} rows of {table} stand in the log twice and were taken once.",
            )


class TidyLog:
    """A log being tidied: iterate `tables()` to its end, then ask for `facts()`.

    Parameters
    ----------
    reader : LogReader
        The opened log.
    name : str
        What findings call it.
    whole : bool
        Hold every row until the end: for logs that were found `Disordered`.
    """

    def __init__(self, reader: LogReader, name: str, *, whole: bool = False) -> None:
        self._reader = reader
        self._name = name
        self._held_rows = None if whole else HELD_ROWS
        self._signals: dict[str, TidySignal] = {}
        self._temperature: list[float] | None = None
        self._position = np.zeros(3)
        self._read_through = False

    def tables(self) -> Iterator[tuple[str, pl.DataFrame]]:
        """Tidy rows, (signal table, frame), each table in order of time.

        Raises
        ------
        UnreadableLog
            The log cannot be read, or nothing in it is usable.
        Disordered
            See `TidySignal.add`.
        """
        for table, columns in self._reader.batches():
            signal = self._signals.setdefault(table, TidySignal(table, self._held_rows))
            for frame in signal.add(columns):
                yield table, self._seen(table, frame)
        self._read_through = True
        for table, signal in self._signals.items():
            for frame in signal.finish():
                yield table, self._seen(table, frame)
        if "imu" not in self._signals or not self._signals["imu"].rows:
            raise UnreadableLog(
                "no_imu",
                f"{self._name}: not one usable IMU sample"
                + "".join(f" ({finding.sentence})" for finding in self._findings()[:1])
                + ". Check the topics or columns in fieldcal.toml.",
            )

    def units(self) -> dict[str, str] | None:
        """Unit per sensor; None while the log may still say otherwise."""
        return dict(self._reader.summary.units) if self._read_through else None

    def _seen(self, table: str, frame: pl.DataFrame) -> pl.DataFrame:
        if table == "temperature":
            t = frame["temperature_degc"].to_numpy()
            low, total, high = self._temperature or [np.inf, 0.0, -np.inf]
            self._temperature = [min(low, float(t.min())), total + float(t.sum()), max(high, float(t.max()))]
        elif table == "position":
            self._position += (
                frame.select("latitude_deg", "longitude_deg", "altitude_m").fill_nan(0.0).sum().to_numpy()[0]
            )
        return frame

    def _findings(self) -> list[Finding]:
        own = [finding for signal in self._signals.values() for finding in signal.findings(self._name)]
        return [*self._reader.summary.findings, *own]

    def facts(self) -> dict[str, Any]:
        """What is known of the flight, plain JSON; unknown numbers are None."""
        summary, findings = self._reader.summary, self._findings()
        imu = self._signals["imu"]
        first_ns, last_ns = imu.first_ns or 0, imu.last_ns or 0
        vps, place = self._signals.get("vps"), self._signals.get("position")
        low, total, high = self._temperature or (None, None, None)
        n_temperatures = self._signals["temperature"].rows if self._temperature else 1
        return {
            **declared(summary),
            "duration_s": (last_ns - first_ns) * 1e-9,
            "imu_rate_hz": imu.rate_hz(),
            "vps_rate_hz": vps.rate_hz() if vps else None,
            "n_samples": imu.rows,
            "rows": {table: signal.rows for table, signal in sorted(self._signals.items())},
            "temperature_min_degc": low,
            "temperature_mean_degc": None if total is None else total / n_temperatures,
            "temperature_max_degc": high,
            "started_at_ns": first_ns if summary.epoch_known else None,
            "position": [float(v) for v in self._position / place.rows] if place and place.rows else None,
            **verdict(findings),
        }


def tidy_log(path: Path, vehicle: Vehicle, *, whole: bool = False) -> TidyLog:
    """Open a log for tidying. Raises as `open_log`."""
    return TidyLog(open_log(path, vehicle), path.name, whole=whole)


def logged_units(path: Path, vehicle: Vehicle) -> dict[str, str]:
    """Unit per sensor, from a pass through the whole log: what long logs need whose word on it may come last."""
    reader = open_log(path, vehicle)
    for _ in reader.batches():
        pass
    return dict(reader.summary.units)


def declared(summary: LogSummary) -> dict[str, Any]:
    """What the log says of itself."""
    return {
        "units": dict(summary.units),
        "world": summary.world,
        "body": summary.body,
        "gravity_sign": summary.gravity_sign,
        "verifiable": summary.verifiable,
    }


def verdict(findings: list[Finding]) -> dict[str, Any]:
    """Findings as plain JSON, and the verdict they add up to with the gravest one's code and sentence."""
    listed = [{"code": f.code, "count": f.count, "sentence": f.sentence} for f in findings]
    for name, grave in (
        ("quarantined", [f for f in findings if f.fatal]),
        ("partial", [f for f in findings if f.loses_data]),
    ):
        if grave:
            return {"verdict": name, "reason_code": grave[0].code, "reason": grave[0].sentence, "findings": listed}
    return {"verdict": "ok", "reason_code": None, "reason": None, "findings": listed}


def rejected(reason_code: str, reason: str) -> dict[str, Any]:
    """Facts of a log in which nothing is usable."""
    unknown = ("duration_s", "imu_rate_hz", "vps_rate_hz", "n_samples", "started_at_ns", "position")
    temperatures = ("temperature_min_degc", "temperature_mean_degc", "temperature_max_degc")
    return {
        **dict.fromkeys((*unknown, *temperatures)),
        **declared(LogSummary("")),
        "rows": {},
        "verdict": "rejected",
        "reason_code": reason_code,
        "reason": reason,
        "findings": [],
    }


def read_flight(path: Path, vehicle: Vehicle) -> tuple[dict[str, pl.DataFrame], dict[str, Any]]:
    """A whole log in memory: signal table → tidy frame, and the facts. Unreadable: `rejected`, no tables."""
    for whole in (False, True):
        frames: dict[str, list[pl.DataFrame]] = {}
        try:
            log = tidy_log(path, vehicle, whole=whole)
            for table, frame in log.tables():
                frames.setdefault(table, []).append(frame)
        except Disordered:
            continue
        except UnreadableLog as error:
            return {}, rejected(error.reason_code, error.sentence)
        return {table: pl.concat(parts) for table, parts in frames.items()}, log.facts()
    raise AssertionError("a log that is held whole cannot be disordered")


def started_at(facts: Mapping[str, Any]) -> datetime | None:
    """Time of the first IMU sample, UTC, to the microsecond; None when the log's clock has no known epoch."""
    stamp = facts["started_at_ns"]
    return None if stamp is None else EPOCH + timedelta(microseconds=stamp // 1000)


def settings_of(facts: Mapping[str, Any], vehicle: Vehicle) -> dict[str, Any]:
    """Settings of the stages for this flight (`flight.flight_settings`)."""
    place = facts["position"]
    return flight_settings(
        vehicle,
        units=facts["units"],
        world=facts["world"],
        body=facts["body"],
        gravity_sign=facts["gravity_sign"],
        position=None if place is None else (place[0], place[1], place[2]),
        started_at=started_at(facts),
    )
