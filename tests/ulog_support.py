"""ULog files for tests: what they should hold is known from how they were made, or from pyulog."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from pyulog import ULog

from fieldcal.logs.ulog.file import Change
from fieldcal.logs.ulog.write import Rows, encode

RATE_HZ = 200.0
START_US = 3_000_000
GYRO_ID, ACCEL_ID, MAG_ID = 2_162_688, 1_310_988, 396_809
SECOND_ID = 2_490_378


def times_us(seconds: float, rate_hz: float = RATE_HZ, start_us: int = START_US) -> np.ndarray:
    """Stamps of a steady stream."""
    return (start_us + np.arange(int(seconds * rate_hz)) * round(1e6 / rate_hz)).astype(np.uint64)


def readings(n: int, seed: int, size: float = 1.0) -> np.ndarray:
    """Random float32 vectors, (n, 3)."""
    return np.random.default_rng(seed).normal(0.0, size, (n, 3)).astype(np.float32)


def combined(t_us: np.ndarray, gyroscope: np.ndarray, accelerometer: np.ndarray, **more: np.ndarray) -> Rows:
    """sensor_combined."""
    columns = {
        "timestamp": t_us,
        "gyro_rad": gyroscope.astype(np.float32),
        "gyro_integral_dt": np.full(len(t_us), 5000, np.uint32),
        "accelerometer_timestamp_relative": np.zeros(len(t_us), np.int32),
        "accelerometer_m_s2": accelerometer.astype(np.float32),
        "accelerometer_clipping": np.zeros(len(t_us), np.uint8),
    }
    return Rows("sensor_combined", {**columns, **more})


def sensor(topic: str, t_us: np.ndarray, values: np.ndarray, device_id: int, instance: int = 0) -> Rows:
    """sensor_gyro, sensor_accel or sensor_mag."""
    axes = {axis: values[:, i].astype(np.float32) for i, axis in enumerate("xyz")}
    columns = {
        "timestamp": t_us + np.uint64(300),
        "timestamp_sample": t_us,
        "device_id": np.full(len(t_us), device_id, np.uint32),
        "temperature": np.full(len(t_us), 31.5, np.float32),
        **axes,
    }
    return Rows(topic, columns, instance)


def selection(*chosen: tuple[int, int, int]) -> Rows:
    """sensor_selection: time in µs, gyroscope, accelerometer."""
    columns = {name: np.array([row[i] for row in chosen]) for i, name in enumerate(("t", "gyro", "accel"))}
    return Rows(
        "sensor_selection",
        {
            "timestamp": columns["t"].astype(np.uint64),
            "accel_device_id": columns["accel"].astype(np.uint32),
            "gyro_device_id": columns["gyro"].astype(np.uint32),
        },
    )


def gnss(t_us: np.ndarray, utc_minus_boot_us: int, fix: int = 3) -> Rows:
    """vehicle_gps_position of v1.15."""
    n = len(t_us)
    velocity = readings(n, 9)
    return Rows(
        "vehicle_gps_position",
        {
            "timestamp": t_us,
            "latitude_deg": np.full(n, 47.5),
            "longitude_deg": np.full(n, 8.5),
            "altitude_msl_m": np.full(n, 430.0),
            "time_utc_usec": (t_us.astype(np.int64) + utc_minus_boot_us).astype(np.uint64),
            "s_variance_m_s": np.full(n, 0.25, np.float32),
            "vel_n_m_s": velocity[:, 0],
            "vel_e_m_s": velocity[:, 1],
            "vel_d_m_s": velocity[:, 2],
            "fix_type": np.full(n, fix, np.uint8),
            "vel_ned_valid": np.ones(n, np.uint8),
        },
    )


def flight(seconds: float = 4.0, seed: int = 1) -> list[Rows]:
    """A small log of a recent firmware: one IMU, a magnetometer, a receiver, a text-like topic beside them."""
    t_us = times_us(seconds)
    slow = times_us(seconds, 20.0)
    odd = {"timestamp": slow, "flags": np.arange(len(slow) * 5, dtype=np.uint8).reshape(-1, 5)}
    return [
        combined(t_us, readings(len(t_us), seed), readings(len(t_us), seed + 1, 9.8)),
        sensor("sensor_mag", slow, readings(len(slow), seed + 2, 0.4), MAG_ID),
        gnss(times_us(seconds, 5.0), 1_700_000_000_000_000),
        Rows("telemetry_status", {**odd, "rssi": np.full(len(slow), -3, np.int8)}),
        selection((START_US, GYRO_ID, ACCEL_ID)),
    ]


def parts_of(topics: list[Rows], **more: Any) -> list[bytes]:
    """Head and messages of a file."""
    return encode(topics, **{"parameters": {"CAL_GYRO0_ID": GYRO_ID, "SYS_HITL": 0}, "infos": {"ver_hw": "X"}, **more})


def changed(t_us: int, name: str, value: float) -> Change:
    """A parameter that is set in flight."""
    return Change(t_us, name, value)


def by_pyulog(path: Path) -> dict[tuple[str, int], dict[str, np.ndarray]]:
    """(topic, instance) → field → values, by PX4's own library."""
    return {(data.name, data.multi_id): data.data for data in ULog(str(path)).data_list}
