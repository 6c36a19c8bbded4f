"""A row of each table of the history to the type check: its columns by name, None where a row may have no value."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import datetime
from types import NoneType
from typing import TypedDict, get_args, get_type_hints

from fieldcal.names import Json


class FlightLead(TypedDict):
    """What leads every row that speaks of one flight."""

    flight_id: str
    vehicle_id: str
    imu_id: str
    session_id: str
    started_at: datetime | None
    dated_by: str | None
    sequence: str | None


class _FlightFacts(FlightLead):
    log_uri: str
    log_sha256: str | None
    log_format: str
    duration_s: float | None
    imu_rate_hz: float | None
    vps_rate_hz: float | None
    n_samples: int | None
    temperature_min_degc: float | None
    temperature_mean_degc: float | None
    temperature_max_degc: float | None
    verdict: str
    reason_code: str | None
    reason: str | None
    verifiable: bool | None


class FlightRow(_FlightFacts):
    """A row of `flight`; `findings` is a JSON text."""

    findings: str | None


class Finding(TypedDict):
    """One of the findings of a flight."""

    code: str
    count: int
    sentence: str


class UnfoldedFlight(_FlightFacts):
    """A row of `flight` whose findings are objects."""

    findings: list[Finding] | None


class UnitLead(FlightLead):
    """What leads every row that speaks of one unit of a flight."""

    unit_id: str
    is_primary: bool


class CalibrationRow(UnitLead):
    """A row of `calibration`."""

    sensor: str
    method: str
    parameter: str
    axis: str
    value: float | None
    sd: float | None
    unit: str
    temperature_degc: float | None
    status: str
    reason_code: str | None
    run_key: str | None


class FitRow(UnitLead):
    """A row of `fit`."""

    quantity: str
    method: str
    reference: str
    signal: str
    sample: str
    tic: float | None
    tic_bias: float | None
    tic_variance: float | None
    tic_covariance: float | None
    rms: float | None
    rms_unit: str
    n_samples: int
    run_key: str | None


class SyncRow(UnitLead):
    """A row of `sync`."""

    lag_s: float | None
    lag_mid_s: float | None
    lag_sd_s: float | None
    skew_ppm: float | None
    skew_sd_ppm: float | None
    peak: float | None
    runner_up: float | None
    status: str
    run_key: str | None


class Refusable(TypedDict):
    """What says whether a stage stopped: rows of `run`, and the refusals of a night."""

    stage: str
    status: str
    reason_code: str | None


class _StageRun(UnitLead, Refusable):
    run_key: str | None


class MomentsRow(UnitLead):
    """A row of `moments`; `sums` is a JSON text."""

    sensor: str
    magnitude: float | None
    unit: str
    logged_unit: str
    temperature_degc: float | None
    reading_rate_hz: float
    block_samples: int
    n_samples: int
    n_differences: int
    sums: str
    run_key: str | None


class RunRow(_StageRun):
    """A row of `run`; `measured` and `versions` are JSON texts."""

    measured: str
    versions: str | None


class UnfoldedRun(_StageRun):
    """A row of `run` whose JSON texts are objects."""

    measured: Mapping[str, Json]
    versions: Mapping[str, str] | None


class InformationRow(UnitLead):
    """A row of `information`."""

    place: int
    sensor: str
    parameter: str
    axis: str
    sensor_unit_id: str
    unit: str
    linearised_at: float
    right_side: float
    information: list[float]
    temperature_degc: float | None
    status: str
    reason_code: str | None
    run_key: str | None


class DriftRow(TypedDict):
    """A row of `drift`."""

    vehicle_id: str
    imu_id: str
    unit_id: str
    sensor: str
    method: str
    parameter: str
    axis: str
    unit: str
    n_flights: int
    value_at_25degc: float | None
    sd: float | None
    slope_per_degc: float | None
    slope_per_degc_sd: float | None
    slope_per_day: float | None
    slope_per_day_sd: float | None
    last_z: float | None
    change_at: datetime | None
    status: str
    n_sessions: int
    as_of: datetime | None
    best_known_degc: float | None
    temperature_min_degc: float | None
    temperature_max_degc: float | None
    session_sd: float | None
    change_size: float | None
    change_size_sd: float | None
    fleet_z: float | None
    reason: str | None
    best_known_at: datetime | None
    borrowed_from: int | None
    curve_per_degc2: float | None
    curve_per_degc2_sd: float | None
    curve_per_degc3: float | None
    curve_per_degc3_sd: float | None


class PooledRow(UnitLead):
    """A row of `pooled`; what leads it is the last flight's."""

    sensor: str
    parameter: str
    axis: str
    unit: str
    value_at_25degc: float | None
    sd: float | None
    slope_per_degc: float | None
    slope_per_degc_sd: float | None
    slope_per_day: float | None
    slope_per_day_sd: float | None
    last_z: float | None
    best_known_degc: float | None
    temperature_min_degc: float | None
    temperature_max_degc: float | None
    session_sd: float | None
    walk_per_sqrt_day: float | None
    slope_spread: float | None
    n_innovations: float
    n_flights: int
    n_sessions: int
    change_at: datetime | None
    change_size: float | None
    change_size_sd: float | None
    pooled_with: str
    place: int
    covariance: list[float] | None
    flights: list[str]
    shares: list[float]
    left_out: list[str]
    distances: list[float] | None
    status: str
    reason_code: str | None
    reason: str | None
    curve_per_degc2: float | None
    curve_per_degc2_sd: float | None
    curve_with_value: float | None
    curve_with_slope: float | None


class DecisionRow(TypedDict):
    """A row of `decision`. What names a part of the flight is None for all of it."""

    vehicle_id: str
    flight_id: str
    decided_at: datetime
    decision: str
    unit_id: str | None
    sensor: str | None
    parameter: str | None
    axis: str | None
    author: str
    reason: str | None


class ExportRow(TypedDict):
    """A row of `export`."""

    vehicle_id: str
    exported_at: datetime
    latest_flight_id: str | None
    format: str
    unit_id: str
    sensor: str
    name: str
    set_to: float
    at_degc: float
    author: str
    text_sha256: str


class FlightDocument(TypedDict):
    """What is known of one flight, by table."""

    flight: UnfoldedFlight
    calibration: list[CalibrationRow]
    fit: list[FitRow]
    sync: SyncRow | None
    run: list[UnfoldedRun]


ROWS = {
    "flight": FlightRow,
    "calibration": CalibrationRow,
    "fit": FitRow,
    "sync": SyncRow,
    "moments": MomentsRow,
    "run": RunRow,
    "information": InformationRow,
    "drift": DriftRow,
    "pooled": PooledRow,
    "decision": DecisionRow,
    "export": ExportRow,
}


def may_be_null(table: str) -> frozenset[str]:
    """Columns of a table of the history that a row may have no value in."""
    return frozenset(name for name, hint in get_type_hints(ROWS[table]).items() if NoneType in get_args(hint))
