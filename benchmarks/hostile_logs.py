"""What `fieldcal.read_log` makes of hostile CSV and MCAP files: each must be read, or refused in a sentence, in bounds.

    python benchmarks/hostile_logs.py [--cases 5000] [--seed 1] [--only NUMBER] [--keep FOLDER]

Every second case is a CSV, every other an MCAP. A case is a function of its seed and number: a small sound file (nine
of them), then one to three kinds of harm. Bytes: flips, cuts, deletions, splices with another file, repeated and
shuffled blocks, runs of NUL, huge numbers where lengths and counts stand. CSV: extreme cells, absurd stamps, other
encodings, floods of columns, comments and quotes. MCAP: chunks that were changed within and whose CRC holds, absurd
stamps, hostile schemas and JSON, bombs.

A process of its own reads, one file after another, and is replaced after `READS` or when it dies. It has `SECONDS` for
a file, by the wall clock, and an address space of `MEMORY_MB` beyond what it has once it has read two sound files.
Anything but a `FieldcalError` or a recording with a verdict is a fall: another exception, a process that dies, a file
that takes longer. The process runs on one thread, so that stacks of threads do not count.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import select
import struct
import subprocess
import sys
import tempfile
import time
import zlib
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import lz4.frame
import numpy as np
import zstandard

SECONDS = 10.0
MEMORY_MB = 512
READS = 250
ONE_THREAD = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "POLARS_MAX_THREADS", "RAYON_NUM_THREADS", "MALLOC_ARENA_MAX"), "1"
)
MAGIC, CHUNK, HEAD = b"\x89MCAP0\r\n", 0x06, 9
HUGE = (0, 1, 0x7FFF_FFFF, 0xFFFF_FFFF, 1 << 40, (1 << 63) - 1, (1 << 64) - 1)
NUMBERS = (
    *("nan", "inf", "-inf", "1e308", "-1e308", "1e309", "1e-400", "-0", "0x1p3", "1_000", "+.5", ".", "-", "e", "1e"),
    *(
        "",
        " ",
        "NULL",
        "=1+1",
        "１２",
        "1,5",
        "1.2.3",
        "9" * 400,
        "1e999999999",
        "0." + "0" * 5000 + "1",
        "True",
        "\x00",
    ),
    *("9223372036854775807", "-9223372036854775809", "18446744073709551616", "1e19", "1e-9"),
)
STAMPS = (
    *("0", "-1", "1e300", "9223372036854775807", "99999999999999999999", "nan", "", "0001-01-01T00:00:00", "1e18"),
    *("9999-12-31T23:59:59.999999999Z", "2026-02-30 25:61:61", "12:00:00 PM", "1970", "-9e18", "1e-12", "T", "24:00"),
)
JSONS = (
    b"[" * 100_000,
    b'{"a":' * 50_000 + b"1" + b"}" * 50_000,
    b'{"header":' + b"9" * 100_000 + b"}",
    b'{"angular_velocity":{"x":1e999,"y":NaN,"z":-Infinity}}',
    b'{"header":{"stamp":{"sec":1e300,"nanosec":-1}},"angular_velocity":[1,[2,[3]]]}',
    b'{"header":{"stamp":{"sec":"\\ud800","nanosec":{}}}}',
    b'{"a":1,' * 30_000,
    b"\xff\xfe{\x00}\x00",
    b"null",
    b"",
)
SCHEMAS = (
    b"float64[4294967295] x",
    b"fieldcal_msgs/RawImu again",
    b"uint8[999999999999999999999] x",
    b"string" + b" s\nstring" * 20_000,
    b"float64[<=9999999] x\n" * 500,
    b"\x00\xff\xfe",
    b"===\nMSG: a/b\n" * 5000,
    b"std_msgs/Header header\n" * 2000,
    b"float64[3",
    b"",
)

Rng = np.random.Generator
Harm = Callable[[bytes, Rng], bytes]


def between(rng: Rng, low: int, high: int) -> int:
    """A whole number of [low, high), more often a small one."""
    return int(low + (high - low) * rng.random() ** 2) if high > low else low


# --- bytes


def flipped(data: bytes, rng: Rng) -> bytes:
    changed = bytearray(data)
    for _ in range(between(rng, 1, 400)):
        changed[rng.integers(len(changed))] ^= 1 << int(rng.integers(8))
    return bytes(changed)


def cut(data: bytes, rng: Rng) -> bytes:
    return data[: rng.integers(len(data))]


def lacking(data: bytes, rng: Rng) -> bytes:
    at = int(rng.integers(len(data)))
    return data[:at] + data[at + between(rng, 1, len(data)) :]


def spliced(data: bytes, rng: Rng) -> bytes:
    """Two halves of it, the second from elsewhere in it."""
    return data[: rng.integers(len(data))] + data[rng.integers(len(data)) :]


def repeated(data: bytes, rng: Rng) -> bytes:
    at, size = int(rng.integers(len(data))), between(rng, 1, 20_000)
    return data[:at] + data[at : at + size] * between(rng, 2, 60) + data[at:]


def shuffled(data: bytes, rng: Rng) -> bytes:
    size = between(rng, 16, 8000)
    blocks = [data[at : at + size] for at in range(0, len(data), size)]
    return b"".join(blocks[i] for i in rng.permutation(len(blocks)))


def nuls(data: bytes, rng: Rng) -> bytes:
    at = int(rng.integers(len(data)))
    return data[:at] + bytes(between(rng, 1, 300_000)) + data[at:]


def noise(data: bytes, rng: Rng) -> bytes:
    at = int(rng.integers(len(data)))
    return data[:at] + rng.bytes(between(rng, 1, 50_000)) + data[at:]


def huge_numbers(data: bytes, rng: Rng) -> bytes:
    """Numbers that may stand where a length or a count is."""
    changed = bytearray(data)
    for _ in range(between(rng, 1, 40)):
        at, (form, size) = int(rng.integers(len(data))), (("<I", 4), ("<Q", 8))[int(rng.integers(2))]
        if at + size <= len(changed):
            struct.pack_into(form, changed, at, int(rng.choice(np.array(HUGE, object))) & ((1 << 8 * size) - 1))
    return bytes(changed)


BYTES: dict[str, Harm] = {
    harm.__name__: harm for harm in (flipped, cut, lacking, spliced, repeated, shuffled, nuls, noise, huge_numbers)
}


# --- CSV


def _lines(data: bytes) -> list[bytes]:
    return data.split(b"\n")


def _cells(data: bytes, rng: Rng, values: tuple[str, ...], column: int | None, most: int) -> bytes:
    lines = _lines(data)
    for _ in range(between(rng, 1, most)):
        row = int(rng.integers(len(lines)))
        cells = lines[row].split(b",")
        cells[int(rng.integers(len(cells))) if column is None else column] = values[
            int(rng.integers(len(values)))
        ].encode()
        lines[row] = b",".join(cells)
    return b"\n".join(lines)


def extreme_cells(data: bytes, rng: Rng) -> bytes:
    return _cells(data, rng, NUMBERS, None, 500)


def absurd_stamps(data: bytes, rng: Rng) -> bytes:
    return _cells(data, rng, STAMPS, 0, 800)


def long_cell(data: bytes, rng: Rng) -> bytes:
    text = [b"9", b"1e", b"-", b".", b"a", b'"', b"\xc3"][int(rng.integers(7))] * between(rng, 1, 1_500_000)
    lines = _lines(data)
    lines[int(rng.integers(len(lines)))] += b"," + text
    return b"\n".join(lines)


def other_encoding(data: bytes, rng: Rng) -> bytes:
    text = data.decode("utf-8", "replace")
    names = ("utf-16", "utf-16-be", "utf-32", "utf-8-sig", "utf-7", "cp037", "latin-1", "shift-jis")
    encoded = text.encode(names[int(rng.integers(len(names)))], "replace")
    return encoded if rng.random() < 0.7 else data[: len(data) // 2] + encoded


def other_dialect(data: bytes, rng: Rng) -> bytes:
    separator = [b";", b"\t", b" ", b"|", b"\x00", b":", b",,", b"\xc2\xa0"][int(rng.integers(8))]
    end = [b"\n", b"\r", b"\r\n", b"\n\r", b"\x85", b"\n\n"][int(rng.integers(6))]
    changed = data.replace(b",", separator).replace(b"\n", end)
    return changed.replace(b".", b",") if rng.random() < 0.5 else changed


def quotes(data: bytes, rng: Rng) -> bytes:
    changed = bytearray(data)
    for _ in range(between(rng, 1, 3000)):
        changed[int(rng.integers(len(changed)))] = b"\"'`\\"[int(rng.integers(4))]
    return bytes(changed)


def hostile_header(data: bytes, rng: Rng) -> bytes:
    lines, header = _lines(data), _lines(data)[0].split(b",")
    many = between(rng, 1, 30_000)
    lines[0] = [
        b",".join([header[-1]] * len(header)),
        b",".join(header + header),
        b",".join(header + [b"x%d" % i for i in range(many)]),
        b"," * many,
        b",".join(name * 3000 for name in header),
        b",".join(b"\x1b[2J" + name for name in header),
        b",".join(header[::-1]),
        b"",
    ][int(rng.integers(8))]
    return b"\n".join(lines)


def flood(data: bytes, rng: Rng) -> bytes:
    piece = [b"#\n", b"\n", b",\n", b'"\n', b"# t,gx\n", b"t,gx,gy\n", b"1\n", b" \t\n", b"//\n"][int(rng.integers(9))]
    lines = _lines(data)
    at = int(rng.integers(len(lines)))
    return b"\n".join(lines[:at]) + b"\n" + piece * between(rng, 1, 400_000) + b"\n".join(lines[at:])


def wide_rows(data: bytes, rng: Rng) -> bytes:
    lines = _lines(data)
    for _ in range(between(rng, 1, 20)):
        lines[int(rng.integers(len(lines)))] += b",1" * between(rng, 1, 60_000)
    return b"\n".join(lines)


CSV: dict[str, Harm] = BYTES | {
    harm.__name__: harm
    for harm in (
        *(extreme_cells, absurd_stamps, long_cell, other_encoding, other_dialect, quotes, hostile_header, flood),
        wide_rows,
    )
}


# --- MCAP


def record(opcode: int, body: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(body)) + body


def text(content: bytes) -> bytes:
    return struct.pack("<I", len(content)) + content


def chunk(records: bytes, compression: str, declared: int | None = None) -> bytes:
    """A chunk whose CRC holds."""
    packed = {"": records, "zstd": zstandard.compress(records), "lz4": lz4.frame.compress(records)}[compression]
    size = len(records) if declared is None else declared
    head = struct.pack("<QQQI", 1, 1 << 60, size, zlib.crc32(records))
    return record(CHUNK, head + text(compression.encode()) + struct.pack("<Q", len(packed)) + packed)


def parts(data: bytes) -> list[tuple[int, bytes]]:
    """Opcode and body of the records of a sound file; of a damaged one as far as they go."""
    found, at = [], len(MAGIC)
    while at + HEAD <= len(data):
        opcode, size = struct.unpack_from("<BQ", data, at)
        found.append((opcode, data[at + HEAD : at + HEAD + size]))
        at += HEAD + size
    return found


def within(data: bytes, rng: Rng, change: Harm) -> bytes:
    """Change what some chunks hold, and pack them so that their CRC holds."""
    result = [MAGIC]
    for opcode, body in parts(data):
        if opcode != CHUNK or rng.random() < 0.5:
            result.append(record(opcode, body))
            continue
        try:
            size = struct.unpack_from("<I", body, 28)[0]
            name, packed = body[32 : 32 + size].decode(), body[40 + size :]
            unpack = {"": bytes, "zstd": zstandard.ZstdDecompressor().decompressobj().decompress}
            records = {**unpack, "lz4": lz4.frame.decompress}[name](packed)
            result.append(chunk(change(records, rng), name))
        except (KeyError, ValueError, RuntimeError, struct.error, zstandard.ZstdError):  # harmed before
            result.append(record(opcode, body))
    return b"".join(result) + MAGIC


def harm_within(data: bytes, rng: Rng) -> bytes:
    return within(data, rng, BYTES[str(rng.choice(list(BYTES)))])


def absurd_times(data: bytes, rng: Rng) -> bytes:
    """Log times, and the first bytes of payloads, where stamps are."""

    def change(records: bytes, rng: Rng) -> bytes:
        changed, at = bytearray(records), 0
        while at + HEAD + 40 <= len(changed):
            opcode, size = struct.unpack_from("<BQ", changed, at)
            if opcode == 0x05 and rng.random() < 0.2:
                where = at + HEAD + (6, 14, 22, 26, 30)[int(rng.integers(5))]
                struct.pack_into("<Q", changed, where, int(rng.choice(np.array(HUGE, object))))
            at += HEAD + size
        return bytes(changed)

    return within(data, rng, change)


def _with(data: bytes, extra: bytes, rng: Rng) -> bytes:
    """Records put between those of a file."""
    kept = [record(opcode, body) for opcode, body in parts(data)]
    kept.insert(between(rng, 0, len(kept)), extra)
    return MAGIC + b"".join(kept) + MAGIC


def _messages(rng: Rng, payload: bytes, count: int, encoding: bytes, definition: bytes, kind: bytes) -> bytes:
    schema = record(0x03, struct.pack("<H", 77) + text(kind) + text(encoding) + text(definition))
    how = b"json" if encoding == b"jsonschema" else b"cdr"
    channel = record(0x04, struct.pack("<HH", 77, 77) + text(b"/imu/data_raw") + text(how) + text(b""))
    messages = [
        record(0x05, struct.pack("<HIQQ", 77, i, 10**9 + i * 5_000_000, 10**9 + i * 5_000_000) + payload)
        for i in range(count)
    ]
    return schema + channel + b"".join(messages)


def hostile_json(data: bytes, rng: Rng) -> bytes:
    payload = JSONS[int(rng.integers(len(JSONS)))]
    count = between(rng, 1, max(2, 2_000_000 // (len(payload) + 30)))
    kind = [b"sensor_msgs/msg/Imu", b"fieldcal_msgs/msg/RawImu", b"x" * 10_000][int(rng.integers(3))]
    return _with(data, chunk(_messages(rng, payload, count, b"jsonschema", b"{}", kind), "zstd"), rng)


def hostile_schema(data: bytes, rng: Rng) -> bytes:
    definition = SCHEMAS[int(rng.integers(len(SCHEMAS)))]
    kind = [b"sensor_msgs/msg/Imu", b"fieldcal_msgs/msg/RawImu", b"a/msg/b"][int(rng.integers(3))]
    payload = rng.bytes(between(rng, 0, 400))
    encoding = [b"ros2msg", b"protobuf", b"ros2idl", b"\xff"][int(rng.integers(4))]
    return _with(data, chunk(_messages(rng, payload, between(rng, 1, 500), encoding, definition, kind), "lz4"), rng)


def bomb(data: bytes, rng: Rng) -> bytes:
    """Megabytes that pack to next to nothing: zeros, or messages that are all alike."""
    kind = int(rng.integers(4))
    size = between(rng, 1 << 20, 160 << 20)
    if kind == 0:
        return _with(data, chunk(bytes(size), ("zstd", "lz4")[int(rng.integers(2))]), rng)
    if kind == 1:
        said = b'{"header":{"stamp":{"sec":1,"nanosec":2}},"angular_velocity":{"x":1,"y":1,"z":1},"pad":"'
        messages = _messages(rng, said + b" " * (size // 100) + b'"}', 90, b"jsonschema", b"{}", b"sensor_msgs/msg/Imu")
        return _with(data, chunk(messages, "zstd"), rng)
    if kind == 2:
        one = _messages(rng, bytes(320), 1, b"ros2msg", b"float64 x", b"a/msg/b")
        return _with(data, chunk(one * (size // (len(one) * 8)), "zstd"), rng)
    return _with(data, chunk(bytes(1000), "zstd", declared=int(rng.choice(np.array(HUGE, object)))), rng)


def many_channels(data: bytes, rng: Rng) -> bytes:
    count = between(rng, 10, 65_000)
    made = [record(0x04, struct.pack("<HH", i, 0) + text(b"/t%d" % i) + text(b"cdr") + text(b"")) for i in range(count)]
    return _with(data, b"".join(made), rng)


MCAP: dict[str, Harm] = BYTES | {
    harm.__name__: harm for harm in (harm_within, absurd_times, hostile_json, hostile_schema, bomb, many_channels)
}


# --- cases


@dataclass(frozen=True)
class Sound:
    """Files that nothing is wrong with, small."""

    csv: tuple[bytes, ...]
    mcap: tuple[bytes, ...]


def sound_files() -> Sound:
    """A hundred to a thousand rows each, in the forms that each reader knows."""
    from fieldcal.logs.mcap.write import imu_channel, magnetic_field_channel, pose_channel, raw_imu_channel, write_mcap

    rng = np.random.default_rng(5)
    n = 600
    t_ns = 1_780_000_000_000_000_000 + np.arange(n) * 5_000_000
    triads = rng.normal(size=(3, n, 3)).round(5)
    triads[1] += (0.0, 0.0, 9.8)
    quaternion = np.tile([0.0, 0.0, 0.0, 1.0], (n, 1))
    names = ["t", "gx", "gy", "gz", "ax", "ay", "az", "mx", "my", "mz"]

    def table(stamps: list[str], header: list[str]) -> bytes:
        rows = [",".join([t, *map(str, triads[:, i].ravel())]) for i, t in enumerate(stamps)]
        return "\n".join([",".join(header), *rows, ""]).encode()

    seconds = [f"{(t - t_ns[0]) / 1e9:.6f}" for t in t_ns.tolist()]
    dated = [str(np.datetime64(t, "ns")) for t in t_ns.tolist()]
    csv = (
        table(seconds, names),
        table([str(t) for t in t_ns.tolist()], ["timestamp_ns", *names[1:]]),
        table(dated, ["time", *names[1:]]),
        b"# made for harm\n" + table(seconds, ["time [s]", *(f"{name} [rad/s]" for name in names[1:])]),
    )
    written = []
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "log.mcap")
        usual = [
            imu_channel(t_ns, None, triads[0], triads[1]),
            magnetic_field_channel(t_ns, None, triads[2]),
            pose_channel(t_ns, None, quaternion, triads[2]),
        ]
        raw = [raw_imu_channel(t_ns, None, *triads, np.full(n, 20.0))]
        for channels, compression, encoding in (
            (usual, "zstd", "cdr"),
            (usual, "lz4", "cdr"),
            (usual, "none", "json"),
            (raw, "zstd", "cdr"),
            (raw, "zstd", "json"),
        ):
            write_mcap(path, channels, compression=compression, encoding=encoding, chunk_size=20_000)
            written.append(path.read_bytes())
    return Sound(csv, tuple(written))


def hostile(number: int, seed: int, sound: Sound) -> tuple[str, list[str], bytes]:
    """Name of the file, the kinds of harm, and the content of one case."""
    rng = np.random.default_rng([seed, number])
    kind, kinds = ("csv", CSV) if number % 2 else ("mcap", MCAP)
    files = sound.csv if number % 2 else sound.mcap
    data = files[int(rng.integers(len(files)))]
    done = []
    for _ in range(between(rng, 1, 4)):
        name = str(rng.choice(list(kinds)))
        done.append(name)
        data = kinds[name](data, rng) or b"\n"
    return f"log.{kind}", done, data


# --- the process that reads


def reader(warm: list[str]) -> None:
    """Read the files whose names come on standard input; a line of JSON about each."""
    import fieldcal
    from fieldcal.names import Verdict

    for path in warm:
        fieldcal.read_log(path)
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
    most = pages * resource.getpagesize() + (MEMORY_MB << 20)
    resource.setrlimit(resource.RLIMIT_AS, (most, most))
    print("ready", flush=True)
    for line in sys.stdin:
        began = time.process_time()
        try:
            recording = fieldcal.read_log(line.rstrip("\n"))
            told = recording.verdict if recording.verdict in list(Verdict) else f"fall: verdict {recording.verdict}"
            del recording
        except fieldcal.FieldcalError as error:
            told = f"refused: {error.reason_code}"
        except BaseException as error:
            told = f"fall: {type(error).__name__}: {str(error)[:300]}"
        print(json.dumps([told, time.process_time() - began]), flush=True)


class Reader:
    """The process, replaced when it is needed."""

    def __init__(self, warm: list[Path]) -> None:
        self._warm = [str(path) for path in warm]
        self._process: subprocess.Popen[str] | None = None
        self._reads = 0

    def read(self, path: Path) -> tuple[str, float]:
        """What became of a file, and the seconds of the wall clock that it took."""
        if self._process is None or self._reads >= READS:
            self.end()
            self._process = subprocess.Popen(
                [sys.executable, __file__, "--reader", *self._warm],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
                env={**os.environ, **ONE_THREAD},
            )
            assert self._process.stdout is not None
            assert self._process.stdout.readline() == "ready\n"
            self._reads = 0
        process = self._process
        assert process.stdin is not None
        assert process.stdout is not None
        self._reads += 1
        began = time.monotonic()
        process.stdin.write(f"{path}\n")
        process.stdin.flush()
        told = process.stdout.readline() if select.select([process.stdout], [], [], SECONDS)[0] else None
        took = time.monotonic() - began
        if not told:
            process.kill()
            self._process = None
            return f"fall: more than {SECONDS:g} s" if told is None else f"fall: died ({process.wait()})", took
        return str(json.loads(told)[0]), took

    def end(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.wait()


def main() -> None:
    """All cases, a line about each fall, and the sums."""
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("--cases", type=int, default=5000)
    arguments.add_argument("--seed", type=int, default=1)
    arguments.add_argument("--only", type=int, nargs="*", help="these cases alone")
    arguments.add_argument("--keep", type=Path, help="keep the files that fell here")
    arguments.add_argument("--reader", nargs="*", help=argparse.SUPPRESS)
    given = arguments.parse_args()
    if given.reader is not None:
        reader(given.reader)
        return
    sys.exit(1 if run(given.only or range(given.cases), given.seed, given.keep) else 0)


def run(numbers: range | list[int], seed: int, keep: Path | None = None) -> int:
    """Read these cases; how many fell."""
    sound = sound_files()
    became: Counter[str] = Counter()
    slowest = (0.0, 0)
    began = time.monotonic()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name, "vehicle", "session")
        folder.mkdir(parents=True)
        warm = [folder / "sound.csv", folder / "sound.mcap"]
        for path, content in zip(warm, (sound.csv[0], sound.mcap[0]), strict=True):
            path.write_bytes(content)
        process = Reader(warm)
        for number in numbers:
            file, kinds, content = hostile(number, seed, sound)
            path = folder / file
            path.write_bytes(content)
            told, took = process.read(path)
            became[told if told.startswith("refused") else told.partition(":")[0]] += 1
            slowest = max(slowest, (took, number))
            if told.startswith("fall"):
                print(f"case {number} ({file}, {', '.join(kinds)}, {len(content)} bytes): {told}", flush=True)
                if keep is not None:
                    keep.mkdir(parents=True, exist_ok=True)
                    (keep / f"{number}-{file}").write_bytes(content)
        process.end()
    told = ", ".join(f"{count} {what}" for what, count in became.most_common())
    print(f"{became.total()} files in {time.monotonic() - began:.0f} s: {told}")
    print(f"slowest: case {slowest[1]}, {slowest[0]:.1f} s; falls: {became['fall']}")
    return became["fall"]


if __name__ == "__main__":
    main()
