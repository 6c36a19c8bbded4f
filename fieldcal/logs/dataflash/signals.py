"""Messages as signal tables: which messages a signal is in, and their fields as its columns."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fieldcal.geometry.rotation import from_euler
from fieldcal.logs.dataflash.clock import LEAST_FIX, sampled_ns, stamps_ns
from fieldcal.logs.dataflash.file import DataflashFile
from fieldcal.logs.dataflash.records import Rows
from fieldcal.logs.interface import Columns
from fieldcal.logs.joining import imu_columns, triad

PIECE_ROWS = 1 << 16
"""Rows of a batch."""
LOCATED = (
    *("PARM", "MSG", "VER", "SIM", "DSF", "ISBH", "GPS", "GPA", "VISP", "BAT", "CURR"),
    *(f"{stem}{number}" for stem in ("IMU", "MAG", "ACC", "GYR") for number in ("", "1", "2", "3")),
)
"""Names of every message that is read."""
INSTANCE = ("I", "Instance", "Inst")
GYROSCOPE = ("GyrX", "GyrY", "GyrZ")
ACCELEROMETER = ("AccX", "AccY", "AccZ")
MAGNETOMETER = ("MagX", "MagY", "MagZ")
OFFSETS = ("OfsX", "OfsY", "OfsZ")
MOTORS = (("MOX", "MOY", "MOZ"), ("MOfsX", "MOfsY", "MOfsZ"))
ANGLES = (("Roll", "Pitch", "Yaw"), ("R", "P", "Y"))
MILLI, CENTI = 1e-3, 1e-2
NO_ACCURACY_MPS = 655.0
"""GPA.SAcc at the end of its range: the receiver does not say."""
NEAREST_ACCURACY_NS = 1_000_000_000


@dataclass(frozen=True)
class Stream:
    """Messages of one instance of a sensor. `name`: how the log calls them. `t_ns` (n,): their stamps since boot."""

    instance: int
    name: str
    rows: Rows
    t_ns: NDArray[np.int64]

    @property
    def rate_hz(self) -> float:
        """By the median interval; 0 below two messages, or when the clock stands."""
        usual = float(np.median(np.diff(self.t_ns))) if len(self.t_ns) > 1 else 0.0
        return 1e9 / usual if usual > 0 else 0.0

    def pieces(self) -> Iterator[Stream]:
        """The same in parts of bounded size."""
        for first in range(0, len(self.t_ns), PIECE_ROWS):
            part = slice(first, first + PIECE_ROWS)
            rows = Rows(self.rows.layout, self.rows.content, self.rows.starts[part], self.rows.multipliers)
            yield Stream(self.instance, self.name, rows, self.t_ns[part])

    def vectors(self, names: tuple[str, str, str], multiplier: float = 1.0) -> NDArray[np.float64]:
        """Three columns in their unit, (n, 3)."""
        return np.stack([self.rows.in_unit(name, multiplier) for name in names], axis=1)


def streams(file: DataflashFile, stem: str, needed: tuple[str, ...], malformed: dict[str, int]) -> dict[int, Stream]:
    """Instance → its messages: by a field of the message, before 4.1 by its name (IMU, IMU2, IMU3; ACC1, ACC2, ACC3).

    Messages without one of the `needed` columns, or without a stamp, are counted in `malformed` by their name.
    """
    found: dict[int, Stream] = {}
    for number in ("", "1", "2", "3"):
        rows = file.rows(stem + number)
        if rows is None:
            continue
        t_ns = stamps_ns(rows)
        if t_ns is None or not all(name in rows for name in needed):
            malformed[stem + number] = len(rows)
            continue
        field = next((name for name in INSTANCE if name in rows), None)
        if field is None:
            instance = int(number or 1) - 1
            found.setdefault(instance, Stream(instance, stem + number, rows, t_ns))
            continue
        instances = rows.integers(field)
        for instance in np.unique(instances).tolist():
            own = instances == instance
            found.setdefault(instance, Stream(instance, f"{stem}[{instance}]", rows.where(own), t_ns[own]))
    return dict(sorted(found.items()))


def by_sample(stream: Stream) -> Stream:
    """The same at the times of the samples, where the messages tell them: SampleUS of ACC and GYR, S of MAG."""
    name = next((name for name in ("SampleUS", "S") if name in stream.rows), None)
    if name is None:
        return stream
    bits = 8 * stream.rows.layout.letter(name).dtype.itemsize
    t_ns = sampled_ns(stream.t_ns, stream.rows.integers(name), bits)
    return Stream(stream.instance, stream.name, stream.rows, t_ns)


def imu(stream: Stream) -> Columns:
    """Rates in rad/s, specific force in m/s²."""
    return imu_columns(stream.t_ns, stream.vectors(GYROSCOPE), stream.vectors(ACCELEROMETER))


def magnetometer(stream: Stream) -> Columns:
    """The field in gauss; without a multiplier of the log's own, stored milligauss."""
    return {"t_ns": stream.t_ns, **triad("magnetometer", stream.vectors(MAGNETOMETER, MILLI))}


def temperature(stream: Stream) -> Columns | None:
    """The IMU's temperature, °C; None where the firmware does not log it, or the unit has no sensor for it (all 0)."""
    name = next((name for name in ("T", "Temp") if name in stream.rows), None)
    values = stream.rows.in_unit(name) if name else np.empty(0)
    return {"t_ns": stream.t_ns, "temperature_degc": values} if values.any() else None


def motors(stream: Stream) -> int:
    """Messages of a magnetometer in which the autopilot had compensated for its motors."""
    names = next((names for names in MOTORS if all(name in stream.rows for name in names)), None)
    return 0 if names is None else int(np.count_nonzero(np.any(stream.vectors(names) != 0, axis=1)))


def fixed(stream: Stream) -> NDArray[np.bool_]:
    """Which GPS messages (n,) are of a three-dimensional fix."""
    return stream.rows.integers("Status") >= LEAST_FIX


def position(gps: Stream) -> Columns:
    """Where it is: degrees, and metres above the sea."""
    columns = {"latitude_deg": "Lat", "longitude_deg": "Lng", "altitude_m": "Alt"}
    return {"t_ns": gps.t_ns, **{name: gps.rows.numbers(column) for name, column in columns.items()}}


def velocity(gps: Stream, accuracy: Stream | None) -> Columns:
    """Velocity by GPS, m/s; its standard deviation by the nearest GPA message, NaN where that does not tell."""
    speed, course = gps.rows.in_unit("Spd"), np.deg2rad(gps.rows.in_unit("GCrs"))
    columns: Columns = {
        "t_ns": gps.t_ns,
        "velocity_north_mps": speed * np.cos(course),
        "velocity_east_mps": speed * np.sin(course),
        "velocity_down_mps": gps.rows.in_unit("VZ"),
    }
    if accuracy is not None and len(accuracy.t_ns):
        order = np.argsort(accuracy.t_ns, kind="stable")
        t_ns, sd = accuracy.t_ns[order], accuracy.rows.numbers("SAcc")[order]
        after = np.minimum(np.searchsorted(t_ns, gps.t_ns), len(t_ns) - 1)
        before = np.maximum(after - 1, 0)
        nearest = np.where(np.abs(t_ns[after] - gps.t_ns) <= np.abs(t_ns[before] - gps.t_ns), after, before)
        near = np.abs(t_ns[nearest] - gps.t_ns) <= NEAREST_ACCURACY_NS
        columns["velocity_sd_mps"] = np.where(near & (sd[nearest] < NO_ACCURACY_MPS), sd[nearest], np.nan)
    return columns


def vps(stream: Stream) -> Columns:
    """Poses of external vision: the body's attitude against north-east-down by roll, pitch and yaw (3-2-1), degrees.

    CTimeMS is when the pose was taken, by the autopilot's clock.
    """
    rows, t_ns = stream.rows, stream.t_ns
    if "CTimeMS" in rows:
        t_ns = sampled_ns(t_ns, rows.integers("CTimeMS") * 1000, 64)
    attitude = from_euler(np.deg2rad(stream.vectors(next(n for n in ANGLES if n[0] in rows))))
    columns: Columns = {"t_ns": t_ns}
    columns |= {f"q{axis}": np.ascontiguousarray(attitude[:, i]) for i, axis in enumerate("xyzw")}
    return columns | {f"p{axis}_m": rows.in_unit(f"P{axis.upper()}") for axis in "xyz"}


def power(stream: Stream) -> Columns:
    """Current of the battery, A; before 3.4 stored centiamperes."""
    return {"t_ns": stream.t_ns, "current_a": stream.rows.in_unit("Curr", CENTI)}
