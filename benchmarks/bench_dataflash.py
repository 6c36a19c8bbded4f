"""How fast DataFlash logs are read: located, as signals, every column of every message; pymavlink beside it. In MB/s.

Run: python benchmarks/bench_dataflash.py LOG... [--repeat 3]      without a log: one of simulated readings, 17 MB
     python benchmarks/bench_dataflash.py --damaged 2000           reads damaged inputs, prints what became of them
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np
from pymavlink import DFReader

from fieldcal.config.configuration import load
from fieldcal.logs import open_log
from fieldcal.logs.dataflash import write
from fieldcal.logs.dataflash.file import DataflashFile
from fieldcal.logs.dataflash.signals import LOCATED
from fieldcal.logs.ingest import read_flight


def write_log(path: Path, samples: int) -> None:
    """Two IMUs at 400 Hz and a magnetometer, random readings."""
    generator = np.random.default_rng(1)
    t_us = 10_000_000 + np.arange(samples) * 2500
    vectors = generator.normal(size=(4, samples, 3))
    imus = [write.imu_messages(t_us, *vectors[2 * i : 2 * i + 2], 30.0, instance=i) for i in (0, 1)]
    write.write_dataflash(path, [*imus, write.mag_messages(t_us[::40], vectors[0][::40] * 0.1)])


def located(path: Path) -> None:
    """Where every message that is read begins."""
    DataflashFile(path).locate(LOCATED)


def with_fieldcal(path: Path) -> None:
    """Signals, as ingest reads them."""
    for _ in open_log(path, load(None).vehicle("any")).batches():
        pass


def every_column(path: Path) -> None:
    """Every column of every message as an array."""
    file = DataflashFile(path)
    names = {layout.name for layout in file.layouts.values()}
    file.locate(names)
    for name in names:
        rows = file.rows(name)
        for column in rows.layout.columns if rows is not None else ():
            if rows is not None:
                rows.stored(column)


def with_pymavlink(path: Path, kinds: list[str] | None) -> None:
    """Messages as objects, one by one."""
    log = DFReader.DFReader_binary(str(path))
    while log.recv_match(type=kinds) is not None:
        pass


def seconds(repeat: int, task: Callable[[], None]) -> float:
    """Shortest of some runs."""
    times = []
    for _ in range(repeat):
        begin = time.perf_counter()
        task()
        times.append(time.perf_counter() - begin)
    return min(times)


def speeds(path: Path, repeat: int) -> None:
    """Print the speeds for one log."""
    size_mb = path.stat().st_size / 1e6
    tasks: tuple[tuple[str, int, Callable[[], None]], ...] = (
        ("fieldcal, located", repeat, lambda: located(path)),
        ("fieldcal, signals", repeat, lambda: with_fieldcal(path)),
        ("fieldcal, all columns", repeat, lambda: every_column(path)),
        ("pymavlink, messages read", 1, lambda: with_pymavlink(path, list(LOCATED))),
        ("pymavlink, all messages", 1, lambda: with_pymavlink(path, None)),
    )
    print(f"{path.name}, {size_mb:.1f} MB")
    for name, times, task in tasks:
        print(f"  {name:<26}{size_mb / seconds(times, task):8.1f} MB/s")


def damaged(inputs: int) -> None:
    """Read damaged inputs as the tests make them, and print verdicts and the longest time."""
    sys.path.append(str(Path(__file__).parents[1] / "tests"))
    from damaged_dataflash import damage
    from dataflash_support import DataflashFlight

    vehicle = load(None).vehicle("any")
    verdicts: Counter[tuple[str, str]] = Counter()
    longest = (0.0, "")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.bin"
        content = DataflashFlight(120).write(path).read_bytes()
        for seed in range(inputs):
            one = damage(content, seed)
            path.write_bytes(one.content)
            begin = time.perf_counter()
            _, facts = read_flight(path, vehicle)
            longest = max(longest, (time.perf_counter() - begin, one.places))
            if one.told and facts["verdict"] == "ok" and "truncated" not in {f["code"] for f in facts["findings"]}:
                raise SystemExit(f"not told: {one.places}")
            verdicts[one.kind, facts["verdict"]] += 1
    for (kind, verdict), count in sorted(verdicts.items()):
        print(f"{kind:<12}{verdict:<12}{count:6d}")
    print(f"longest {longest[0]:.3f} s ({longest[1]})")


def main() -> None:
    """Time the logs named, or one that is written, or read damaged inputs."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("logs", nargs="*", type=Path)
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--damaged", type=int, default=0)
    arguments = parser.parse_args()
    if arguments.damaged:
        damaged(arguments.damaged)
        return
    with tempfile.TemporaryDirectory() as folder:
        if not arguments.logs:
            write_log(Path(folder) / "simulated.bin", 160_000)
        for path in arguments.logs or [Path(folder) / "simulated.bin"]:
            speeds(path, arguments.repeat)


if __name__ == "__main__":
    main()
