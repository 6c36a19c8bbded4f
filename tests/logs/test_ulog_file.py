"""ULog files against pyulog: every message and every field of it, on files of our own and on recordings."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from example_logs import PARENT, needs_examples
from pyulog import ULog
from ulog_support import by_pyulog, changed, flight, parts_of, readings, times_us

from fieldcal.errors import UnreadableLog
from fieldcal.logs.ulog import file as ulog_file
from fieldcal.logs.ulog import records
from fieldcal.logs.ulog.file import Rows as Messages
from fieldcal.logs.ulog.file import UlogFile
from fieldcal.logs.ulog.scan import Losses
from fieldcal.logs.ulog.write import Rows, message

RECORDINGS = sorted(path for folder in ("autopilot-logs", "data") for path in (PARENT / folder).rglob("*.ulg"))


def leaf(rows: Messages, path: str) -> np.ndarray:
    """A field as pyulog names it: `a.b[2]`."""
    values: np.ndarray = rows
    for name in path.split("."):
        plain, _, index = name.partition("[")
        values = values[plain]
        if values.dtype.kind == "S" and index:
            values = np.ascontiguousarray(values).view(np.uint8).reshape(len(values), -1)
        if index:
            values = values[:, int(index[:-1])]
    return values.view(np.uint8) if values.dtype.kind == "S" else values


def check_against_pyulog(path: Path) -> None:
    """Counts, fields, parameters and their changes, information."""
    ours, theirs = UlogFile(path), by_pyulog(path)
    assert ours.losses == Losses()
    assert ours.unknown_messages == 0
    counts = {(topic.name, topic.instance): ours.count(topic) for topic in ours.topics if ours.count(topic)}
    assert counts == {key: len(data["timestamp"]) for key, data in theirs.items()}
    for (name, instance), data in theirs.items():
        (topic,) = [t for t in ours.topics if (t.name, t.instance) == (name, instance) and ours.count(t)]
        rows = np.concatenate(list(ours.chunks(topic)))
        for field, values in data.items():
            found = leaf(rows, field)
            assert np.array_equal(found.astype(values.dtype), values, equal_nan=values.dtype.kind == "f"), field
    whole = ULog(str(path))
    assert ours.parameters == whole.initial_parameters
    assert [(one.t_us, one.name, one.value) for one in ours.changes] == whole.changed_parameters
    assert ours.dropouts_ms == [one.duration for one in whole.dropouts]
    texts = {key: value for key, value in whole.msg_info_dict.items() if isinstance(value, str)}
    assert {key: ours.infos[key] for key in texts} == texts


def test_own_file_is_what_pyulog_reads(tmp_path: Path) -> None:
    path = tmp_path / "f.ulg"
    changes = [changed(4_000_000, "CAL_GYRO0_XOFF", 0.25), changed(5_000_000, "SYS_HITL", 1)]
    path.write_bytes(b"".join(parts_of(flight(), changes=changes, dropouts_ms=[12, 500])))
    check_against_pyulog(path)
    assert len(UlogFile(path).changes) == 2


def test_chunks_are_the_rows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ulog_file, "ROWS_AT_ONCE", 7)
    path = tmp_path / "f.ulg"
    path.write_bytes(b"".join(parts_of(flight(1.0))))
    check_against_pyulog(path)


def test_every_type_nested_arrays_and_padding_are_read(tmp_path: Path) -> None:
    """A file laid out by hand here, its expected values with it."""
    inner = "inner:uint16_t a;float[2] b;"
    outer = (
        "outer:uint64_t timestamp;int8_t i;bool flag;char[6] text;inner one;inner[2] two;double d;int64_t big;"
        "uint8_t[5] _padding0;"
    )
    pack = struct.Struct("<H Q b ? 6s Hff Hff Hff d q".replace(" ", ""))
    rows = [
        (
            7,
            1000 + k,
            -k,
            bool(k % 2),
            f"txt{k}".encode(),
            *(k, 0.5, 1.5),
            *(k + 1, 2.5, 3.5),
            *(9, 4.5, k),
            0.1 * k,
            -k << 40,
        )
        for k in range(5)
    ]
    parts = [records.MAGIC + struct.pack("<BQ", 1, 99), message(records.FLAGS, bytes(40))]
    parts += [message(records.FORMAT, text.encode()) for text in (outer, inner)]
    parts.append(message(records.SUBSCRIPTION, struct.pack("<BH", 3, 7) + b"outer"))
    # The logger may write the padding at the end or leave it out.
    parts += [message(records.DATA, pack.pack(*row) + (bytes(5) if row[1] % 2 else b"")) for row in rows]
    path = tmp_path / "f.ulg"
    path.write_bytes(b"".join(parts))
    log = UlogFile(path)
    (topic,) = log.topics
    found = log.rows(topic)
    assert (log.start_us, topic.instance, len(found)) == (99, 3, 5)
    assert found["timestamp"].tolist() == [row[1] for row in rows]
    assert found["i"].tolist() == [row[2] for row in rows]
    assert found["flag"].tolist() == [row[3] for row in rows]
    assert found["text"].tolist() == [row[4] for row in rows]
    assert found["one"]["a"].tolist() == [row[5] for row in rows]
    assert found["two"]["a"].tolist() == [[row[8], row[11]] for row in rows]
    assert found["two"]["b"].tolist() == [[[row[9], row[10]], [row[12], row[13]]] for row in rows]
    assert found["d"].tolist() == [row[14] for row in rows]
    assert found["big"].tolist() == [row[15] for row in rows]


def test_what_was_appended_after_a_crash_is_read(tmp_path: Path) -> None:
    parts = parts_of(flight(2.0))
    whole, half = b"".join(parts), len(parts) - 100
    cut = len(b"".join(parts[:half])) + 11  # within message `half`
    appended = struct.pack("<8s8sQQQ", b"", bytes([records.DATA_APPENDED]), cut, 0, 0)
    start = records.FILE_HEAD_BYTES + records.HEAD_BYTES
    assert whole[start : start + 40] == bytes(40)
    content = whole[:start] + appended + whole[start + 40 : cut] + b"".join(parts[half + 1 :])
    path = tmp_path / "f.ulg"
    path.write_bytes(content)
    log = UlogFile(path)
    total = sum(log.count(topic) for topic in log.topics)
    path.write_bytes(whole)
    intact = UlogFile(path)
    assert total == sum(intact.count(topic) for topic in intact.topics) - 1
    assert log.losses.cut_bytes == 11
    assert log.losses.places == 0


@pytest.mark.parametrize(
    ("content", "code"),
    [
        (b"", "empty_file"),
        (b"ULog\x01\x12", "not_an_autopilot_log"),
        (b"\xa3\x95" * 40, "not_an_autopilot_log"),
    ],
)
def test_what_is_no_ulog_is_refused(tmp_path: Path, content: bytes, code: str) -> None:
    path = tmp_path / "f.ulg"
    path.write_bytes(content)
    with pytest.raises(UnreadableLog) as caught:
        UlogFile(path)
    assert caught.value.reason_code == code


def test_a_flag_that_is_not_known_is_refused(tmp_path: Path) -> None:
    content = bytearray(b"".join(parts_of(flight(1.0))))
    content[records.FILE_HEAD_BYTES + records.HEAD_BYTES + 8] = 2
    path = tmp_path / "f.ulg"
    path.write_bytes(content)
    with pytest.raises(UnreadableLog, match="Update fieldcal") as caught:
        UlogFile(path)
    assert caught.value.reason_code == "format_not_supported"


@pytest.mark.parametrize(
    "text",
    ["t:uint64_t timestamp;t again;", "t:missing m;", "t:uint8_t[0] none;", "t:uint8_t[60000] a;uint8_t[60000] b;"],
)
def test_a_format_that_cannot_be_makes_its_messages_unknown(tmp_path: Path, text: str) -> None:
    parts = [records.MAGIC + struct.pack("<BQ", 1, 0), message(records.FORMAT, text.encode())]
    parts.append(message(records.SUBSCRIPTION, struct.pack("<BH", 0, 0) + b"t"))
    parts += [message(records.DATA, struct.pack("<HQ", 0, k)) for k in range(4)]
    path = tmp_path / "f.ulg"
    path.write_bytes(b"".join(parts))
    log = UlogFile(path)
    assert (log.topics, log.unknown_messages) == ([], 4)


def test_only_what_is_wanted_is_kept(tmp_path: Path) -> None:
    t_us = times_us(1.0)
    path = tmp_path / "f.ulg"
    wide = Rows("wide", {"timestamp": t_us, "x": readings(len(t_us), 3)})
    path.write_bytes(b"".join(parts_of([*flight(1.0), wide])))
    log = UlogFile(path, {"wide"}.__contains__)
    (topic,) = log.instances("wide")
    (other,) = log.instances("sensor_combined")
    np.testing.assert_array_equal(log.rows(topic)["x"], wide.columns["x"])
    assert len(log.rows(other)) == 0
    assert log.count(other) == 200


@needs_examples
@pytest.mark.parametrize("path", RECORDINGS, ids=lambda path: path.name)
def test_recordings_are_what_pyulog_reads(path: Path) -> None:
    check_against_pyulog(path)
