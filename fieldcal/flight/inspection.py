"""What is in a log, and what fieldcal would take for granted of it: read, never calibrated, nothing stored."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import polars as pl

from fieldcal.config.configuration import Vehicle
from fieldcal.config.values import UNITS
from fieldcal.errors import FieldcalError, UnreadableLog
from fieldcal.flight.calibrate import configuration_file, identify
from fieldcal.logs import LogSummary, log_format, open_log
from fieldcal.logs.discovery import folder_parts
from fieldcal.logs.facts import Facts, FindingFacts
from fieldcal.logs.ingest import TidyLog, rejected, settings_of, started_at
from fieldcal.logs.interface import UNKNOWN_UNIT, SensorSource
from fieldcal.logs.tidy import Disordered
from fieldcal.names import INERTIAL_FIRST, Sensor, Triple, Verdict
from fieldcal.stages.tables import matrix, triad

FROM_LOG, FROM_CONFIGURATION, FROM_NOBODY = "log", "configuration", "unknown"
DEFAULT = "default"
EPOCH, SINCE_START = "Unix time", "since a start that the log does not date (boot)"


@dataclass(frozen=True)
class Stream:
    """A signal table. Times in s from the log's first IMU sample; `rate_hz` by the median interval."""

    table: str
    rows: int
    rate_hz: float | None
    first_s: float
    last_s: float
    longest_gap_s: float | None


@dataclass(frozen=True)
class SensorFound:
    """A sensor's readings: `rows` that have them, their unit and where that is known from ("log", "configuration",
    "unknown": taken for counts), and the median of their length in that unit, which often betrays it."""

    sensor: Sensor
    rows: int
    unit: str
    unit_from: str
    median_length: float | None


@dataclass(frozen=True)
class Convention:
    """world, body or gravity_sign: what holds, and where from ("log", "configuration", "default")."""

    key: str
    value: str
    value_from: str


@dataclass(frozen=True)
class UnitOnBoard:
    """One of several units that the log tells of (`logs.interface.SensorSource`).

    `parameters`: the autopilot's by which it had corrected the readings, as they stood at the end of the log, without
    those that are 0; `changes`: how often they had changed since its start."""

    sensor: Sensor
    unit_id: str
    stream: str
    rate_hz: float | None
    primary: bool
    filtered: bool
    corrected: bool
    parameters: dict[str, float] = field(default_factory=dict)
    changes: int = 0


@dataclass(frozen=True)
class FieldUsed:
    """The local field that the magnetometer would be laid against: north, east, down in `unit`; None: there is none,
    and `source` says why."""

    source: str
    north_east_down: Triple | None
    unit: str | None


@dataclass(frozen=True)
class Inspection:
    """What is in a log. Of one that is rejected only what stands before `findings` is known.

    `configuration`: the fieldcal.toml that holds, None without one. `would_do`: a sentence for each sensor and for the
    VPS. `settings`: lines of `[vehicles."<vehicle_id>"]` that state what is unknown or assumed. As they stand they
    change nothing; edited, they do.
    """

    path: str
    vehicle_id: str
    log_format: str
    size_bytes: int
    verdict: str
    reason_code: str | None
    reason: str | None
    configuration: str | None = None
    findings: list[FindingFacts] = field(default_factory=list)
    duration_s: float | None = None
    started_at: str | None = None
    clock: str | None = None
    streams: list[Stream] = field(default_factory=list)
    sensors: list[SensorFound] = field(default_factory=list)
    conventions: list[Convention] = field(default_factory=list)
    units_on_board: list[UnitOnBoard] = field(default_factory=list)
    field_used: FieldUsed | None = None
    would_do: list[str] = field(default_factory=list)
    settings: list[str] = field(default_factory=list)


def inspect_log(log: Path, config: Path | None = None) -> Inspection:
    """What is in a log; vehicle and configuration as `fieldcal calibrate` takes them.

    Raises
    ------
    ConfigurationError
        The configuration is wrong.
    FieldcalError
        `not_found`, `not_readable`: there is no such log.
    """
    job, vehicle = identify(log, config)
    file = configuration_file(Path(job.path), config)
    return replace(inspect_as(Path(job.path), vehicle), configuration=None if file is None else str(file))


def inspect_as(path: Path, vehicle: Vehicle) -> Inspection:
    """The same for a log of a vehicle that is known. What cannot be read has verdict "rejected" and its sentence."""
    signals, facts, summary = _read(path, vehicle)
    known = Inspection(
        path=str(path),
        vehicle_id=vehicle.vehicle_id,
        log_format=log_format(path) or path.suffix.lstrip(".") or "unknown",
        size_bytes=sum(part.stat().st_size for part in (folder_parts(path) if path.is_dir() else [path])),
        verdict=facts["verdict"],
        reason_code=facts["reason_code"],
        reason=facts["reason"],
    )
    if not signals:
        return known
    start = started_at(facts)
    sensors = list(_sensors(signals, facts, vehicle))
    conventions = list(_conventions(facts, vehicle))
    used = _field(facts, vehicle)
    return Inspection(
        **{
            **vars(known),
            "findings": facts["findings"],
            "duration_s": facts["duration_s"],
            "started_at": None if start is None else start.isoformat(),
            "clock": EPOCH if summary.epoch_known else SINCE_START,
            "streams": list(_streams(signals)),
            "sensors": sensors,
            "conventions": conventions,
            "units_on_board": [_on_board(source) for source in summary.sources],
            "field_used": used,
            "would_do": list(_would_do(facts, sensors, signals)),
            "settings": list(_settings(sensors, conventions, vehicle, facts, vps="vps" in signals)),
        }
    )


def _read(path: Path, vehicle: Vehicle) -> tuple[dict[str, pl.DataFrame], Facts, LogSummary]:
    """As `ingest.read_flight`, with the reader's summary. A simulation is looked at as well; a finding says it is."""
    reading = vehicle.model_copy(update={"simulated": True})
    for whole in (False, True):
        frames: dict[str, list[pl.DataFrame]] = {}
        try:
            reader = open_log(path, reading)
            log = TidyLog(reader, path.name, whole=whole)
            for table, frame in log.tables():
                frames.setdefault(table, []).append(frame)
        except Disordered:
            continue
        except UnreadableLog as error:
            return {}, rejected(error.reason_code, error.sentence), LogSummary("")
        return {table: pl.concat(parts) for table, parts in frames.items()}, log.facts(), reader.summary
    raise AssertionError("a log that is held whole cannot be disordered")


def _streams(signals: Mapping[str, pl.DataFrame]) -> Iterator[Stream]:
    zero_ns = int(signals["imu"]["t_ns"][0])
    for table, frame in sorted(signals.items()):
        if frame.is_empty():
            continue
        t_ns = frame["t_ns"].to_numpy()
        steps_s = np.diff(t_ns) * 1e-9
        yield Stream(
            table,
            len(t_ns),
            float(1.0 / np.median(steps_s)) if steps_s.size else None,
            (int(t_ns[0]) - zero_ns) * 1e-9,
            (int(t_ns[-1]) - zero_ns) * 1e-9,
            float(steps_s.max()) if steps_s.size else None,
        )


def _sensors(signals: Mapping[str, pl.DataFrame], facts: Facts, vehicle: Vehicle) -> Iterator[SensorFound]:
    for sensor in INERTIAL_FIRST:
        table = signals.get("magnetometer" if sensor == Sensor.MAGNETOMETER else "imu")
        rows = None if table is None else table.drop_nulls(triad(sensor))
        if rows is None or rows.is_empty():
            yield SensorFound(sensor, 0, UNKNOWN_UNIT, FROM_NOBODY, None)
            continue
        unit = facts["units"].get(sensor, UNKNOWN_UNIT)
        logged = FROM_NOBODY if unit == UNKNOWN_UNIT else FROM_LOG
        length = float(np.median(np.linalg.norm(matrix(rows, triad(sensor)), axis=1)))
        yield SensorFound(
            sensor, rows.height, unit, FROM_CONFIGURATION if sensor in vehicle.units else logged, _finite(length)
        )


def _conventions(facts: Facts, vehicle: Vehicle) -> Iterator[Convention]:
    for key, configured, logged, default in (
        ("world", vehicle.world, facts["world"], "ned"),
        ("body", vehicle.body, facts["body"], "frd"),
        ("gravity_sign", vehicle.gravity_sign, facts["gravity_sign"], "gravity"),
    ):
        where = FROM_CONFIGURATION if configured else FROM_LOG if logged else DEFAULT
        yield Convention(key, configured or logged or default, where)


def _on_board(source: SensorSource) -> UnitOnBoard:
    rate_hz = _finite(source.rate_hz)
    applied = source.corrections[-1].parameters if source.corrections else {}
    return UnitOnBoard(
        source.sensor,
        source.unit_id,
        source.stream,
        rate_hz,
        source.primary,
        source.filtered,
        source.corrected,
        {name: float(value) for name, value in applied.items() if value},
        max(len(source.corrections) - 1, 0),
    )


def _field(facts: Facts, vehicle: Vehicle) -> FieldUsed:
    try:
        own = settings_of(facts, vehicle)
    except FieldcalError as error:  # the model of the field does not cover place or date
        return FieldUsed(error.sentence, None, None)
    return FieldUsed(own.field_source, own.field_ned, own.field_unit)


def _would_do(facts: Facts, sensors: list[SensorFound], signals: Mapping[str, pl.DataFrame]) -> Iterator[str]:
    """Whether the motion suffices only `fieldcal calibrate` tells."""
    if not Verdict(facts["verdict"]).usable:
        yield f"nothing: a log that is {facts['verdict']} is not calibrated"
        return
    there = {one.sensor for one in sensors if one.rows}
    vps = signals.get("vps")
    for one in sensors:
        if one.sensor not in there:
            yield f"{one.sensor}: not calibrated, the log has no readings of it"
        elif one.sensor == Sensor.GYROSCOPE and vps is None and there == {Sensor.GYROSCOPE}:
            yield f"{one.sensor}: not calibrated, there is neither another sensor nor a VPS to compare it with"
        else:
            yield f"{one.sensor}: calibrated where the motion suffices"
    if vps is None:
        yield "VPS: none in the log"
    else:
        position = vps.drop_nulls(["px_m", "py_m", "pz_m"]).height > 0
        yield f"VPS: there, {'attitude and position' if position else 'attitude only'}"


def _settings(
    sensors: list[SensorFound], conventions: list[Convention], vehicle: Vehicle, facts: Facts, *, vps: bool
) -> Iterator[str]:
    """TOML lines. A place cannot be guessed: its line is a comment that is no TOML until it is filled in."""
    there = [one for one in sensors if one.rows]
    for one in there:
        if one.unit_from == FROM_NOBODY:
            others = ", ".join(f'"{unit}"' for unit in UNITS[one.sensor] if unit != "counts")
            yield f'units.{one.sensor} = "counts"  # assumed; or {others}'
    for one in there:
        if one.unit in ("counts", UNKNOWN_UNIT) and vehicle.polarity[one.sensor] == (1, 1, 1):
            yield f"polarity.{one.sensor} = [1, 1, 1]  # assumed; each 1 or -1, as wired"
    choices = {"world": '"enu"', "body": '"flu"', "gravity_sign": '"specific_force": -g down at rest'}
    for convention in conventions:
        if convention.value_from == DEFAULT and (vps or convention.key != "world"):  # it is the VPS's world
            yield f'{convention.key} = "{convention.value}"  # assumed; or {choices[convention.key]}'
    if vehicle.field is None and facts["position"] is None and any(one.sensor == Sensor.MAGNETOMETER for one in there):
        yield "# where it was flown; without it the field's strength and dip are not known:"
        yield "# field = { latitude_deg = ?, longitude_deg = ?, altitude_m = 0.0 }"


def _finite(value: float) -> float | None:
    return value if np.isfinite(value) else None
