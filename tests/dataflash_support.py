"""What the tests of DataFlash logs share: a flight with a known truth, the same messages read by pymavlink."""

from __future__ import annotations

import contextlib
import io
import struct
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from pymavlink import DFReader

from fieldcal.logs.dataflash import write
from fieldcal.logs.dataflash.records import Rows, parse_fmt

FMT = struct.Struct("<3sBB4s16s64s")
PACK = {letter: letter for letter in "bBhHiIqQfd"} | dict(zip("cCeELMg", "hHiIiBe", strict=True))
PACK |= {"n": "4s", "N": "16s", "Z": "64s", "a": "32h"}
"""Format letter → how struct packs it."""

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


def fmt(type_id: int, size: int, name: str, letters: str, columns: str) -> bytes:
    """A definition as it stands in a log."""
    return FMT.pack(b"\xa3\x95\x80", type_id, size, name.encode(), letters.encode(), columns.encode())


def own_fmt() -> bytes:
    """FMT's own, with which logs begin."""
    return fmt(128, 89, "FMT", "BBnNZ", "Type,Length,Name,Format,Columns")


def packed(type_id: int, name: str, letters: str, columns: Mapping[str, Sequence[Any]]) -> tuple[bytes, bytes]:
    """The definition of a message and its rows, packed by struct. Letter c and its like take what is stored."""
    layout = struct.Struct("<2sB" + "".join(PACK[letter] for letter in letters))
    rows = [
        [v for one in row for v in (one if isinstance(one, range) else (one,))]
        for row in zip(*columns.values(), strict=True)
    ]
    content = b"".join(layout.pack(b"\xa3\x95", type_id, *row) for row in rows)
    return fmt(type_id, layout.size, name, letters, ",".join(columns)), content


def rows_of(
    name: str, letters: str, columns: Mapping[str, Sequence[Any]], *, multipliers: Mapping[str, float] | None = None
) -> Rows:
    """Messages as a log's pass would have found them."""
    definition, content = packed(130, name, letters, columns)
    layout = parse_fmt(definition)
    assert layout is not None
    starts = np.arange(len(content) // layout.size, dtype=np.int64) * layout.size
    return Rows(layout, np.frombuffer(content, np.uint8), starts, multipliers or {})


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
