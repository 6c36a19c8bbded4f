"""A multi-gigabyte MCAP log through ingest: how much memory, how long, and is every message there.

    python benchmarks/large_log.py [GIGABYTES] [KIND]

KIND "camera" (default): an inertial unit at 200 Hz beside raw images that do not compress, as a vehicle with a camera
records it. "inertial": inertial messages alone, uncompressed: as many rows as the bytes hold. The log is written to a
temporary folder, ingested by a process of its own into a warehouse beside it, and removed.
"""

from __future__ import annotations

import json
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from mcap.writer import CompressionType, Writer

from fieldcal.logs.mcap.write import encode_cdr, imu_channel, magnetic_field_channel

START_NS = 1_767_225_600_000_000_000
RATE_HZ = 200
IMAGE_BYTES = 1 << 20
BATCH = 20_000
REPOSITORY = Path(__file__).resolve().parent.parent


def write_log(path: Path, size: int, kind: str) -> int:
    """Write a log of `size` bytes; how many inertial messages it holds."""
    rng = np.random.default_rng(1)
    written = 0
    compression = CompressionType.ZSTD if kind == "camera" else CompressionType.NONE
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=4 << 20, compression=compression)
        writer.start("ros2", "benchmark")
        image_schema = writer.register_schema("benchmark/msg/Blob", "ros2msg", b"uint8[] data")
        image = writer.register_channel("/camera/raw", "cdr", image_schema)
        ids: dict[str, int] = {}
        while stream.tell() < size:
            t = START_NS + (written + np.arange(BATCH)) * (1_000_000_000 // RATE_HZ)
            x = rng.normal(size=(3, BATCH, 3))
            channels = [imu_channel(t, None, x[0], x[1]), magnetic_field_channel(t, None, x[2])]
            payloads = []
            for channel in channels:
                if channel.topic not in ids:
                    schema = writer.register_schema(channel.schema_name, "ros2msg", channel.schema_text.encode())
                    ids[channel.topic] = writer.register_channel(channel.topic, "cdr", schema)
                payloads.append((ids[channel.topic], encode_cdr(channel)))
            for row, stamp in enumerate(t.tolist()):
                if kind == "camera" and row % (RATE_HZ // 20) == 0:
                    writer.add_message(image, stamp, rng.bytes(IMAGE_BYTES), stamp)
                for channel_id, payload in payloads:
                    writer.add_message(channel_id, stamp, payload[row].tobytes(), stamp)
                written += 1
                if stream.tell() >= size:
                    break
        writer.finish()
    return written


def ingest(path: Path, root: Path) -> None:
    """Ingest a log and print what it took."""
    from fieldcal.batch.steps import FlightWork
    from fieldcal.config.configuration import load
    from fieldcal.flight.job import Job, file_stamp

    start = time.perf_counter()
    job = Job(str(path), path.name, "large", "s", "mcap", "0" * 64, "large", file_stamp(path))
    record = FlightWork(root, job, load(None).vehicle("large")).run("ingest")
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    # Pages of the mapped file count while they are resident, though the system may drop them at any moment.
    status = Path("/proc/self/status").read_text().splitlines()
    mapped_mb = sum(int(line.split()[1]) for line in status if line.startswith("RssFile")) / 1024
    print(
        json.dumps(
            {
                "verdict": record["facts"]["verdict"],
                "reason": record["facts"]["reason"],
                "rows": record["facts"]["rows"],
                "peak_mb": round(peak_mb),
                "mapped_mb_at_the_end": round(mapped_mb),
                "seconds": round(time.perf_counter() - start, 1),
            }
        )
    )


def main(gigabytes: float = 2.0, kind: str = "camera") -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "large.mcap"
        written = write_log(path, int(gigabytes * 1e9), kind)
        print(f"{kind}: {path.stat().st_size / 1e9:.2f} GB, {written} inertial messages")
        command = [sys.executable, __file__, "--ingest", str(path), str(Path(folder) / "root")]
        done = subprocess.run(command, capture_output=True, text=True, cwd=REPOSITORY, check=True)
        found = json.loads(done.stdout)
        print(found)
        if found["rows"] != {"imu": written, "magnetometer": written}:
            raise SystemExit("messages are missing")


if __name__ == "__main__":
    if sys.argv[1:2] == ["--ingest"]:
        ingest(Path(sys.argv[2]), Path(sys.argv[3]))
    else:
        main(*(float(text) for text in sys.argv[1:2]), *sys.argv[2:3])
