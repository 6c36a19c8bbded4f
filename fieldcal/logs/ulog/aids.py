"""What a PX4 log holds beside inertial sensors: satellite navigation, an external pose, temperature, current, UTC."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from fieldcal.logs.interface import EPOCH_KNOWN_AFTER_NS, Batch, Columns
from fieldcal.logs.ulog.file import Rows, UlogFile
from fieldcal.logs.ulog.records import Topic
from fieldcal.logs.ulog.streams import LATEST_US, Clock, has, stamps_us, vector
from fieldcal.logs.ulog.units import Unit, first_id

GNSS = ("vehicle_gps_position", "sensor_gps")
POSES = ("vehicle_mocap_odometry", "vehicle_visual_odometry")
FIX_3D = 3
_KNOWN_FRAMES = {"local_frame": (0, 1), "pose_frame": (1, 2)}
"""North-east-down, and forward-right-down of any heading: in both z is down, as the quaternion's body axes are FRD."""
_VELOCITY = ("vel_n_m_s", "vel_e_m_s", "vel_d_m_s")


@dataclass(frozen=True)
class Epoch:
    """What to add to time since boot for Unix time, and where that is from."""

    offset_ns: int
    source: str


def epoch(file: UlogFile) -> Epoch | None:
    """Unix time at boot, by satellite navigation, else by the logger's own note; None: the log does not tell."""
    least_us = EPOCH_KNOWN_AFTER_NS // 1000
    for topic in _gnss(file):
        if not has(topic, "time_utc_usec"):
            continue
        rows = file.rows(topic)
        utc, boot = rows["time_utc_usec"].astype(np.int64), rows["timestamp"].astype(np.int64)
        good = (rows["fix_type"] >= FIX_3D) & (utc > least_us) & (utc < LATEST_US) & (boot < LATEST_US) & (boot >= 0)
        if good.any():
            apart = (utc - boot)[good]
            offset = int(np.median(apart))
            low, high = (apart.min() - offset) / 1e3, (apart.max() - offset) / 1e3
            told = f"{topic.name}, {len(apart)} fixes, {low:+.0f} to {high:+.0f} ms about their median"
            return Epoch(offset * 1000, told)
    noted = file.infos.get("boot_time_utc_us", "")
    if noted.isdigit() and least_us < int(noted) < LATEST_US:
        return Epoch(int(noted) * 1000, "boot_time_utc_us")
    return None


def gnss_batches(file: UlogFile, clock: Clock) -> Iterator[Batch]:
    """Velocity and position of the receiver, where it has a fix in three dimensions."""
    for topic in _gnss(file)[:1]:
        for rows in file.chunks(topic):
            fixed = rows[rows["fix_type"] >= FIX_3D]
            if not len(fixed):
                continue
            t_ns = clock.ns(stamps_us(fixed))
            place = _place(topic, fixed)
            if place:
                yield "position", {"t_ns": t_ns, **place}
            if not has(topic, *_VELOCITY):
                continue
            valid = fixed["vel_ned_valid"] > 0 if has(topic, "vel_ned_valid") else np.ones(len(fixed), bool)
            velocity = vector(fixed, *_VELOCITY)[valid]
            columns: Columns = {"t_ns": t_ns[valid]}
            for number, way in enumerate(("north", "east", "down")):
                columns[f"velocity_{way}_mps"] = velocity[:, number].copy()
            if has(topic, "s_variance_m_s"):  # a standard deviation, in spite of its name
                columns["velocity_sd_mps"] = fixed["s_variance_m_s"][valid].astype(np.float64)
            if valid.any():
                yield "gnss_velocity", columns


def pose_topic(file: UlogFile) -> Topic | None:
    """The external pose with the most messages."""
    found = [t for name in POSES for t in file.instances(name) if has(t, "timestamp") and has(t, "q", shape=(4,))]
    return max(found, key=file.count) if found else None


def pose_columns(topic: Topic, rows: Rows, clock: Clock) -> tuple[Columns, int]:
    """Columns of table "vps" where there is an attitude, and how many rows are in a frame that cannot be used.

    PX4's q is scalar first and turns body components into the world's, as "vps" has it scalar last.
    """
    usable = np.ones(len(rows), bool)
    for name, known in _KNOWN_FRAMES.items():
        if has(topic, name):
            usable &= np.isin(rows[name], known)
    unusable = int(np.count_nonzero(~usable))
    rows = rows[usable & np.isfinite(rows["q"][:, 0])]
    columns: Columns = {"t_ns": clock.ns(stamps_us(rows))}
    for number, name in ((1, "qx"), (2, "qy"), (3, "qz"), (0, "qw")):
        columns[name] = rows["q"][:, number].astype(np.float64)
    if has(topic, "position", shape=(3,)):
        columns |= {f"p{axis}_m": rows["position"][:, i].astype(np.float64) for i, axis in enumerate("xyz")}
    elif has(topic, "x", "y", "z"):
        columns |= {f"p{axis}_m": rows[axis].astype(np.float64) for axis in "xyz"}
    return columns, unusable


def temperature(file: UlogFile, unit: Unit, clock: Clock) -> Columns | None:
    """Temperature of a unit, by the sensors themselves, else by the status of the IMU; None without."""
    wanted = (
        ("sensor_accel", "device_id", unit.accelerometer_id, "temperature"),
        ("sensor_gyro", "device_id", unit.device_id, "temperature"),
        ("vehicle_imu_status", "accel_device_id", unit.accelerometer_id, "temperature_accel"),
        ("vehicle_imu_status", "gyro_device_id", unit.device_id, "temperature_gyro"),
    )
    for name, id_name, number, value_name in wanted:
        for topic in file.instances(name):
            if not has(topic, "timestamp", id_name, value_name) or first_id(file, topic, id_name) != number:
                continue
            rows = file.rows(topic)
            values = rows[value_name].astype(np.float64)
            known = np.isfinite(values)
            if known.any():
                return {"t_ns": clock.ns(stamps_us(rows[known])), "temperature_degc": values[known]}
    return None


def current(file: UlogFile, clock: Clock) -> Columns | None:
    """Current of the first battery; it is negative where it is not measured. None without."""
    for topic in file.instances("battery_status"):
        if has(topic, "timestamp", "current_a"):
            rows = file.rows(topic)
            rows = rows[rows["current_a"] >= 0]
            if len(rows):
                return {"t_ns": clock.ns(stamps_us(rows)), "current_a": rows["current_a"].astype(np.float64)}
    return None


def _gnss(file: UlogFile) -> list[Topic]:
    return [t for name in GNSS for t in file.instances(name) if has(t, "timestamp", "fix_type")]


def _place(topic: Topic, rows: Rows) -> Columns:
    if has(topic, "latitude_deg", "longitude_deg", "altitude_msl_m"):
        names, units = ("latitude_deg", "longitude_deg", "altitude_msl_m"), (1.0, 1.0, 1.0)
    elif has(topic, "lat", "lon", "alt"):
        names, units = ("lat", "lon", "alt"), (1e-7, 1e-7, 1e-3)
    else:
        return {}
    values = [rows[name].astype(np.float64) * unit for name, unit in zip(names, units, strict=True)]
    return dict(zip(("latitude_deg", "longitude_deg", "altitude_m"), values, strict=True))
