"""Folders of ROS 2 bags: metadata line by line, held to a YAML library; channels of several files as one log's."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import pytest
import yaml
import zstandard
from mcap.writer import CompressionType, Writer

from fieldcal.errors import UnreadableLog
from fieldcal.logs.interface import LogSummary
from fieldcal.logs.rosbag2 import metadata
from fieldcal.logs.rosbag2.folder import FolderContainer
from fieldcal.logs.rosbag2.metadata import BagMetadata, read_metadata


def read(folder: Path, text: str) -> BagMetadata:
    (folder / "metadata.yaml").write_text(text)
    return read_metadata(folder)


@pytest.mark.parametrize(
    "scalar",
    [
        "a_0.db3",
        "'a_0.db3'",
        '"a_0.db3"',
        "'a'b",
        "a'",
        "'a_0.db3",
        "x'",
        "''",
        "'x'",
        '"it\'s"',
        "'a b'",
        "a b  ",
        "ab",
    ],
)
def test_scalars_with_and_without_quotes(tmp_path: Path, scalar: str) -> None:
    text = f"x:\n  relative_file_paths:\n    - {scalar}\n  topics_with_message_count:\n"
    text += f"    - topic_metadata:\n        name: {scalar}\n      message_count: 3\n"
    found = read(tmp_path, text)
    try:
        expected = yaml.safe_load(text)["x"]["relative_file_paths"]
    except yaml.YAMLError:
        expected = [scalar]
    assert (found.names, list(found.counts)) == (expected, expected)


@pytest.mark.parametrize("lists", ["  ", ""])
@pytest.mark.parametrize("root", ["", "  "])
def test_lists_end_where_yaml_says_so(tmp_path: Path, lists: str, root: str) -> None:
    """Items may stand below their key or be indented; lists within items are no items of the list."""
    lines = [
        "version: 5",
        "relative_file_paths:",
        f"{lists}- a_0.db3",
        "",
        f"{lists}- a_1.db3",
        "topics_with_message_count:",
        f"{lists}- topic_metadata:",
        f"{lists}    name: /a",
        f"{lists}    profiles:",
        f"{lists}      - name: /x",
        f"{lists}      - name: /y",
        f"{lists}  message_count: 3",
        f"{lists}- topic_metadata:",
        f"{lists}    name: /no_count",
        f"{lists}- message_count: 7",
        f"{lists}- message_count: 8",
        f"{lists}  topic_metadata:",
        f"{lists}    name: /b",
        "compression_format: ''",
        "files:",
        f"{lists}- path: a_0.db3",
    ]
    text = "\n".join(["rosbag2_bagfile_information:", *(root + "  " + line for line in lines), "other:", "- 1"])
    information = yaml.safe_load(text)["rosbag2_bagfile_information"]
    found = read(tmp_path, text)
    assert found.names == information["relative_file_paths"] == ["a_0.db3", "a_1.db3"]
    assert found.counts == {"/a": 3, "/b": 8}
    assert found.damage is None


def test_metadata_that_cannot_be_used_says_why(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert read_metadata(tmp_path).damage == "the recorder did not write it"
    assert read(tmp_path, "version: 5\n") == BagMetadata()
    monkeypatch.setattr(metadata, "CAP_BYTES", 10)
    assert read(tmp_path, "a" * 10).damage is None
    assert read(tmp_path, "a" * 11).damage == "it is larger than 10 bytes"

    def broken(_: Path) -> bytes:
        raise OSError(5, "Input/output error", "metadata.yaml")

    monkeypatch.setattr(Path, "read_bytes", broken)
    assert read(tmp_path, "a").damage == "Input/output error"


# files as one log -----------------------------------------------------------------------------------------------------


def part(
    path: Path, topics: Mapping[str, str | None], payloads: Sequence[bytes] = (b"x",), *, crc: bool = True
) -> None:
    """A file with topics whose schema has that text or that have none, and those messages on each."""
    with path.open("wb") as stream:
        writer = Writer(stream, compression=CompressionType.NONE, enable_crcs=crc)
        writer.start("ros2", "")
        channels = [
            writer.register_channel(topic, "cdr", writer.register_schema("a", "b", text.encode()) if text else 0)
            for topic, text in topics.items()
        ]
        for number, payload in enumerate(payloads):
            for channel in channels:
                writer.add_message(channel, number, payload, number)
        writer.finish()


def index(folder: Path, names: Sequence[str], counts: Mapping[str, int]) -> None:
    topics = [{"topic_metadata": {"name": topic}, "message_count": count} for topic, count in counts.items()]
    information = {"relative_file_paths": list(names), "topics_with_message_count": topics}
    (folder / "metadata.yaml").write_text(yaml.safe_dump({"rosbag2_bagfile_information": information}))


def payloads(container: FolderContainer, wanted: Sequence[int]) -> dict[int, list[bytes]]:
    """Channel → its messages, of wanted and unwanted ones that are given an id of the folder's."""
    found: dict[int, list[bytes]] = {}
    for block in container.blocks(wanted):
        for start, size, channel in zip(block.starts, block.sizes, block.channels.tolist(), strict=True):
            if channel >= 0:
                found.setdefault(channel, []).append(bytes(block.data[start : start + size]))
    return found


def findings(container: FolderContainer) -> tuple[dict[str, tuple[int, str]], bool]:
    """Code → (count, sentence); whether the log is verifiable."""
    summary = LogSummary("rosbag2")
    container.report(summary)
    return {finding.code: (finding.count, finding.sentence) for finding in summary.findings}, summary.verifiable


def test_a_topic_has_one_channel_through_all_files_that_define_it_alike(tmp_path: Path) -> None:
    part(tmp_path / "a_0.mcap", {"/a": "int8 x", "/b": "int8 y", "/c": "int8 x", "/none": None}, [b"0"])
    part(tmp_path / "a_1.mcap", {"/none": None, "/d": "int8 z", "/b": "int8 y", "/a": "int8 w"}, [b"1"])
    index(tmp_path, ["a_0.mcap", "a_1.mcap"], {"/a": 2, "/b": 2, "/e": 3})
    container = FolderContainer(tmp_path)
    definitions = container.definitions
    texts = {
        number: (channel.topic, definitions.schemas[channel.schema_id].data if channel.schema_id else None)
        for number, channel in definitions.channels.items()
    }
    assert texts == {
        1: ("/a", b"int8 x"), 2: ("/b", b"int8 y"), 3: ("/c", b"int8 x"), 4: ("/none", None), 5: ("/d", b"int8 z"),
        6: ("/a", b"int8 w"),
    }  # fmt: skip
    assert list(definitions.schemas) == [1, 2, 3, 4]
    assert not definitions.redefined
    assert container.counts == {1: 2, 2: 2}
    assert payloads(container, [2, 4, 6]) == {2: [b"0", b"1"], 4: [b"0", b"1"], 6: [b"1"]}
    assert payloads(FolderContainer(tmp_path), [5]) == {5: [b"1"]}


def test_files_are_read_as_listed_then_by_number(tmp_path: Path) -> None:
    for number in (0, 1, 2, 10):
        part(tmp_path / f"a_{number}.mcap", {"/a": None}, [b"%d" % number])
    for listed, order in [([], "0 1 2 10"), (["a_2.mcap", "dir/a_1.mcap", "a_2.mcap"], "2 1 0 10")]:
        index(tmp_path, listed, {})
        container = FolderContainer(tmp_path)
        assert container.counts is None
        assert payloads(container, [1]) == {1: order.encode().split()}
        assert findings(container) == ({}, True)


def test_a_file_packed_after_the_metadata_was_written_is_not_missed(tmp_path: Path) -> None:
    part(tmp_path / "a_0.mcap", {"/a": None})
    packed = zstandard.compress((tmp_path / "a_0.mcap").read_bytes())
    (tmp_path / "a_0.mcap").unlink()
    (tmp_path / "a_0.MCAP.zstd").write_bytes(packed)
    index(tmp_path, ["a_0.mcap"], {"/a": 1})
    container = FolderContainer(tmp_path)
    assert payloads(container, [1]) == {1: [b"x"]}
    assert "truncated" not in findings(container)[0]


@pytest.mark.parametrize("gone", [1, 5, 6])
def test_files_that_are_missed_are_told(tmp_path: Path, gone: int) -> None:
    part(tmp_path / "a_0.mcap", {"/a": None})
    names = [f"a_{number}.mcap" for number in range(gone + 1)]
    index(tmp_path, names, {"/a": 5})
    container = FolderContainer(tmp_path)
    payloads(container, [1])
    summary = LogSummary("rosbag2")
    container.report(summary)
    (finding,) = summary.findings  # that counts differ follows from it
    assert (finding.code, finding.count, finding.loses_data) == ("truncated", gone, True)
    assert f" lacks {', '.join(names[1:6])}, which" in finding.sentence


def test_messages_that_are_missed_are_told_of_topics_that_were_wanted(tmp_path: Path) -> None:
    part(tmp_path / "a_0.mcap", {"/a": None, "/b": None, "/c": None}, [b"x"] * 3)
    index(tmp_path, ["a_0.mcap"], {"/a": 4, "/b": 5, "/c": 3})
    for wanted, lost in [([1], "/a 1"), ([2, 1], "/a 1, /b 2"), ([3], "")]:
        container = FolderContainer(tmp_path)
        payloads(container, wanted)
        sentence = f"{tmp_path.name} holds fewer messages than its metadata.yaml says. Lost: {lost}."
        expected = {"count_mismatch": (len(wanted) + wanted[0] - 1, sentence)} if lost else {}
        assert findings(container)[0] == expected


def test_a_bag_is_verifiable_if_all_its_files_are(tmp_path: Path) -> None:
    for crcs, expected in [((True, True), True), ((True, False), False), ((False, True), False)]:
        for number, crc in enumerate(crcs):
            part(tmp_path / f"a_{number}.mcap", {"/a": None}, crc=crc)
        index(tmp_path, ["a_0.mcap", "a_1.mcap"], {})
        container = FolderContainer(tmp_path)
        payloads(container, [1])
        assert findings(container)[1] == expected


def test_a_bag_without_metadata_or_with_files_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(UnreadableLog, match=r"holds no \.mcap or \.db3 file"):
        FolderContainer(tmp_path)
    for number in (0, 1):
        (tmp_path / f"a_{number}.db3").write_bytes(b"x" * 200)
    with pytest.raises(UnreadableLog, match=r"a_0\.db3"):
        FolderContainer(tmp_path)
    part(tmp_path / "a_2.mcap", {"/a": None})
    container = FolderContainer(tmp_path)
    (tmp_path / "a_2.mcap").write_bytes(b"x" * 200)
    assert payloads(container, [1]) == {}
    summary = LogSummary("rosbag2")
    container.report(summary)
    told = [(finding.code, finding.count, finding.loses_data) for finding in summary.findings]
    assert told == [("damaged_summary", 1, False), ("not_bag", 1, True), ("not_bag", 1, True), ("not_mcap", 1, True)]
