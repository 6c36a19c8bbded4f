"""How fast MCAP logs are decoded: floor (read, decompress, CRC), fieldcal, mcap_ros2. Prints seconds and ratios.

Run: python benchmarks/bench_mcap_decode.py [--messages 120000] [--repeat 5]
"""

from __future__ import annotations

import argparse
import tempfile
import time
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import zstandard
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from fieldcal.config.configuration import load
from fieldcal.logs import open_log
from fieldcal.logs.mcap.file import McapFile
from fieldcal.logs.mcap.records import CHUNK, HEAD_BYTES, MAGIC, Fields, read_chunk_head, read_record
from fieldcal.logs.mcap.write import imu_channel, write_mcap

CHUNK_BYTES = 1 << 20


def write_log(path: Path, messages: int) -> None:
    """An Imu log of random readings at 400 Hz."""
    generator = np.random.default_rng(1)
    t_ns = 1_700_000_000_000_000_000 + np.arange(messages) * 2_500_000
    readings = generator.normal(size=(2, messages, 3)).astype(np.float32).astype(np.float64)
    write_mcap(path, [imu_channel(t_ns, t_ns + 450_000, *readings)], chunk_size=CHUNK_BYTES)


def floor(path: Path) -> int:
    """Read the file, decompress every chunk, check its CRC."""
    content = path.read_bytes()
    decompressor = zstandard.ZstdDecompressor()
    position, total = len(MAGIC), 0
    while position + HEAD_BYTES < len(content):
        record = read_record(content, position, len(content))
        if record.opcode == CHUNK:
            head = read_chunk_head(Fields(content, record.body, record.end))
            records = decompressor.decompress(content[head.start : head.end])
            if zlib.crc32(records) != head.crc:
                raise SystemExit("the file written for the benchmark is damaged")
            total += len(records)
        position = record.end
        if position == len(content) - len(MAGIC):
            break
    return total


def with_fieldcal(path: Path) -> int:
    """Every message as columns, as ingest does it."""
    reader = open_log(path, load(None).vehicle("any"))
    return sum(len(columns["t_ns"]) for _, columns in reader.batches())


def located(path: Path) -> int:
    """The walk through the file alone: blocks of located messages, nothing decoded."""
    return sum(len(block.starts) for block in McapFile(path).blocks())


def with_mcap_ros2(path: Path) -> int:
    """Every message as an object, one by one."""
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        return sum(1 for _ in reader.iter_decoded_messages())


def best_of(repeat: int, task: Callable[[Path], int], path: Path) -> float:
    """Shortest of some runs, in seconds."""
    times = []
    for _ in range(repeat):
        start = time.perf_counter()
        task(path)
        times.append(time.perf_counter() - start)
    return min(times)


def main() -> None:
    """Write a log, time the readers, print the ratios."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--messages", type=int, default=120_000)
    parser.add_argument("--repeat", type=int, default=5)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "imu.mcap"
        write_log(path, arguments.messages)
        floor_s = best_of(arguments.repeat, floor, path)
        walk_s = best_of(arguments.repeat, located, path)
        ours_s = best_of(arguments.repeat, with_fieldcal, path)
        objects_s = best_of(1, with_mcap_ros2, path)
        size_mb = path.stat().st_size / 1e6
    print(f"{arguments.messages} sensor_msgs/Imu messages, {size_mb:.1f} MB, zstd, best of {arguments.repeat}")
    print(f"floor (read, decompress, CRC)  {floor_s:8.4f} s")
    print(f"fieldcal, messages located     {walk_s:8.4f} s   {walk_s / floor_s:5.2f} x floor")
    print(f"fieldcal, columns              {ours_s:8.4f} s   {ours_s / floor_s:5.2f} x floor   (bar: 4)")
    print(f"mcap_ros2, objects             {objects_s:8.4f} s   {objects_s / ours_s:5.1f} x fieldcal (bar: 30)")


if __name__ == "__main__":
    main()
