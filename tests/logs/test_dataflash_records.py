"""FMT messages, format letters and multipliers of DataFlash; counts and values against pymavlink's."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from dataflash_support import PACK, DataflashFlight, by_pymavlink, fmt, own_fmt, rows_of

from fieldcal.errors import UnreadableLog
from fieldcal.logs.dataflash import file as dataflash_file
from fieldcal.logs.dataflash.file import DataflashFile
from fieldcal.logs.dataflash.records import FMT_LAYOUT, LETTERS, multipliers, parse_fmt

EXTREMES = {
    "b": (-128, 127),
    "B": (0, 255),
    "h": (-32768, 32767),
    "H": (0, 65535),
    "i": (-(2**31), 2**31 - 1),
    "I": (0, 2**32 - 1),
    "q": (-(2**53), 2**53),
    "Q": (0, 2**53),
    "c": (-32768, 32767),
    "C": (0, 65535),
    "e": (-(2**31), 2**31 - 1),
    "E": (0, 2**32 - 1),
    "L": (-1_800_000_000, 1_800_000_000),
    "M": (0, 20),
    "f": (-1.5e30, 2.5),
    "d": (-1.5e300, 2.5),
    "g": (-1.5, 2.5),
}


def test_every_letter_reads_as_pymavlink_reads_it(tmp_path: Path) -> None:
    content = own_fmt()
    for number, letter in enumerate(EXTREMES):
        content += fmt(200 + number, 3 + struct.calcsize("<" + PACK[letter]), f"T{number}", letter, "V")
    for number, (letter, values) in enumerate(EXTREMES.items()):
        for value in values:
            content += struct.pack("<2sB" + PACK[letter], b"\xa3\x95", 200 + number, value)
    (tmp_path / "a.bin").write_bytes(content)
    file = DataflashFile(tmp_path / "a.bin")
    file.locate({f"T{number}" for number in range(len(EXTREMES))})
    _, theirs = by_pymavlink(tmp_path / "a.bin")
    for number, letter in enumerate(EXTREMES):
        rows = file.rows(f"T{number}")
        assert rows is not None
        assert rows.numbers("V").tolist() == theirs[f"T{number}"]["V"], letter
    assert set(LETTERS) == {*EXTREMES, *"anNZ"}


def test_texts_and_arrays(tmp_path: Path) -> None:
    samples = list(range(-16, 16))
    content = own_fmt() + fmt(200, 3 + 4 + 16 + 64 + 64, "T", "nNZa", "A,B,C,D")
    content += struct.pack("<2sB4s16s64s32h", b"\xa3\x95", 200, b"abcd", b"x" * 16, b"caf\xc3\xa9\0rest", *samples)
    (tmp_path / "a.bin").write_bytes(content)
    file = DataflashFile(tmp_path / "a.bin")
    file.locate({"T"})
    rows = file.rows("T")
    assert rows is not None
    assert (rows.texts("A"), rows.texts("B"), rows.texts("C")) == (["abcd"], ["x" * 16], ["café"])
    assert rows.stored("D").tolist() == [samples]
    assert "D" not in rows
    assert "A" not in rows


def test_a_multiplier_applies_to_stored_integers_only(tmp_path: Path) -> None:
    path = DataflashFlight(40).write(tmp_path / "a.bin")
    file = DataflashFile(path)
    file.locate({"MAG", "GPS", "IMU"})
    mag, gps, imu = file.rows("MAG"), file.rows("GPS"), file.rows("IMU")
    assert mag is not None
    assert gps is not None
    assert imu is not None
    assert np.array_equal(mag.in_unit("MagX", 1.0), mag.integers("MagX") / 1e3)
    assert mag.in_unit("TimeUS")[0] == pytest.approx(mag.integers("TimeUS")[0] * 1e-6)
    assert np.array_equal(gps.in_unit("Alt"), gps.integers("Alt") / 100)  # FMTU says 0.01 too: once
    assert np.array_equal(imu.in_unit("GyrX"), imu.stored("GyrX").astype(float))


def test_whole_numbers_of_floats_are_cut_and_what_is_none_is_zero() -> None:
    rows = rows_of("T", "dfh", {"A": [2.7, -2.7, np.nan, np.inf], "B": [-np.inf, 1e6, 0.9, -0.9], "C": [1, -1, 7, 9]})
    assert rows.integers("A").tolist() == [2, -2, 0, 0]
    assert rows.integers("B").tolist() == [0, 1_000_000, 0, 0]
    assert rows.integers("C").tolist() == [1, -1, 7, 9]


def test_of_no_messages_there_are_no_values() -> None:
    rows = rows_of("T", "Qa", {"A": [1, 2], "B": [range(32)] * 2})
    none = rows.where(np.zeros(2, bool))
    assert (len(rows), len(none)) == (2, 0)
    assert none.stored("A").shape == (0,)
    assert none.stored("B").shape == (0, 32)
    assert rows.where(np.array([False, True])).integers("A").tolist() == [2]


def test_a_multiplier_is_the_logs_own_else_the_one_given() -> None:
    rows = rows_of("T", "hfc", {"A": [5], "B": [5.0], "C": [500]}, multipliers={"A": 0.1, "B": 0.1, "C": 0.1})
    assert [rows.in_unit(name, 1e-3).tolist() for name in "ABC"] == [[0.5], [5.0], [5.0]]
    plain = rows_of("T", "hfc", {"A": [5], "B": [5.0], "C": [500]})
    assert [plain.in_unit(name, 1e-3).tolist() for name in "ABC"] == [[0.005], [5.0], [5.0]]
    assert plain.in_unit("A").tolist() == [5.0]


def test_multipliers_of_zero_or_of_other_columns_are_none() -> None:
    layouts = {130: rows_of("T", "Qbb", {"TimeUS": [], "V": [], "W": []}).layout}
    mult = rows_of("MULT", "bd", {"Id": [ord("F"), ord("-"), ord("A")], "Mult": [1e-6, 0.0, 0.1]})
    for ids, found in (("F-A", {"TimeUS": 1e-6, "W": 0.1}), ("FZA", {"TimeUS": 1e-6, "W": 0.1}), ("FA", None)):
        fmtu = rows_of("FMTU", "BN", {"FmtType": [130, 131], "MultIds": [ids.encode(), b"F"]})
        assert multipliers(fmtu, mult, layouts) == ({} if found is None else {130: found})
        assert multipliers(fmtu, None, layouts) == multipliers(None, mult, layouts) == {}


@pytest.mark.parametrize("missing", ["", "FmtType", "MultIds", "Id", "Mult"])
def test_multipliers_need_every_column_of_both_messages(tmp_path: Path, missing: str) -> None:
    """Of FMTU types and letters, of MULT letters and factors: without one of them there is no multiplier."""
    formats, values = {"FmtType": "B", "MultIds": "N"}, {"Id": "b", "Mult": "d"}
    content = own_fmt()
    sizes = {"B": 1, "N": 16, "b": 1, "d": 8}
    for type_id, name, columns in ((200, "FMTU", formats), (201, "MULT", values)):
        kept = {column: letter for column, letter in columns.items() if column != missing}
        length = 3 + sum(sizes[letter] for letter in kept.values())
        content += fmt(type_id, length, name, "".join(kept.values()), ",".join(kept))
        packed = {"FmtType": b"\xc9", "MultIds": b"-A".ljust(16, b"\0"), "Id": b"A", "Mult": struct.pack("<d", 0.01)}
        content += struct.pack("<2sB", b"\xa3\x95", type_id) + b"".join(packed[column] for column in kept)
    (tmp_path / "a.bin").write_bytes(content)
    file = DataflashFile(tmp_path / "a.bin")
    file.locate({"FMTU", "MULT"})
    found = multipliers(file.rows("FMTU"), file.rows("MULT"), file.layouts)
    assert found == ({} if missing else {201: {"Mult": 0.01}})


@pytest.mark.parametrize(
    ("message", "columns"),
    [
        (fmt(130, 12, "ABC", "Qb", "TimeUS,V"), ("TimeUS", "V")),
        (fmt(130, 13, "ABC", "Qb", "TimeUS,V"), ()),  # its length is not that of its fields
        (fmt(130, 12, "ABC", "Qb", "TimeUS"), ()),
        (fmt(130, 12, "ABC", "Qb", "V,V"), ()),
        (fmt(130, 12, "ABC", "Q?", "TimeUS,V"), None),
        (fmt(130, 12, "", "Qb", "TimeUS,V"), None),
        (fmt(130, 12, "A C", "Qb", "TimeUS,V"), None),
        (fmt(130, 2, "ABC", "Qb", "TimeUS,V"), None),
        (fmt(130, 12, "ABC", "Qb", "TimeUS,\xa3"), None),
        (fmt(130, 12, "ABC", "Qb", "TimeUS,V")[:-1], None),
        (fmt(130, 3, "ABC", "", ""), ()),  # a head alone
        (fmt(130, 12, "ABC", "Qb", "TimeUS,"), None),
        (fmt(130, 12, "A_1", "Qb", "!,~"), ("!", "~")),  # the first and the last printable character
        (fmt(130, 12, "ABC", "Qb", "TimeUS,V W"), None),
        (fmt(130, 12, "ABC", "Qb", "TimeUS,\x7f"), None),
    ],
)
def test_definitions_that_contradict_themselves(message: bytes, columns: tuple[str, ...] | None) -> None:
    layout = parse_fmt(message)
    assert (None if layout is None else layout.columns) == columns


def test_the_definition_of_definitions_is_the_one_that_logs_begin_with() -> None:
    assert parse_fmt(own_fmt()) == FMT_LAYOUT


def test_a_type_whose_length_is_wrong_is_stepped_over(tmp_path: Path) -> None:
    content = own_fmt() + fmt(130, 14, "ODD", "Qb", "TimeUS,V") + fmt(131, 12, "TST", "Qb", "TimeUS,V")
    for number in range(5):
        content += b"\xa3\x95\x82" + bytes(11) + struct.pack("<2sBQb", b"\xa3\x95", 131, number, number)
    (tmp_path / "a.bin").write_bytes(content)
    file = DataflashFile(tmp_path / "a.bin")
    file.locate({"TST", "ODD"})
    rows = file.rows("TST")
    assert rows is not None
    assert rows.integers("V").tolist() == [0, 1, 2, 3, 4]
    assert file.rows("ODD") is None
    assert file.unreadable() == {"ODD": 5}
    assert file.tally.stretches == 0


def test_behind_a_second_definition_messages_are_left_out(tmp_path: Path) -> None:
    first, other = fmt(131, 12, "TST", "Qb", "TimeUS,V"), fmt(131, 12, "TST", "Qb", "TimeUS,W")
    message = struct.pack("<2sBQb", b"\xa3\x95", 131, 1, 1)
    (tmp_path / "a.bin").write_bytes(own_fmt() + first + message * 3 + first + message * 2 + other + message * 4)
    file = DataflashFile(tmp_path / "a.bin")
    file.locate({"TST"})
    assert file.counts() == {"FMT": 4, "TST": 5}
    assert file.tally.redefined == {"TST": 4}


def test_counts_and_values_are_pymavlinks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dataflash_file, "CHUNK_BYTES", 1000)  # messages lie across the borders of chunks
    path = DataflashFlight().write(tmp_path / "a.bin")
    file = DataflashFile(path)
    counts, theirs = by_pymavlink(path)
    file.locate(counts.keys())
    assert file.counts() == counts
    for name, columns in theirs.items():
        rows = file.rows(name)
        assert rows is not None
        for column, values in columns.items():
            if column in rows:
                assert rows.numbers(column).tolist() == values, (name, column)


def test_what_looks_like_a_head_within_data_is_none(tmp_path: Path) -> None:
    content = own_fmt() + fmt(131, 15, "TST", "QI", "TimeUS,V")
    values = np.random.default_rng(0).choice([0x83_95A3, 0x8395A3 << 8, 0x95A3, 0xA3, 0xA3 << 24, 7], 4000).tolist()
    for number, value in enumerate(values):
        content += struct.pack("<2sBQI", b"\xa3\x95", 131, number, value)
    (tmp_path / "a.bin").write_bytes(content)
    file = DataflashFile(tmp_path / "a.bin")
    file.locate({"TST"})
    rows = file.rows("TST")
    assert rows is not None
    assert rows.integers("V").tolist() == values
    assert file.tally.stretches == 0


@pytest.mark.parametrize("content", [b"x", b"\xa3\x95\x80", bytes(1000), b"\xa3\x95\x80" * 300, b"\x89MCAP0\r\n" * 9])
def test_what_is_no_dataflash_log(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "a.bin").write_bytes(content)
    with pytest.raises(UnreadableLog, match=r"a\.bin is no ArduPilot log") as raised:
        DataflashFile(tmp_path / "a.bin")
    assert raised.value.reason_code == "not_an_autopilot_log"


def test_an_empty_file(tmp_path: Path) -> None:
    (tmp_path / "a.bin").write_bytes(b"")
    with pytest.raises(UnreadableLog) as raised:
        DataflashFile(tmp_path / "a.bin")
    assert raised.value.reason_code == "empty_file"
