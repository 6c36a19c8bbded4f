"""What the tests of DataFlash logs share: a flight with a known truth, the same messages read by pymavlink."""

from __future__ import annotations

import contextlib
import io
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from pymavlink import DFReader

from fieldcal.logs.dataflash import write

WEEK, WEEK_MS = 2300, 345_600_000
LEAP_NS = 18 * 10**9
BOOT_US = 60_000_000
UTC_AT_BOOT_NS = (315_964_800 + WEEK * 604_800) * 10**9 + WEEK_MS * 10**6 - LEAP_NS
TEXTS = ("ArduCopter V4.5.7 (0123abcd)", "ChibiOS: 6a85082c", "CubeOrange 0030002B 32335117 36343932")
PARAMETERS = {
    "AHRS_ORIENTATION": 0.0,
    "INS_GYR_ID": 3604746.0,
    "INS_ACC_ID": 3604746.0,
    "INS_GYRO_FILTER": 20.0,
    "INS_ACCEL_FILTER": 10.0,
    **{f"INS_GYROFFS_{axis}": 0.01 * i for i, axis in enumerate("XYZ", 1)},
    **{f"INS_ACCOFFS_{axis}": 0.1 * i for i, axis in enumerate("XYZ", 1)},
    **{f"INS_ACCSCAL_{axis}": 1.0 + 0.01 * i for i, axis in enumerate("XYZ", 1)},
    **{f"COMPASS_OFS_{axis}": 10.0 * i for i, axis in enumerate("XYZ", 1)},
    "COMPASS_DEV_ID": 97539.0,
    "COMPASS_EXTERNAL": 1.0,
}


class DataflashFlight:
    """Seeded readings as they are logged, every number exact in its format: whole milligauss, float32 and so on."""

    def __init__(self, samples: int = 400, seed: int = 0) -> None:
        generator = np.random.default_rng(seed)
        self.t_us = BOOT_US + np.arange(samples) * 20_000 + generator.integers(0, 500, samples)
        normal = generator.normal(size=(4, samples, 3)).astype(np.float32).astype(float)
        self.gyroscope, self.accelerometer, self.gyroscope_1, self.accelerometer_1 = normal
        self.temperature = generator.normal(30, 3, samples).astype(np.float32).astype(float)
        self.mag_us = self.t_us[::5] + 7
        self.magnetometer = generator.integers(-600, 600, (len(self.mag_us), 3)) / 1e3
        self.gps_us = self.t_us[::10] // 1000 * 1000  # whole ms as GPS time: one offset to the epoch
        place = np.array([471_234_567, 81_234_567, 42_000]) + generator.integers(-900, 900, (len(self.gps_us), 3))
        self.position = place / np.array([1e7, 1e7, 1e2])
        self.velocity = generator.normal(size=(len(self.gps_us), 3)).astype(np.float32).astype(float)
        self.status = np.where(np.arange(len(self.gps_us)) < 3, 1, 3)
        self.vision_us = self.t_us[::4] + 13_000
        self.vision_m, self.vision_deg = generator.uniform(-80, 80, (2, len(self.vision_us), 3))
        self.current = generator.normal(20, 3, len(self.mag_us)).astype(np.float32).astype(float)

    def messages(self) -> list[write.Messages]:
        """The flight as messages: two IMUs, a magnetometer and all else that is read."""
        ms = WEEK_MS + self.gps_us // 1000
        return [
            write.imu_messages(self.t_us, self.gyroscope, self.accelerometer, self.temperature),
            write.imu_messages(self.t_us, self.gyroscope_1, self.accelerometer_1, self.temperature, instance=1),
            write.mag_messages(self.mag_us, self.magnetometer, offsets_mg=(10, 20, 30), sample_us=self.mag_us - 40),
            write.gps_messages(self.gps_us, WEEK, ms, self.position, self.velocity, status=self.status),
            write.gpa_messages(self.gps_us + 3, np.full(len(self.gps_us), 0.25)),
            write.vision_messages(self.vision_us, self.vision_m, self.vision_deg, (self.vision_us - 12_000) // 1000),
            write.battery_messages(self.mag_us + 5, self.current),
        ]

    def write(self, path: Path, **options: Any) -> Path:
        """The flight as a file."""
        options = {"parameters": PARAMETERS, "texts": TEXTS} | options
        write.write_dataflash(path, self.messages(), **options)
        return path


def by_pymavlink(path: Path) -> tuple[Counter[str], dict[str, dict[str, list[Any]]]]:
    """(messages by name, name → column → values) as pymavlink reads them."""
    counts: Counter[str] = Counter()
    values: dict[str, dict[str, list[Any]]] = {}
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        log = DFReader.DFReader_binary(str(path))
        while (message := log.recv_msg()) is not None:
            name = message.get_type()
            counts[name] += 1
            columns = values.setdefault(name, {column: [] for column in message.fmt.columns})
            for column in columns:
                columns[column].append(getattr(message, column))
    return counts, values
