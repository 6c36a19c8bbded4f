"""From a reader's batches to tidy signals, the flight's facts and a verdict on the log.

Tidy: sorted by stamp, no row twice, one row a stamp, finite readings. Whatever is left out is counted and told.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import polars as pl

from fieldcal.config.configuration import Vehicle
from fieldcal.config.flight_settings import FlightSettings, flight_settings
from fieldcal.config.loaded import Loaded
from fieldcal.errors import UnreadableLog
from fieldcal.logs import SIGNAL_COLUMNS, Finding, LogReader, LogSummary, open_log
from fieldcal.logs.discovery import folder_parts
from fieldcal.logs.facts import Declared, Facts, FindingFacts, Judged, UnitFacts
from fieldcal.logs.interface import EPOCH_KNOWN_AFTER_NS
from fieldcal.logs.on_board import PRIMARY, UNIT_TABLES, sensors_of, units_on_board
from fieldcal.logs.tidy import HELD_ROWS, Disordered, TidySignal
from fieldcal.logs.warmth import Warmth
from fieldcal.names import SENSORS, Rotation, Sensor, Triple, Verdict
from fieldcal.reason_codes import ReasonCode
from fieldcal.schemas import signal_kind

LEAST_SAMPLES = 10
SECONDS_ALLOWED = 60.0
CPU_SECONDS_ALLOWED = 10.0
CPU_SECONDS_PER_MB = 5.0
"""Real logs take .1 s for every MB, of JSON in packed chunks 1 s."""
TOO_SLOW = ReasonCode.TOO_SLOW
"""The one refusal that another try may not meet again."""

EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


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
    seconds, cpu_seconds : float
        How long reading may take, and how much of the processor's time.
    """

    def __init__(
        self,
        reader: LogReader,
        name: str,
        *,
        whole: bool = False,
        seconds: float = math.inf,
        cpu_seconds: float = math.inf,
    ) -> None:
        self._give_up = time.monotonic() + seconds
        self._give_up_cpu = time.thread_time() + cpu_seconds
        self._cpu_seconds = cpu_seconds
        self._seconds = seconds
        self._reader = reader
        self._name = name
        self._held_rows = None if whole else HELD_ROWS
        self._signals: dict[str, TidySignal] = {}
        self._warmth: dict[str, Warmth] = {}
        self._position = np.zeros(3)
        self._read_through = False

    def tables(self) -> Iterator[tuple[str, pl.DataFrame]]:
        """Tidy rows, (signal table, frame), each table in order of time.

        Raises
        ------
        UnreadableLog
            The log cannot be read, nothing in it is usable, or it takes too long (`too_slow`, `over_limits`).
        Disordered
            See `TidySignal.add`.
        """
        for table, columns in self._reader.batches():
            if time.monotonic() > self._give_up:
                raise UnreadableLog(
                    TOO_SLOW,
                    f"{self._name} was still being read after {self._seconds:.0f} s, {SECONDS_ALLOWED:.0f} s and 1 s "
                    "for every MB are allowed. Check the disk; the next night tries again.",
                )
            if time.thread_time() > self._give_up_cpu:
                raise UnreadableLog(
                    ReasonCode.OVER_LIMITS,
                    f"{self._name} took {self._cpu_seconds:.0f} s of the processor and was not read yet; "
                    f"{CPU_SECONDS_ALLOWED:.0f} s and {CPU_SECONDS_PER_MB:.0f} s for every MB are allowed: it unpacks "
                    "to far more than a log does. Check what it is.",
                )
            signal = self._signals.setdefault(table, TidySignal(table, self._held_rows))
            for frame in signal.add(columns):
                yield table, self._seen(table, frame)
        self._read_through = True
        for table, signal in self._signals.items():
            for frame in signal.finish():
                yield table, self._seen(table, frame)
        if "imu" not in self._signals or not self._signals["imu"].rows:
            raise UnreadableLog(
                ReasonCode.NO_IMU,
                f"{self._name}: not one usable IMU sample"
                + "".join(f" ({finding.sentence})" for finding in self._findings()[:1])
                + ". Check the topics or columns in fieldcal.toml.",
            )
        if self._signals["imu"].rows < LEAST_SAMPLES:
            raise UnreadableLog(
                ReasonCode.TOO_FEW_SAMPLES,
                f"{self._name} holds {self._signals['imu'].rows} IMU samples at different times, {LEAST_SAMPLES} are "
                "the least." + "".join(f" {finding.sentence}" for finding in self._findings()[:1]),
            )

    def units(self) -> dict[str, str] | None:
        """Unit per sensor; None while the log may still say otherwise."""
        return dict(self._reader.summary.units) if self._read_through else None

    def _seen(self, table: str, frame: pl.DataFrame) -> pl.DataFrame:
        if signal_kind(table) == "temperature":
            self._warmth.setdefault(table, Warmth()).add(frame["temperature_degc"].to_numpy())
        elif table == "position":
            self._position += (
                frame.select("latitude_deg", "longitude_deg", "altitude_m").fill_nan(0.0).sum().to_numpy()[0]
            )
        return frame

    def _findings(self) -> list[Finding]:
        own = [
            finding if table in SIGNAL_COLUMNS else _of_further_unit(finding)
            for table, signal in self._signals.items()
            for finding in signal.findings(self._name)
        ]
        warmth = [one.finding(self._name, table) for table, one in self._warmth.items() if not one.plausible]
        return [*self._reader.summary.findings, *own, *self._apart(), *warmth]

    def _sound(self) -> list[str]:
        """The further units' tables of which enough is sound, in the order of their numbers."""
        return sorted(
            (
                table
                for table, signal in self._signals.items()
                if signal_kind(table) in UNIT_TABLES
                and table not in SIGNAL_COLUMNS
                and signal.rows >= LEAST_SAMPLES
                and not any(finding.fatal for finding in signal.findings(self._name))
            ),
            key=lambda table: (signal_kind(table), len(table), table),
        )

    def _apart(self) -> Iterator[Finding]:
        """A magnetometer whose stamps lie all before or all after the IMU's: nothing can lay them beside each other."""
        imu, field = self._signals.get("imu"), self._signals.get("magnetometer")
        if imu is None or field is None:
            return
        ends = (imu.first_ns, imu.last_ns, field.first_ns, field.last_ns)
        first, last, field_first, field_last = (0 if end is None else end for end in ends)
        if None not in ends and (field_last < first or field_first > last):
            away_s = max(first - field_last, field_first - last) * 1e-9
            yield Finding(
                ReasonCode.CLOCKS_APART,
                field.rows,
                f"{self._name}: the clocks of magnetometer and IMU do not overlap: {field.rows} readings of the "
                f"magnetometer lie {away_s:.3f} s away from the IMU's and cannot be used. Stamp both by one clock.",
                loses_data=True,
            )

    def facts(self) -> Facts:
        """What is known of the flight, plain JSON; unknown numbers are None."""
        summary, findings = self._reader.summary, self._findings()
        imu = self._signals["imu"]
        first_ns, last_ns = imu.first_ns or 0, imu.last_ns or 0
        vps, place = self._signals.get("vps"), self._signals.get("position")
        warmth = self._warmth.get("temperature")
        warmth = warmth if warmth is not None and warmth.plausible else None
        return {
            **declared(summary),
            "duration_s": (last_ns - first_ns) * 1e-9,
            "imu_rate_hz": imu.rate_hz(),
            "vps_rate_hz": vps.rate_hz() if vps else None,
            "n_samples": imu.rows,
            "rows": {table: signal.rows for table, signal in sorted(self._signals.items())},
            "left_out": sorted(table for table, one in self._warmth.items() if not one.plausible),
            "temperature_min_degc": None if warmth is None else warmth.lowest,
            "temperature_mean_degc": None if warmth is None else warmth.total / warmth.rows,
            "temperature_max_degc": None if warmth is None else warmth.highest,
            "started_at_ns": first_ns if summary.epoch_known and first_ns > EPOCH_KNOWN_AFTER_NS else None,
            "position": [float(v) for v in self._position / place.rows] if place and place.rows else None,
            "board_id": summary.board_id,
            "units_on_board": units_on_board(summary.sources, self._sound(), first_ns, last_ns),
            **verdict(findings),
        }


def tidy_log(path: Path, vehicle: Vehicle, *, whole: bool = False) -> TidyLog:
    """Open a log for tidying. Raises as `open_log`."""
    reader = open_log(path, vehicle)
    size = sum(part.stat().st_size for part in (folder_parts(path) if path.is_dir() else [path]))
    cpu_seconds = CPU_SECONDS_ALLOWED + CPU_SECONDS_PER_MB * size / 1e6
    return TidyLog(reader, path.name, whole=whole, seconds=SECONDS_ALLOWED + size / 1e6, cpu_seconds=cpu_seconds)


def logged_units(path: Path, vehicle: Vehicle) -> dict[str, str]:
    """Unit per sensor, from a pass through the whole log: what long logs need whose word on it may come last."""
    reader = open_log(path, vehicle)
    for _ in reader.batches():
        pass
    return dict(reader.summary.units)


def _of_further_unit(finding: Finding) -> Finding:
    """What ends the use of a further unit's readings does not end the flight's."""
    return replace(finding, fatal=False, loses_data=finding.loses_data or finding.fatal)


def declared(summary: LogSummary) -> Declared:
    """What the log says of itself."""
    return {
        "units": dict(summary.units),
        "world": summary.world,
        "body": summary.body,
        "gravity_sign": summary.gravity_sign,
        "verifiable": summary.verifiable,
    }


def verdict(findings: list[Finding]) -> Judged:
    """Findings as plain JSON, and the verdict they add up to with the gravest one's code and sentence."""
    listed: list[FindingFacts] = [{"code": f.code, "count": f.count, "sentence": f.sentence} for f in findings]
    for name, grave in (
        (Verdict.QUARANTINED, [f for f in findings if f.fatal]),
        (Verdict.PARTIAL, [f for f in findings if f.loses_data]),
    ):
        if grave:
            return {"verdict": name, "reason_code": grave[0].code, "reason": grave[0].sentence, "findings": listed}
    return {"verdict": Verdict.OK, "reason_code": None, "reason": None, "findings": listed}


def rejected(reason_code: ReasonCode, reason: str) -> Facts:
    """Facts of a log in which nothing is usable."""
    return {
        "duration_s": None,
        "imu_rate_hz": None,
        "vps_rate_hz": None,
        "n_samples": None,
        "left_out": [],
        "temperature_min_degc": None,
        "temperature_mean_degc": None,
        "temperature_max_degc": None,
        "started_at_ns": None,
        "position": None,
        "board_id": None,
        "units_on_board": [],
        **declared(LogSummary("")),
        "rows": {},
        "verdict": Verdict.REJECTED,
        "reason_code": reason_code,
        "reason": reason,
        "findings": [],
    }


def read_flight(path: Path, vehicle: Vehicle) -> tuple[dict[str, pl.DataFrame], Facts]:
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


def started_at(facts: Facts) -> datetime | None:
    """Time of the first IMU sample, UTC, to the microsecond; None when the log's clock has no known epoch."""
    stamp = facts["started_at_ns"]
    return None if stamp is None else EPOCH + timedelta(microseconds=stamp // 1000)


def settings_of(facts: Facts, vehicle: Vehicle, unit: str = PRIMARY) -> FlightSettings:
    """Settings of the stages for a unit of this flight (`config.flight_settings.flight_settings`)."""
    place = facts["position"]
    own = flight_settings(
        vehicle,
        units=facts["units"],
        world=facts["world"],
        body=facts["body"],
        gravity_sign=facts["gravity_sign"],
        position=None if place is None else (place[0], place[1], place[2]),
        started_at=started_at(facts),
    )
    on_board = next((one for one in facts["units_on_board"] if one["table"] == unit), None)
    known = {} if on_board is None else {Sensor(name): found for name, found in on_board["applied"].items()}
    return replace(
        own,
        own_sensors=sensors_of(unit),
        applied_matrix={s: _rows_of(known[s]["matrix"]) if s in known else None for s in SENSORS},
        applied_offset={s: _triple(known[s]["offset"]) if s in known else None for s in SENSORS},
        applied_known={s: known[s]["known"] if s in known else None for s in SENSORS},
        applied_matrix_sd={s: known[s]["matrix_sd"] if s in known else None for s in SENSORS},
        applied_offset_sd={s: _triple(known[s]["offset_sd"]) if s in known else None for s in SENSORS},
        applied_offset_per_degc={s: _triple(known[s]["offset_per_degc"]) if s in known else None for s in SENSORS},
        loaded={s: _loaded(on_board, s) for s in SENSORS},
    )


def _loaded(on_board: UnitFacts | None, sensor: Sensor) -> Loaded | None:
    own = None if on_board is None else on_board["loaded"].get(sensor)
    if own is None:
        return None
    return Loaded(own["autopilot"], own["device_id"], _rows_of(own["rotation"]), own["parameters"])


def _triple(values: list[float]) -> Triple:
    x, y, z = values
    return x, y, z


def _rows_of(matrix: list[list[float]]) -> Rotation:
    x, y, z = (_triple(row) for row in matrix)
    return x, y, z
