"""Every table: what a row is, its columns in order, the columns that identify a row."""

from __future__ import annotations

from fieldcal.schemas import columns as c
from fieldcal.schemas.column import Column, Table

_HISTORY_FLIGHT_KEY = ("flight_id",)
_CONSTANTS = (
    c.SENSOR,
    c.METHOD,
    c.PARAMETER,
    c.AXIS,
    c.VALUE,
    c.SD,
    c.UNIT,
    c.TEMPERATURE_DEGC,
    c.STATUS,
    c.REASON_CODE,
)
"""A calibrated parameter of one axis."""
_UNIT = (c.UNIT_ID, c.IS_PRIMARY)
"""Which of the units on board a row of the history is about."""

_SIGNALS = (
    Table(
        "imu",
        "signal",
        1,
        "inertial readings as logged; null columns where the log lacks a sensor",
        (c.T_NS, *c.GYROSCOPE, *c.ACCELEROMETER),
        ("t_ns",),
    ),
    Table("magnetometer", "signal", 1, "magnetometer readings as logged", (c.T_NS, *c.MAGNETOMETER), ("t_ns",)),
    Table("temperature", "signal", 1, "IMU temperature as logged", (c.T_NS, c.TEMPERATURE_DEGC), ("t_ns",)),
    Table(
        "vps",
        "signal",
        1,
        "poses of the visual positioning system as logged, on its own clock",
        (c.T_NS, *c.QUATERNION, *c.POSITION),
        ("t_ns",),
    ),
    Table(
        "position",
        "signal",
        1,
        "position from satellite navigation, for the local magnetic field",
        (c.T_NS, c.LATITUDE_DEG, c.LONGITUDE_DEG, c.ALTITUDE_M),
        ("t_ns",),
    ),
    Table(
        "power",
        "signal",
        1,
        "what drives the motors, for the field that they make; either may be null",
        (c.T_NS, c.CURRENT_A, c.THROTTLE),
        ("t_ns",),
    ),
    Table(
        "gnss_velocity",
        "signal",
        1,
        "velocity from satellite navigation, not later than it was logged, on the log's clock",
        (c.T_NS, *c.GNSS_VELOCITY),
        ("t_ns",),
    ),
)

_STAGES = (
    Table(
        "faults",
        "stage",
        1,
        "what is wrong with a sensor's readings; axis is empty for the whole triad",
        (c.SENSOR, c.AXIS, c.REASON_CODE, c.FAULT_NUMBER, c.FAULT_LIMIT, c.FATAL, c.REASON),
        ("sensor", "axis", "reason_code"),
    ),
    Table(
        "segments",
        "stage",
        1,
        "excited stretches of the flight",
        (c.SEGMENT, c.START_NS, c.END_NS, c.N_SAMPLES, c.RATE_RMS, c.USED, c.REASON),
        ("segment",),
    ),
    Table(
        "samples",
        "stage",
        1,
        "readings of the used segments at the IMU's stamps, as logged and smoothed",
        (c.T_NS, c.SEGMENT, *c.GYROSCOPE, *c.ACCELEROMETER, *c.MAGNETOMETER_AT_IMU, *c.SMOOTHED),
        ("t_ns",),
    ),
    Table(
        "attitude",
        "stage",
        1,
        "attitude from the two vectors",
        (
            c.T_NS,
            c.SEGMENT,
            *c.QUATERNION,
            c.ATTITUDE_SD_RAD,
            c.TASTE,
            c.ACCELERATION_EXCESS_MPS2,
            c.FIELD_EXCESS,
            c.ATTITUDE_WEIGHT,
        ),
        ("t_ns",),
    ),
    Table(
        "trajectory",
        "stage",
        1,
        "attitude of the joint estimate at every sample",
        (c.T_NS, c.SEGMENT, *c.QUATERNION),
        ("t_ns",),
    ),
    Table(
        "held_out",
        "stage",
        1,
        "constants from the first part of a flight alone, which predict the rest of it",
        (*_CONSTANTS, c.FROM_NS),
        ("sensor", "method", "parameter", "axis"),
    ),
    Table(
        "covariance",
        "stage",
        1,
        "covariance of scale and bias",
        (c.ROW, c.COLUMN, c.COVARIANCE_VALUE),
        ("row", "column"),
    ),
    Table(
        "vps_aligned",
        "stage",
        1,
        "VPS attitude and body rate on the IMU's clock and axes",
        (c.T_NS, *c.QUATERNION, *c.BODY_RATE),
        ("t_ns",),
    ),
)

_HISTORY = (
    Table(
        "flight",
        "history",
        2,
        "one row a log, with its verdict",
        (
            *c.LEAD,
            c.LOG_URI,
            c.LOG_SHA256,
            c.LOG_FORMAT,
            c.DURATION_S,
            c.IMU_RATE_HZ,
            c.VPS_RATE_HZ,
            c.N_SAMPLES,
            c.TEMPERATURE_MIN_DEGC,
            c.TEMPERATURE_MEAN_DEGC,
            c.TEMPERATURE_MAX_DEGC,
            c.VERDICT,
            c.REASON_CODE,
            c.REASON,
            c.FINDINGS,
            c.VERIFIABLE,
        ),
        _HISTORY_FLIGHT_KEY,
    ),
    Table(
        "calibration",
        "history",
        3,
        "one row a unit, sensor, method, parameter and axis of a flight",
        (*c.LEAD, *_UNIT, *_CONSTANTS, c.RUN_KEY),
        ("flight_id", "unit_id", "sensor", "method", "parameter", "axis"),
    ),
    Table(
        "fit",
        "history",
        3,
        "one row a unit, quantity, method and reference of a flight: how well they agree",
        (
            *c.LEAD,
            *_UNIT,
            c.QUANTITY,
            c.METHOD,
            c.REFERENCE,
            c.SIGNAL,
            c.SAMPLE,
            c.TIC,
            c.TIC_BIAS,
            c.TIC_VARIANCE,
            c.TIC_COVARIANCE,
            c.RMS,
            c.RMS_UNIT,
            c.N_SAMPLES,
            c.RUN_KEY,
        ),
        ("flight_id", "unit_id", "quantity", "method", "reference", "signal", "sample"),
    ),
    Table(
        "sync",
        "history",
        3,
        "one row a unit of a flight with VPS: the VPS's clock against the IMU's",
        (
            *c.LEAD,
            *_UNIT,
            c.LAG_S,
            c.LAG_MID_S,
            c.LAG_SD_S,
            c.SKEW_PPM,
            c.SKEW_SD_PPM,
            c.PEAK,
            c.RUNNER_UP,
            c.STATUS,
            c.RUN_KEY,
        ),
        ("flight_id", "unit_id"),
    ),
    Table(
        "moments",
        "history",
        1,
        "one row a unit and sensor of a flight: sums that can be merged, for `fieldcal refit`",
        (
            *c.LEAD,
            *_UNIT,
            c.SENSOR,
            c.MAGNITUDE,
            c.UNIT,
            c.LOGGED_UNIT,
            c.TEMPERATURE_DEGC,
            c.READING_RATE_HZ,
            c.BLOCK_SAMPLES,
            c.N_SAMPLES,
            c.N_DIFFERENCES,
            c.SUMS,
            c.RUN_KEY,
        ),
        ("flight_id", "unit_id", "sensor"),
    ),
    Table(
        "run",
        "history",
        3,
        "one row a unit and stage of a flight: the execution that made the result",
        (*c.LEAD, *_UNIT, c.STAGE, c.STATUS, c.REASON_CODE, c.MEASURED, c.RUN_KEY, c.VERSIONS),
        ("flight_id", "unit_id", "stage"),
    ),
    Table(
        "information",
        "history",
        1,
        "one row a unit and parameter of a flight: its normal equations, what it says of all constants together",
        (
            *c.LEAD,
            *_UNIT,
            c.PLACE,
            c.SENSOR,
            c.PARAMETER,
            c.AXIS,
            c.SENSOR_UNIT_ID,
            c.UNIT,
            c.LINEARISED_AT,
            c.RIGHT_SIDE,
            c.INFORMATION,
            c.TEMPERATURE_DEGC,
            c.STATUS,
            c.REASON_CODE,
            c.RUN_KEY,
        ),
        ("flight_id", "unit_id", "place"),
    ),
    Table(
        "drift",
        "history",
        4,
        "one row a unit, sensor, method, parameter and axis: trend over temperature and time",
        (
            c.VEHICLE_ID,
            c.IMU_ID,
            c.UNIT_ID,
            c.SENSOR,
            c.METHOD,
            c.PARAMETER,
            c.AXIS,
            c.UNIT,
            c.N_FLIGHTS,
            c.VALUE_AT_25DEGC,
            c.SD,
            c.SLOPE_PER_DEGC,
            c.SLOPE_PER_DEGC_SD,
            c.SLOPE_PER_DAY,
            c.SLOPE_PER_DAY_SD,
            c.LAST_Z,
            c.CHANGE_AT,
            c.STATUS,
            c.N_SESSIONS,
            c.AS_OF,
            c.BEST_KNOWN_DEGC,
            c.TEMPERATURE_MIN_DEGC,
            c.TEMPERATURE_MAX_DEGC,
            c.SESSION_SD,
            c.CHANGE_SIZE,
            c.CHANGE_SIZE_SD,
            c.FLEET_Z,
            c.REASON,
            c.BEST_KNOWN_AT,
            c.BORROWED_FROM,
            c.CURVE_PER_DEGC2,
            c.CURVE_PER_DEGC2_SD,
            c.CURVE_PER_DEGC3,
            c.CURVE_PER_DEGC3_SD,
        ),
        ("unit_id", "sensor", "method", "parameter", "axis"),
    ),
    Table(
        "pooled",
        "history",
        3,
        "one row a unit, sensor, parameter and axis: what all flights together say of it, led by the last one",
        (
            *c.LEAD,
            *_UNIT,
            c.SENSOR,
            c.PARAMETER,
            c.AXIS,
            c.UNIT,
            c.VALUE_AT_25DEGC,
            c.SD,
            c.SLOPE_PER_DEGC,
            c.SLOPE_PER_DEGC_SD,
            c.SLOPE_PER_DAY,
            c.SLOPE_PER_DAY_SD,
            c.LAST_Z,
            c.BEST_KNOWN_DEGC,
            c.TEMPERATURE_MIN_DEGC,
            c.TEMPERATURE_MAX_DEGC,
            c.SESSION_SD,
            c.WALK_PER_SQRT_DAY,
            c.SLOPE_SPREAD,
            c.N_INNOVATIONS,
            c.N_FLIGHTS,
            c.N_SESSIONS,
            c.CHANGE_AT,
            c.CHANGE_SIZE,
            c.CHANGE_SIZE_SD,
            c.POOLED_WITH,
            c.PLACE,
            c.COVARIANCE_BEFORE,
            c.FLIGHTS_POOLED,
            c.SHARES,
            c.LEFT_OUT,
            c.DISTANCES,
            c.STATUS,
            c.REASON_CODE,
            c.REASON,
            c.CURVE_PER_DEGC2,
            c.CURVE_PER_DEGC2_SD,
            c.CURVE_WITH_VALUE,
            c.CURVE_WITH_SLOPE,
        ),
        ("unit_id", "sensor", "parameter", "axis"),
    ),
    Table(
        "decision",
        "history",
        1,
        "one row a flight that somebody decided about: whether it counts, or its part that is named; null: every one",
        (
            c.VEHICLE_ID,
            c.FLIGHT_ID,
            c.DECIDED_AT,
            c.DECISION,
            c.UNIT_ID,
            c.SENSOR,
            c.PARAMETER,
            c.AXIS,
            c.AUTHOR,
            c.REASON,
        ),
        ("flight_id", "decided_at"),
    ),
    Table(
        "export",
        "history",
        1,
        "one row a number that was handed out for a unit's sensor to fly with",
        (
            c.VEHICLE_ID,
            c.EXPORTED_AT,
            c.LATEST_FLIGHT_ID,
            c.EXPORT_FORMAT,
            c.UNIT_ID,
            c.SENSOR,
            c.TARGET_NAME,
            c.SET_TO,
            c.AT_TEMPERATURE_DEGC,
            c.AUTHOR,
            c.EXPORT_SHA256,
        ),
        ("exported_at", "unit_id", "sensor", "name"),
    ),
)

TABLES: dict[str, Table] = {table.name: table for table in (*_SIGNALS, *_STAGES, *_HISTORY)}
SIGNAL_TABLES = tuple(table.name for table in _SIGNALS)
STAGE_TABLES = tuple(table.name for table in _STAGES)
HISTORY_TABLES = tuple(table.name for table in _HISTORY)
FLIGHT_TABLES = ("flight", "calibration", "fit", "sync", "moments", "run", "information")
"""Those of the history that nights fill, flight by flight."""
FLEET_TABLES = ("drift", "pooled")
"""Those that follow from these, vehicle by vehicle."""

UNITS_APART = "."
"""Between a signal's name and the number of a further unit on board: "imu.1"."""

_NOT_AT_STAGE_LEVEL = frozenset(column.name for column in (*c.LEAD, *_UNIT, c.SENSOR_UNIT_ID, c.RUN_KEY))
_AT_STAGE_LEVEL = ("calibration", "fit", "sync", "moments", "information")


def table_columns(table: str, *, stage: bool = False) -> tuple[Column, ...]:
    """Columns of a table; with `stage` those a stage writes: the lead and the run key are added when it is published.

    Raises
    ------
    KeyError
        There is no such table, or (`stage`) no stage writes it.
    """
    if table not in TABLES:
        raise KeyError(f"there is no table {table!r}; there are {', '.join(TABLES)}")
    definition = TABLES[table]
    if not stage or definition.kind == "stage":
        return definition.columns
    if table not in _AT_STAGE_LEVEL:
        raise KeyError(f"no stage writes the table {table!r}")
    return tuple(column for column in definition.columns if column.name not in _NOT_AT_STAGE_LEVEL)


def signal_kind(table: str) -> str:
    """The signal table whose columns readings have: "imu" of "imu.1", the readings of a further unit on board."""
    kind, _, number = table.partition(UNITS_APART)
    return kind if number.isascii() and number.isdigit() else table


def table_key(table: str, *, stage: bool = False) -> tuple[str, ...]:
    """Columns that identify a row of `table`."""
    names = {column.name for column in table_columns(table, stage=stage)}
    return tuple(name for name in TABLES[table].key if name in names)


def stage_columns(table: str) -> tuple[str, ...]:
    """Names of the columns of `table` as a stage writes it."""
    return tuple(column.name for column in table_columns(table, stage=True))
