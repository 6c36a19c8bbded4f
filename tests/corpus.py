"""Reads every generated log as the night does and tells what became of it, one JSON line a log.

`python tests/corpus.py mcap|csv FOLDER` is run in a process of its own, whose peak of memory bounds that of each log.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import damaged_csv
import damaged_mcap
import numpy as np
import polars as pl
from logs_support import Flight, vehicle

from fieldcal.logs.ingest import read_flight

SAMPLES = 400
CHUNK_BYTES = 30_000
LOG_TIME_OFFSET_NS = {"imu": 450_000, "magnetometer": 450_001, "temperature": 450_002, "vps": 4_800_000 - 7}
TABLES = {"/imu/data_raw": "imu", "/imu/mag": "magnetometer", "/imu/temperature": "temperature", "/vps/pose": "vps"}
Rows = set[tuple[str, int]]


class Truth:
    """The sound MCAP file, and what its chunks hold as (signal table, stamp)."""

    def __init__(self, folder: Path, samples: int = SAMPLES, chunk_bytes: int = CHUNK_BYTES) -> None:
        self.flight = Flight(samples)
        self.sound = self.flight.write(folder / "sound.mcap", chunk_size=chunk_bytes).read_bytes()
        self.chunks = []
        for place, held in zip(
            damaged_mcap.chunks(self.sound), damaged_mcap.messages_of_chunks(self.sound), strict=True
        ):
            rows = {(TABLES[topic], log_time - LOG_TIME_OFFSET_NS[TABLES[topic]]) for topic, log_time in held}
            self.chunks.append((self.sound[place.start : place.end], rows))
        self.every: Rows = set().union(*(rows for _, rows in self.chunks))

    def intact(self, content: bytes) -> Rows:
        """Rows of the chunks that a damaged file still holds byte by byte."""
        return set().union(*(rows for chunk, rows in self.chunks if chunk in content))

    def altered(self, tables: dict[str, pl.DataFrame]) -> int:
        """Delivered rows that are no rows of the flight, and those delivered twice."""
        flight = self.flight
        truths = {
            "imu": np.column_stack([flight.gyroscope, flight.accelerometer]),
            "magnetometer": flight.magnetometer,
            "temperature": flight.temperature[:, None],
            "vps": np.column_stack([flight.quaternion, flight.position]),
        }
        wrong = 0
        for table, frame in tables.items():
            stamps = flight.t_ns + (7 if table == "vps" else 0)
            t = frame["t_ns"].to_numpy()
            place = np.clip(np.searchsorted(stamps, t), 0, len(stamps) - 1)
            same = (stamps[place] == t) & (frame.drop("t_ns").to_numpy() == truths[table][place]).all(axis=1)
            wrong += int((~same).sum()) + len(t) - len(np.unique(t))
        return wrong


def peak_mb() -> float:
    """Peak of this process's own memory. (`ru_maxrss` counts that of the process which started it, too.)"""
    (line,) = [line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM:")]
    return float(line.split()[1]) / 1024


def delivered(tables: dict[str, pl.DataFrame]) -> Rows:
    return {(table, t) for table, frame in tables.items() for t in frame["t_ns"].to_list()}


def read_mcap(path: Path, truth: Truth, content: bytes, whole: bool) -> dict[str, Any]:
    """What became of one damaged file."""
    path.write_bytes(content)
    tables, facts = read_flight(path, vehicle())
    wanted = truth.every if whole else truth.intact(content)
    rows = delivered(tables)
    return {
        "verdict": facts["verdict"],
        "reason_code": facts["reason_code"],
        "reason": facts["reason"],
        "verifiable": facts["verifiable"],
        "findings": [finding["code"] for finding in facts["findings"]],
        "not_recovered": len(wanted - rows),
        "missing": len(truth.every - rows),
        "altered": truth.altered(tables),
    }


def mcap_outcomes(folder: Path) -> Iterator[dict[str, Any]]:
    truth = Truth(folder)
    for kind in damaged_mcap.damaged_files(truth.sound):
        start = time.process_time()
        outcome = read_mcap(folder / "log.mcap", truth, kind.content, kind.whole)
        yield {
            "name": kind.name,
            "bytes": len(kind.content),
            "verdicts": kind.verdicts,
            "checked": kind.checked,
            **outcome,
            "seconds": time.process_time() - start,
        }


def csv_outcomes(folder: Path) -> Iterator[dict[str, Any]]:
    table = damaged_csv.Table()
    for kind in damaged_csv.written_files(table):
        path = folder / "log.csv"
        path.write_bytes(kind.content)
        start = time.process_time()
        tables, facts = read_flight(path, vehicle(csv=kind.csv))
        rows: list[int] = []
        altered = 0
        if kind.rows is not None and "imu" in tables:
            rows = (tables["imu"]["t_ns"].to_numpy() // damaged_csv.STEP_NS).tolist()
            values = table.values[np.clip(rows, 0, damaged_csv.ROWS - 1)]
            altered = int((tables["imu"].drop("t_ns").to_numpy() != values).any(axis=1).sum())
        yield {
            "name": kind.name,
            "bytes": len(kind.content),
            "verdicts": kind.verdicts,
            "verdict": facts["verdict"],
            "reason_code": facts["reason_code"],
            "reason": facts["reason"],
            "said": " ".join([*(finding["sentence"] for finding in facts["findings"]), facts["reason"] or ""]),
            "must_say": kind.says,
            "rows_wanted": kind.rows,
            "rows": rows,
            "altered": altered,
            "seconds": time.process_time() - start,
        }


def main(kind: str, folder: Path) -> None:
    for outcome in (mcap_outcomes if kind == "mcap" else csv_outcomes)(folder):
        print(json.dumps(outcome))
    print(json.dumps({"peak_mb": peak_mb()}))


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]))
