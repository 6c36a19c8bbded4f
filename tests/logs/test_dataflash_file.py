"""What a pass through a DataFlash file counts, byte by byte, and the limits of the writer."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from dataflash_support import fmt, own_fmt, packed

from fieldcal.logs.dataflash import file as dataflash_file
from fieldcal.logs.dataflash import report, write
from fieldcal.logs.dataflash.file import DataflashFile, Tally
from fieldcal.logs.interface import LogSummary

DEFINED = own_fmt() + fmt(131, 12, "TST", "Qb", "TimeUS,V")
MESSAGE = struct.pack("<2sBQb", b"\xa3\x95", 131, 1, 1)
OTHER = struct.pack("<2sB9s", b"\xa3\x95", 140, b"x" * 9)
"""Of a type that is not defined."""
END = len(DEFINED)


def located(path: Path, content: bytes, *names: str) -> DataflashFile:
    path.write_bytes(content)
    file = DataflashFile(path)
    file.locate(names)
    return file


@pytest.mark.parametrize(
    ("content", "messages", "expected"),
    [
        (b"", 0, Tally()),
        (MESSAGE, 1, Tally()),
        (MESSAGE * 2 + b"\xa3", 2, Tally(cut=1)),
        (MESSAGE * 2 + b"\xa3\x95", 2, Tally(cut=2)),
        (MESSAGE * 2 + b"\xa3\x95\x83", 2, Tally(cut=3)),
        (MESSAGE * 2 + MESSAGE[:-1], 2, Tally(cut=11)),
        (MESSAGE * 2 + b"\x95", 1, Tally(stretches=1, damaged_bytes=13, damaged_at=END + 12)),
        (MESSAGE * 2 + b"x" * 5, 1, Tally(stretches=1, damaged_bytes=17, damaged_at=END + 12)),
        (MESSAGE + b"xyz" + MESSAGE, 1, Tally(stretches=1, damaged_bytes=15, damaged_at=END)),
        (MESSAGE * 2 + b"xyz" + MESSAGE, 2, Tally(stretches=1, damaged_bytes=15, damaged_at=END + 12)),
        (
            MESSAGE * 2 + b"xyz" + MESSAGE * 2 + b"a" + MESSAGE,
            3,
            Tally(stretches=2, damaged_bytes=28, damaged_at=END + 12),
        ),
    ],
)
def test_what_is_no_message_is_counted_to_the_byte(
    tmp_path: Path, content: bytes, messages: int, expected: Tally
) -> None:
    """A message counts where the next begins at its end: the one before damage is lost with it."""
    file = located(tmp_path / "a.bin", DEFINED + content, "TST")
    tally = file.tally
    assert (tally.stretches, tally.damaged_bytes, tally.damaged_at, tally.cut, tally.undefined) == (
        expected.stretches,
        expected.damaged_bytes,
        expected.damaged_at,
        expected.cut,
        expected.undefined,
    )
    assert file.counts().get("TST", 0) == messages
    rows = file.rows("TST")
    assert (0 if rows is None else len(rows)) == messages


def test_messages_of_an_undefined_type_are_counted_in_bytes(tmp_path: Path) -> None:
    file = located(tmp_path / "a.bin", DEFINED + MESSAGE + (OTHER + MESSAGE * 2) * 2 + OTHER, "TST")
    assert file.tally.undefined == {140: 3 * 12}
    assert (file.tally.stretches, file.tally.cut) == (0, 0)
    summary = LogSummary("dataflash")
    report.report_damage(file, {}, summary)
    (finding,) = summary.findings
    assert (finding.code, finding.count, finding.loses_data) == ("unknown_channel", 1, True)
    assert "36 bytes are messages of type 140," in finding.sentence


@pytest.mark.parametrize("wanted", [("TST",), ()])
def test_behind_another_definition_messages_are_left_out_wanted_or_not(tmp_path: Path, wanted: tuple[str, ...]) -> None:
    changed = fmt(131, 12, "TST", "Qb", "TimeUS,W")
    file = located(tmp_path / "a.bin", DEFINED + MESSAGE * 3 + changed + MESSAGE * 2, *wanted)
    assert file.counts() == {"FMT": 3, "TST": 3}
    summary = LogSummary("dataflash")
    report.report_damage(file, {}, summary)
    (finding,) = summary.findings
    assert (finding.code, finding.count, finding.loses_data) == ("channel_redefined", 2, True)


def test_another_definition_of_definitions_is_itself_left_out(tmp_path: Path) -> None:
    other = fmt(128, 89, "FMT", "BBnNZ", "Type,Size,Name,Format,Columns")
    file = located(tmp_path / "a.bin", DEFINED + other + fmt(132, 12, "NEW", "Qb", "TimeUS,V"), "FMT")
    assert file.counts() == {"FMT": 2}
    assert file.tally.redefined == {"FMT": 2}


def test_a_definition_close_behind_what_looks_like_one_is_found(tmp_path: Path) -> None:
    for between in (b"", b"\xa3\x95\x80", b"\xa3\x95\x80" * 2, b"\xa3\x95\x80x"):
        content = own_fmt() + b"\xa3\x95\x80" + between + DEFINED[89:] + MESSAGE
        assert {layout.name for layout in located(tmp_path / "a.bin", content).layouts.values()} == {"FMT", "TST"}


@pytest.mark.parametrize("chunk", [1, 2, 3, 89, 254, 255, 256, 257, 258, 510, 1 << 24])
def test_the_longest_messages_lie_across_the_borders_of_chunks(
    tmp_path: Path, chunk: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(dataflash_file, "CHUNK_BYTES", chunk)
    definition, content = packed(140, "BIG", "QZZZNNNI", {
        "TimeUS": range(9), "A": [b"\xa3\x95\x8c"] * 9, **{n: [b"x"] * 9 for n in "BCDEF"}, "G": range(9)
    })  # fmt: skip
    assert len(content) == 9 * 255
    file = located(tmp_path / "a.bin", own_fmt() + definition + content, "BIG")
    rows = file.rows("BIG")
    assert rows is not None
    assert rows.integers("G").tolist() == list(range(9))
    assert (file.tally.stretches, file.tally.cut) == (0, 0)


def test_the_last_but_one_message_may_hold_what_looks_like_a_head(tmp_path: Path) -> None:
    looks = struct.pack("<2sB8sb", b"\xa3\x95", 131, b"\0\xa3\x95\x83\0\0\0\0", 5)
    for content in (looks, looks + MESSAGE, MESSAGE + looks + MESSAGE, looks * 2):
        file = located(tmp_path / "a.bin", DEFINED + content, "TST")
        assert (file.counts()["TST"], file.tally.stretches, file.tally.cut) == (len(content) // 12, 0, 0)


def test_the_first_text_and_version_are_told(tmp_path: Path) -> None:
    parts = [
        packed(131, "VER", "QZ", {"TimeUS": [1, 2], "FWS": [b"ArduCopter V4.6.0", b"ArduCopter V4.6.1"]}),
        packed(132, "MSG", "QZ", {"TimeUS": [1, 2], "Message": [b"ChibiOS: 1", b"ChibiOS: 2"]}),
    ]
    content = own_fmt() + b"".join(definition for definition, _ in parts) + b"".join(rows for _, rows in parts)
    summary = LogSummary("dataflash")
    texts = report.describe(located(tmp_path / "a.bin", content, "VER", "MSG"), None, summary)
    assert texts == ["ChibiOS: 1", "ChibiOS: 2"]
    assert summary.metadata == {"firmware": "ArduCopter V4.6.0", "operating_system": "ChibiOS: 1"}


# the writer ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("letter", "least", "most"), [("h", -32768, 32767), ("B", 0, 255), ("c", -327.68, 327.67)])
def test_numbers_have_to_fit_their_format(letter: str, least: float, most: float) -> None:
    def series(*values: float) -> write.Messages:
        return write.Messages("TST", "Q" + letter, ("TimeUS", "V"), np.zeros(len(values), np.int64), {"V": values})

    assert series(least, most).packed(131).shape == (2, 11 + (1 if letter == "B" else 2))
    step = 0.01 if letter == "c" else 1
    for values in ((least - step, 0), (0, least - step), (most + step, 0), (0, most + step)):
        with pytest.raises(ValueError, match=rf"TST\.V does not fit format {letter}"):
            series(*values).packed(131)


@pytest.mark.parametrize(
    ("name", "letters", "columns", "fits"),
    [
        ("ABCD", "QZZZNNNI", ("TimeUS", *"ABCDEFG"), True),  # 255 bytes
        ("ABCD", "QZZZNNNIB", ("TimeUS", *"ABCDEFGH"), False),
        ("ABCDE", "Q", ("TimeUS",), False),
        ("A", "Q" + "b" * 15, ("TimeUS", *"ABCDEFGHIJKLMNO"), True),
        ("A", "Q" + "b" * 16, ("TimeUS", *"ABCDEFGHIJKLMNOP"), False),
        ("A", "Qb", ("TimeUS", "V" * 57), True),
        ("A", "Qb", ("TimeUS", "V" * 58), False),
    ],
)
def test_definitions_have_to_fit_theirs(
    tmp_path: Path, name: str, letters: str, columns: tuple[str, ...], fits: bool
) -> None:
    series = write.Messages(name, letters, columns, np.zeros(2, np.int64), {})
    if fits:
        write.write_dataflash(tmp_path / "a.bin", [series])
        file = DataflashFile(tmp_path / "a.bin")
        file.locate([name])
        assert file.counts()[name] == 2
    else:
        with pytest.raises(ValueError, match=f"message {name} does not fit the format"):
            write.write_dataflash(tmp_path / "a.bin", [series])


def test_what_is_written_without_being_given_is_of_a_healthy_flight(tmp_path: Path) -> None:
    """Sensors healthy, satellites in view, counters wrapped, parameters and texts with the first message."""
    t_us, still = np.array([(1 << 32) + 7000, (1 << 32) + 9000]), np.zeros((2, 3))
    messages = [
        write.imu_messages(t_us, still, still),
        write.mag_messages(t_us, still),
        write.gps_messages(t_us, 2300, 0, still, still),
        write.gpa_messages(t_us + 1, 0.5),
        write.vision_messages(t_us, still, still),
        write.battery_messages(t_us[:0], []),
    ]
    write.write_dataflash(tmp_path / "a.bin", messages, parameters={"A": 1.0}, texts=["x"])
    file = DataflashFile(tmp_path / "a.bin")
    file.locate(["IMU", "MAG", "GPS", "GPA", "VISP", "PARM", "MSG"])

    def column(message: str, name: str) -> list[int]:
        rows = file.rows(message)
        assert rows is not None
        return rows.integers(name).tolist()

    for message, names in (("IMU", "I T EG EA"), ("MAG", "I OfsX OfsY OfsZ MOX MOY MOZ"), ("GPS", "I Yaw")):
        assert [column(message, name) for name in names.split()] == [[0, 0]] * len(names.split())
    for message, name, value in (("IMU", "GH", 1), ("IMU", "AH", 1), ("MAG", "Health", 1), ("GPS", "NSats", 12)):
        assert column(message, name) == [value] * 2
    assert (column("GPS", "U"), column("GPS", "Status"), column("GPA", "VV")) == ([1, 1], [3, 3], [1, 1])
    assert column("MAG", "S") == [7000, 9000]
    assert column("VISP", "CTimeMS") == (t_us // 1000).tolist()
    assert column("PARM", "TimeUS") == column("MSG", "TimeUS") == [t_us[0]]
    assert file.counts()["FMTU"] == 8
    write.write_dataflash(tmp_path / "b.bin", [], parameters={"A": 1.0})
    file = DataflashFile(tmp_path / "b.bin")
    file.locate(["PARM"])
    assert column("PARM", "TimeUS") == [0]


def test_multipliers_are_ardupilots(tmp_path: Path) -> None:
    """LogStructure.h, log_Multipliers."""
    write.write_dataflash(tmp_path / "a.bin", [])
    file = DataflashFile(tmp_path / "a.bin")
    file.locate(["MULT"])
    rows = file.rows("MULT")
    assert rows is not None
    told = dict(zip(map(chr, rows.integers("Id").tolist()), rows.numbers("Mult").tolist(), strict=True))
    assert told == {"-": 0, "?": 1, "0": 1, "A": 1e-1, "B": 1e-2, "C": 1e-3, "F": 1e-6, "G": 1e-7}


def test_a_log_holds_as_many_types_as_a_byte_numbers(tmp_path: Path) -> None:
    """0 and the number of FMT are none, and three more are kept free; texts, parameters, MULT and FMTU take four."""
    names = [f"T{number}" for number in range(249)]
    series = [write.Messages(name, "Q", ("TimeUS",), np.array([5]), {}) for name in names]
    write.write_dataflash(tmp_path / "a.bin", series, parameters={"A": 1.0}, texts=["x"])
    file = DataflashFile(tmp_path / "a.bin")
    file.locate(["T248"])
    assert {file.counts()[name] for name in names} == {1}
    assert {0, 129}.isdisjoint(file.layouts)


def test_readings_are_logged_at_the_temperature_that_thermal_offsets_are_of() -> None:
    stated = dict.fromkeys([f"INS_{part}_{axis}" for part in ("ACCOFFS", "TCAL1_ACC1") for axis in "XYZ"], 1e5)
    stated |= {"INS_TCAL1_ENABLE": 1.0, "INS_ACC1_CALTEMP": 25.0}
    raw = np.arange(6.0).reshape(2, 3)
    at_35 = raw - 1e5 - 1e5 * (35.0 - 35.0) * 1e-6 + 1e5 * (25.0 - 35.0) * 1e-6
    assert np.allclose(write.as_logged("ACC", raw, stated), at_35, rtol=1e-12)
    assert np.allclose(write.as_logged("ACC", raw, stated, slot=0, temperature_degc=45.0), at_35 - 1.0, rtol=1e-12)
