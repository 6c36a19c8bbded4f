"""Which columns of a CSV file hold what: configured names, or the default ones."""

from __future__ import annotations

import difflib
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from fieldcal.config.configuration import CsvMap
from fieldcal.config.values import Paths
from fieldcal.errors import UnreadableLog
from fieldcal.logs.csv.attitude import ANGLES, MATRIX, VECTOR, quaternion_by_names
from fieldcal.logs.csv.dialect import Dialect
from fieldcal.logs.csv.units import sensor_unit, without_unit
from fieldcal.logs.interface import LogSummary
from fieldcal.logs.joining import INERTIAL
from fieldcal.names import SENSORS
from fieldcal.reason_codes import ReasonCode

IMU_DEFAULTS: dict[str, tuple[str, ...]] = {
    "gyroscope": ("gx", "gy", "gz"),
    "accelerometer": ("ax", "ay", "az"),
    "magnetometer": ("mx", "my", "mz"),
    "temperature": ("temp",),
    "current": ("current_a",),
    "throttle": ("throttle",),
    "gnss_velocity": ("velocity_north_mps", "velocity_east_mps", "velocity_down_mps"),
    "gnss_velocity_sd": ("velocity_sd_mps",),
}
VPS_DEFAULTS: dict[str, tuple[str, ...]] = {
    "quaternion_xyzw": ("qx", "qy", "qz", "qw"),
    "quaternion_wxyz": (),
    "roll_pitch_yaw": (),
    "rotation_matrix": (),
    "rotation_vector": (),
    "position": ("px", "py", "pz"),
}
AXES: dict[str, tuple[str, ...]] = {key: tuple(f"{key}_{axis}" for axis in "xyz") for key in SENSORS}
VELOCITY_COLUMNS = {key: IMU_DEFAULTS[key] for key in ("gnss_velocity", "gnss_velocity_sd")}
POWER_COLUMNS = {"current": ("current_a",), "throttle": ("throttle",)}
VPS_COLUMNS = {
    "quaternion_xyzw": ("qx", "qy", "qz", "qw"),
    "roll_pitch_yaw": ANGLES,
    "rotation_matrix": MATRIX,
    "rotation_vector": VECTOR,
    "position": ("px_m", "py_m", "pz_m"),
}
OTHER_ATTITUDES = ("roll_pitch_yaw", "rotation_matrix", "rotation_vector")
"""Attitudes of a VPS that become a quaternion."""
OPTIONAL = ("temperature", "current", "throttle", "gnss_velocity", "gnss_velocity_sd", "position")
"""What a log may lack although it is configured."""
TIME_DEFAULTS = tuple(
    stem + suffix for stem in ("t", "time", "timestamp") for suffix in ("_s", "", "_ms", "_us", "_ns")
)


@dataclass(frozen=True)
class Columns:
    """Positions of columns: `time` (None: the file has none), and of each value that the file has."""

    time: int | None
    values: dict[str, tuple[int, ...]]


def find_columns(
    dialect: Dialect,
    configured: Mapping[str, Paths],
    defaults: Mapping[str, tuple[str, ...]],
    table: str,
    log_name: str,
) -> Columns:
    """Positions of the columns of one table ("imu", "vps").

    A configured column must be there; the default names are taken where the file has them, with or without a unit in
    brackets, all of a sensor or none.

    Raises
    ------
    UnreadableLog
        `missing_column`, `duplicate_column`.
    """
    values = {}
    written = default_names(dialect.names)
    for key, default in defaults.items():
        wanted = configured.get(key)
        names = (wanted,) if isinstance(wanted, str) else tuple(wanted or default)
        if not wanted:
            names = tuple(written.get(name, name) for name in names)
        if wanted or any(name in dialect.names for name in names):
            values[key] = tuple(_position(name, dialect, f"csv.{table}.{key}", log_name) for name in names)
    if configured.get("t"):
        return Columns(_position(str(configured["t"]), dialect, f"csv.{table}.t", log_name), values)
    times = [written[name] for name in TIME_DEFAULTS if name in written]
    return Columns(_position(times[0], dialect, f"csv.{table}.t", log_name) if times else None, values)


def signal_groups(
    imu: Columns | None, vps: Columns | None, *, apart: bool
) -> list[tuple[str, list[tuple[str, tuple[str, ...]]]]]:
    """Signal table → (key of the column map, output columns). `apart`: inertial sensors have rows of their own."""
    own = imu.values if imu is not None else {}
    reference = vps.values if vps is not None else {}
    inertial = [(key, AXES[key]) for key in INERTIAL if key in own]
    return [
        *([(key, [(key, axes)]) for key, axes in inertial] if apart else [("imu", inertial)]),
        ("magnetometer", [("magnetometer", AXES["magnetometer"])] if "magnetometer" in own else []),
        ("temperature", [("temperature", ("temperature_degc",))] if "temperature" in own else []),
        ("power", [(key, outs) for key, outs in POWER_COLUMNS.items() if key in own]),
        (
            "gnss_velocity",
            [(key, outs) for key, outs in VELOCITY_COLUMNS.items() if "gnss_velocity" in own and key in own],
        ),
        ("vps", [(key, outs) for key, outs in VPS_COLUMNS.items() if key in reference]),
    ]


def known_by_names(dialect: Dialect, csv: CsvMap) -> set[str]:
    """Tables ("imu", "vps") that default or configured names tell: a sensor, or an attitude and its time."""

    written = default_names(dialect.names)

    def has_default(names: Sequence[str]) -> bool:
        return any(name in written for name in names)

    known = {"imu"} if any(sensor in csv.imu or has_default(IMU_DEFAULTS[sensor]) for sensor in SENSORS) else set()
    attitude = has_default(VPS_DEFAULTS["quaternion_xyzw"]) or quaternion_by_names(dialect.names) is not None
    timed = csv.rate_hz is not None or any(name in dialect.names for name in TIME_DEFAULTS)  # of formats, with a unit
    return known | ({"vps"} if csv.vps or (attitude and timed) else set())


def attitude_columns(dialect: Dialect, columns: Columns) -> Columns:
    """Columns of a VPS with at most one attitude: the configured one, else the default, else one that names tell.

    A quaternion's columns are in the order x, y, z, w.
    """
    values = dict(columns.values)
    if "quaternion_wxyz" in values:
        w, *xyz = values.pop("quaternion_wxyz")
        values["quaternion_xyzw"] = (*xyz, w)
    elif any(key in values for key in OTHER_ATTITUDES):
        values.pop("quaternion_xyzw", None)
    elif "quaternion_xyzw" not in values:
        named = quaternion_by_names(dialect.names)
        if named:
            values["quaternion_xyzw"] = named
    return Columns(columns.time, values)


def without_absent(
    dialect: Dialect, configured: Mapping[str, Paths], table: str, summary: LogSummary, log_name: str
) -> dict[str, Paths]:
    """The configured columns but optional ones that the file lacks, which are told."""
    kept = dict(configured)
    for key in OPTIONAL:
        wanted = configured.get(key, ())
        absent = [name for name in ((wanted,) if isinstance(wanted, str) else wanted) if name not in dialect.names]
        if absent:
            del kept[key]
            summary.add(
                ReasonCode.MISSING_COLUMN,
                1,
                f"{log_name} has no column {absent[0]!r} (csv.{table}.{key}); {_nearest(absent[0], dialect.names)}. It "
                f"is read without its {key}.",
            )
    return kept


def no_attitude(dialect: Dialect, log_name: str, hint: str) -> UnreadableLog:
    """The refusal of a VPS's file whose attitude is not understood; `hint` ends its sentence."""
    listed = ", ".join(name for name in dialect.names[:20] if name)
    return UnreadableLog(
        ReasonCode.MISSING_COLUMN,
        f"{log_name} has no known quaternion columns; it has {listed}. Name them as csv.vps.quaternion_xyzw or "
        f"csv.vps.quaternion_wxyz, or angles (yaw, pitch, roll applied in this order) as csv.vps.roll_pitch_yaw.{hint}",
    )


def declared_units(dialect: Dialect, columns: Columns, summary: LogSummary, log_name: str) -> dict[str, str]:
    """Unit of each sensor as its columns say it. Axes that disagree are a finding and give none."""
    units = {}
    for sensor, positions in columns.values.items():
        if sensor not in SENSORS:
            continue
        row = dialect.unit_row
        found = {sensor_unit(sensor, dialect.names[place], row[place] if row else None) for place in positions}
        if len(found) > 1:
            listed = ", ".join(sorted(str(unit) for unit in found))
            summary.add(
                ReasonCode.UNIT_CONFLICT, 1, f"{log_name}: the axes of the {sensor} are in different units ({listed})."
            )
        elif (unit := found.pop()) is not None:
            units[sensor] = unit
    return units


def default_names(names: Sequence[str]) -> dict[str, str]:
    """Default name → the column that it means: of that name, else the one that is it with a unit in brackets. Of two of
    these neither is meant."""
    bare = [without_unit(name) for name in names]
    times = Counter(bare)
    with_unit = {name: own for name, own in zip(bare, names, strict=True) if times[name] == 1}
    return with_unit | {name: name for name in names}


def _position(name: str, dialect: Dialect, key: str, log_name: str) -> int:
    places = [place for place, known in enumerate(dialect.names) if known == name]
    if len(places) == 1:
        return places[0]
    if places:
        raise UnreadableLog(
            ReasonCode.DUPLICATE_COLUMN,
            f"{log_name} has {len(places)} columns named {name!r}: which one is meant cannot be known. Rename one.",
        )
    raise UnreadableLog(
        ReasonCode.MISSING_COLUMN,
        f"{log_name} has no column {name!r} ({key}); {_nearest(name, dialect.names)}. Correct {key}.",
    )


def _nearest(name: str, names: Sequence[str]) -> str:
    close = difflib.get_close_matches(name, names, n=3, cutoff=0.5)
    if close:
        return "nearest: " + ", ".join(repr(candidate) for candidate in close)
    return "it has " + ", ".join(repr(candidate) for candidate in names[:20])
