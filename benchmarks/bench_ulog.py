"""How fast ULog files are read, beside pyulog: every topic, and those that a calibration needs. Processor time.

Run: python benchmarks/bench_ulog.py [FILE.ulg …] [--repeat 5]

Without files one is made: 250 Hz sensor_combined among slower topics, ten minutes.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from pyulog import ULog

from fieldcal.config.configuration import load
from fieldcal.logs import open_log
from fieldcal.logs.ulog.file import UlogFile
from fieldcal.logs.ulog.reader import READ_TOPICS
from fieldcal.logs.ulog.write import Rows, write_ulog

DURATION_S = 600


def made(path: Path) -> Path:
    """A file of a default logging profile's sizes and rates."""
    rng = np.random.default_rng(1)
    topics = []
    for name, rate_hz, width in (
        ("sensor_combined", 250, 0),
        ("vehicle_attitude", 50, 10),
        ("estimator_states", 10, 52),
    ):
        t_us = (1_000_000 + np.arange(DURATION_S * rate_hz) * (1_000_000 // rate_hz)).astype(np.uint64)
        n = len(t_us)
        columns = {"values": rng.normal(size=(n, width)).astype(np.float32)}
        if name == "sensor_combined":
            columns = {
                "gyro_rad": rng.normal(size=(n, 3)).astype(np.float32),
                "accelerometer_timestamp_relative": np.zeros(n, np.int32),
                "accelerometer_m_s2": rng.normal(size=(n, 3)).astype(np.float32),
            }
        topics.append(Rows(name, {"timestamp": t_us, **columns}))
    write_ulog(path, topics, parameters={"SYS_HITL": 0}, infos={"ver_hw": "MADE_UP"})
    return path


def with_fieldcal(path: Path) -> None:
    """All signals, as ingest does it."""
    for _ in open_log(path, load(None).vehicle("any")).batches():
        pass


def rows(path: Path, wanted: Callable[[str], bool]) -> None:
    """The rows of some topics, fields apart."""
    log = UlogFile(path, wanted)
    for topic in log.topics:
        if wanted(topic.name):
            for part in log.chunks(topic):
                assert all(part[name].size for name in part.dtype.names or ())


def best_mb_s(repeat: int, task: Callable[[Path], object], path: Path) -> float:
    """Fastest of some runs."""
    times = []
    for _ in range(repeat):
        start = time.process_time()
        task(path)
        times.append(time.process_time() - start)
    return path.stat().st_size / 1e6 / min(times)


def main() -> None:
    """Time the readers."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("files", type=Path, nargs="*")
    parser.add_argument("--repeat", type=int, default=5)
    arguments = parser.parse_args()
    print("MB/s                     size MB   all topics   chosen   signals   pyulog all   chosen")
    with tempfile.TemporaryDirectory() as folder:
        for path in arguments.files or [made(Path(folder) / "made.ulg")]:
            tasks: list[Callable[[Path], object]] = [
                lambda p: rows(p, lambda name: True),
                lambda p: rows(p, READ_TOPICS.__contains__),
                with_fieldcal,
                lambda p: ULog(str(p)),
                lambda p: ULog(str(p), sorted(READ_TOPICS)),
            ]
            a, b, c, d, e = (best_mb_s(arguments.repeat, task, path) for task in tasks)
            size = path.stat().st_size / 1e6
            print(f"{path.name:24} {size:7.1f} {a:12.0f} {b:8.0f} {c:9.0f} {d:12.0f} {e:8.0f}")


if __name__ == "__main__":
    main()
