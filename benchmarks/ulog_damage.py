"""What reading makes of damaged ULog files: seeded deletions, insertions, cuts and flips in message heads.

A damaged file may deliver rows of the undamaged one only. There is one exception that nothing can detect: a message
that lost or gained bytes within, and behind whose stated end a whole message happens to begin; such cases are worked
out from the damage itself and counted apart. Flips in readings cannot be seen at all, as ULog has no checksums, and are
not tried.

Run: python benchmarks/ulog_damage.py [--cases 2000] [--seed 1]
"""

from __future__ import annotations

import argparse
import collections
import contextlib
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fieldcal.config.configuration import load
from fieldcal.errors import UnreadableLog
from fieldcal.logs import read_log
from fieldcal.logs.ulog import records
from fieldcal.logs.ulog.file import UlogFile
from fieldcal.logs.ulog.write import Rows, encode

KINDS = ("cut", "delete", "insert", "repeat", "head")
INSERTED = -1
LARGEST = 6000
HEAD_BYTES = records.HEAD_BYTES
EDGES = 2
"""Messages that one place of damage may cost beside those that it touches: the one whose end is in question, and one
that the search for the next passes over."""


@dataclass(frozen=True)
class Damaged:
    """A damaged file. `origin`: where each byte was in the undamaged one, or `INSERTED`. `touched`: from, to there."""

    content: bytes
    origin: np.ndarray
    touched: tuple[int, int]


@dataclass(frozen=True)
class Judged:
    """What became of one case. `altered`: rows that the undamaged file does not have. `undetectable`: at most so many
    could not be detected. `excess`: rows that were lost beyond what the damage had to cost. `untold`: rows are missing
    without a word, where that could be detected."""

    altered: int
    undetectable: int
    excess: int
    untold: bool
    refused: bool
    seconds: float


def small_log() -> list[bytes]:
    """Head and messages of a file of 110 kB: topics of several sizes, mixed."""
    rng = np.random.default_rng(11)
    topics = []
    for number, (name, rate_hz, width) in enumerate(
        (("sensor_combined", 200, 0), ("sensor_mag", 50, 0), ("actuator_outputs", 20, 16), ("vehicle_status", 5, 40))
    ):
        t_us = (1_000_000 + np.arange(6 * rate_hz) * (1_000_000 // rate_hz) + 37 * number).astype(np.uint64)
        n = len(t_us)
        if name == "sensor_combined":
            columns = {
                "gyro_rad": rng.normal(size=(n, 3)).astype(np.float32),
                "accelerometer_timestamp_relative": np.zeros(n, np.int32),
                "accelerometer_m_s2": rng.normal(size=(n, 3)).astype(np.float32),
            }
        elif name == "sensor_mag":
            axes = {axis: rng.normal(size=n).astype(np.float32) for axis in "xyz"}
            columns = {"device_id": np.full(n, 396_809, np.uint32), **axes}
        else:
            columns = {"output": rng.normal(size=(n, width)).astype(np.float32)}
        topics.append(Rows(name, {"timestamp": t_us, **columns}))
    return encode(topics, parameters={"CAL_MAG0_ID": 396_809, "CAL_MAG0_XOFF": 0.1}, infos={"ver_hw": "MADE_UP"})


def damage(parts: list[bytes], kind: str, rng: np.random.Generator) -> Damaged:
    """The file that these parts make, damaged once."""
    content = b"".join(parts)
    origin = np.arange(len(content))
    at = int(rng.integers(len(parts[0]), len(content)))
    if kind == "cut":
        return Damaged(content[:at], origin[:at], (at, len(content)))
    if kind == "delete":
        end = min(at + int(rng.integers(1, LARGEST)), len(content))
        return Damaged(content[:at] + content[end:], np.r_[origin[:at], origin[end:]], (at, end))
    if kind in ("insert", "repeat"):
        n = int(rng.integers(1, LARGEST))
        begin = int(rng.integers(0, len(content) - n))
        extra = rng.bytes(n) if kind == "insert" else content[begin : begin + n]
        source = np.full(n, INSERTED) if kind == "insert" else origin[begin : begin + n]
        return Damaged(content[:at] + extra + content[at:], np.r_[origin[:at], source, origin[at:]], (at, at))
    starts = boundaries(parts)
    start = int(starts[rng.integers(0, len(starts) - 1)])
    place, bit = start + int(rng.integers(0, HEAD_BYTES)), int(rng.integers(0, 8))
    flipped = bytearray(content)
    flipped[place] ^= 1 << bit
    origin[place] = INSERTED
    return Damaged(bytes(flipped), origin, (place, place + 1))


def boundaries(parts: list[bytes]) -> np.ndarray:
    """Where the messages begin, and the end of the file."""
    return np.cumsum([len(part) for part in parts])


def undetectable(parts: list[bytes], damaged: Damaged) -> int:
    """Messages that are not whole though a message, or the end, stands where their heads say."""
    starts = boundaries(parts)
    sizes = {int(start): len(part) for start, part in zip(starts[:-1], parts[1:], strict=True)}
    found = 0
    for position in np.flatnonzero(np.isin(damaged.origin, starts[:-1])).tolist():
        size = sizes[int(damaged.origin[position])]
        if not _as_it_was(damaged.origin, position, HEAD_BYTES) or _as_it_was(damaged.origin, position, size):
            continue
        after = position + size
        if after == len(damaged.origin) or (after < len(damaged.origin) and int(damaged.origin[after]) in sizes):
            found += 1
    return found


def of_whole_messages(parts: list[bytes], damaged: Damaged) -> bool:
    """Whether what is left is a whole file again, so that nothing shows the damage."""
    starts = boundaries(parts)
    sizes = {int(start): len(part) for start, part in zip(starts[:-1], parts[1:], strict=True)}
    position = len(parts[0])
    while position < len(damaged.origin):
        size = sizes.get(int(damaged.origin[position]))
        if size is None or not _as_it_was(damaged.origin, position, size):
            return False
        position += size
    return True


def rows_of(path: Path) -> tuple[collections.Counter[tuple[str, bytes]], UlogFile]:
    """Every row by its topic and bytes."""
    log = UlogFile(path)
    counted: collections.Counter[tuple[str, bytes]] = collections.Counter()
    for topic in log.topics:
        for rows in log.chunks(topic):
            counted.update((topic.name, row.tobytes()) for row in rows)
    return counted, log


def judge(parts: list[bytes], damaged: Damaged, sound: collections.Counter[tuple[str, bytes]], path: Path) -> Judged:
    """Read a damaged file by every way."""
    path.write_bytes(damaged.content)
    begin = time.process_time()
    try:
        rows, log = rows_of(path)
    except UnreadableLog:
        return Judged(0, 0, 0, False, True, time.process_time() - begin)
    with contextlib.suppress(UnreadableLog):
        read_log(path, load(None).vehicle("v"))
    seconds = time.process_time() - begin
    altered = sum(count for key, count in rows.items() if key not in sound)
    missing = sum((sound - rows).values())
    starts = boundaries(parts)
    data = np.array([part[2] == records.DATA for part in parts[1:]])
    ends = starts[1:]
    low, high = damaged.touched
    hit = (starts[:-1] < max(high, low + 1)) & (ends > low)
    in_definitions = bool((hit & ~data).any())
    excess = 0 if in_definitions else missing - int(np.count_nonzero(hit & data)) - EDGES
    possible = undetectable(parts, damaged)
    told = bool(log.losses.places or log.losses.cut_bytes or log.unknown_messages)
    untold = missing > 0 and not told and not possible and not of_whole_messages(parts, damaged)
    return Judged(altered, possible, excess, untold, False, seconds)


def case(parts: list[bytes], seed: int) -> Damaged:
    """The damaged file of a seed."""
    return damage(parts, KINDS[seed % len(KINDS)], np.random.default_rng(seed))


def _as_it_was(origin: np.ndarray, position: int, size: int) -> bool:
    own = origin[position : position + size]
    return len(own) == size and int(own[0]) >= 0 and bool((np.diff(own) == 1).all())


def main() -> None:
    """Judge many cases; the exit code is 1 where one is wrong."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    parts = small_log()
    wrong, altered, possible, refused, longest = [], 0, 0, 0, 0.0
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "f.ulg"
        path.write_bytes(b"".join(parts))
        sound, _ = rows_of(path)
        for seed in range(arguments.seed, arguments.seed + arguments.cases):
            judged = judge(parts, case(parts, seed), sound, path)
            altered, possible = altered + judged.altered, possible + judged.undetectable
            refused, longest = refused + judged.refused, max(longest, judged.seconds)
            if judged.altered > judged.undetectable or judged.excess > 0 or judged.untold:
                wrong.append(seed)
                print(KINDS[seed % len(KINDS)], seed, judged)
    print(f"{arguments.cases} damaged files of {sum(map(len, parts))} bytes, {refused} refused, {len(wrong)} wrong")
    print(f"{altered} rows mixed of two messages were read, where {possible} could not be told from whole ones")
    print(f"longest {longest:.3f} s of processor time")
    raise SystemExit(bool(wrong))


if __name__ == "__main__":
    main()
