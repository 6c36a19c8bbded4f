"""The parts of the CSV reader one by one: dialect, columns, lines, rows, units; each against what the text says."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import polars as pl
import pytest
from logs_support import vehicle

from fieldcal.config.configuration import CsvMap
from fieldcal.errors import UnreadableLog
from fieldcal.logs import LogSummary, read_log
from fieldcal.logs.csv.columns import IMU_DEFAULTS, Columns, declared_units, find_columns
from fieldcal.logs.csv.dialect import Dialect, cells_of, find_dialect, is_number
from fieldcal.logs.csv.losses import Losses
from fieldcal.logs.csv.rows import numbers_of, other_header, read_rows
from fieldcal.logs.csv.text import LineBlocks
from fieldcal.logs.csv.units import is_units_row, sensor_unit, time_unit
from fieldcal.reason_codes import ReasonCode

# dialect -------------------------------------------------------------------------------------------------------------


def dialect(text: str, separator: str | None = None, decimal: str | None = None) -> Dialect:
    return find_dialect(text.encode(), "log.csv", separator, decimal)


def test_where_the_data_begin() -> None:
    assert dialect("t,gx\n1,2\n") == Dialect(",", ".", ("t", "gx"), b"t,gx", None, 1)
    assert dialect("# c\n\nt,gx\ns,rad/s\n1,2\n") == Dialect(",", ".", ("t", "gx"), b"t,gx", ("s", "rad/s"), 4, 0, 3)
    assert dialect("t;gx\n\n# pause\ns;rad/s\n1;2\n") == Dialect(";", ".", ("t", "gx"), b"t;gx", ("s", "rad/s"), 4)
    assert dialect("t,gx\ns,rad/s,x\n1,2\n").unit_row is None
    assert dialect("sep=;\nt;gx\n1;2\n") == Dialect(";", ".", ("t", "gx"), b"t;gx", None, 2, 0, 2)
    assert dialect('"SEP=|"\nt|gx\n1|2\n').separator == "|"
    assert dialect("sep=;\nt,gx\n1,2\n", ",").separator == ","
    assert dialect("sep=;\n").names == ("sep=", "")
    assert dialect("sep=;\nt;gx\n").names == ("t", "gx")
    assert dialect("# x\n# t,gx\n0.1,2\n") == Dialect(",", ".", ("t", "gx"), b"", None, 2, 0, 3)
    assert dialect("t  gx\n1 2\n") == Dialect(" ", ".", ("t", "gx"), b"t gx", None, 1)
    assert dialect('"t","gx"\n1,2\n').header == b"t,gx"
    assert dialect("\ufefft,gx\n1,2\n").names == ("t", "gx")
    assert find_dialect("t,°x\n1,2\n".encode("latin-1"), "log.csv", None, None).names == ("t", "°x")


def test_numbers_with_gaps_are_no_header_and_a_comment_of_another_width_is_none_of_theirs() -> None:
    for text in ("1,,2\n3,4,5\n", "# t,gx\n1,2,3\n", "1,2,3\n", "# a,b,c\n# t,gx\n1,2,3\n"):
        with pytest.raises(UnreadableLog) as refused:
            dialect(text)
        assert refused.value.reason_code == "missing_header"
    assert dialect("# a,b\n# t,gx,gy\n1,2,3\n").names == ("t", "gx", "gy")


def test_the_separator_is_the_one_that_most_rows_agree_with() -> None:
    header, both, comma = "a;b,c\n", "1;2,3\n", "1,3\n"
    assert dialect(header + 3 * both + comma).separator == ";"
    assert dialect(header + 2 * both + 2 * comma).separator == ","
    assert dialect(header + both + 2 * comma).separator == ","
    assert dialect(header + 2 * both + comma).separator == ";"
    assert dialect(header).separator == ";"
    assert dialect(header + 4 * "1\n").separator == ";"
    assert dialect("a\tb;c,d\n1\t2;3,4\n").separator == "\t"


def test_the_decimal_sign_is_the_one_that_more_cells_have() -> None:
    assert dialect("a;b\n1,5;2,5\n1.5;x\n").decimal == ","
    assert dialect("a;b\n1,5;2.5\n").decimal == "."
    assert dialect("a;b\n,5;2,5e3\n").decimal == ","
    assert dialect("a;b\n1,5x;2,5,1\n").decimal == "."
    assert dialect("a;b\n1,5;2,5\n", decimal=".").decimal == "."
    assert dialect("a,b\n1,5\n").decimal == "."
    assert dialect("a,b\n1,5\n", decimal=",").decimal == ","
    with pytest.raises(UnreadableLog, match="only numbers"):
        dialect("1,5;2,5\n1,5;2,5\n")


def test_so_many_columns_are_read_and_no_more() -> None:
    names = [f"c{i}" for i in range(10_001)]
    assert dialect(",".join(names[:-1]) + "\n").fields == 10_000
    with pytest.raises(UnreadableLog, match="10001 columns, 10000 at most") as refused:
        dialect(",".join(names) + "\n")
    assert refused.value.reason_code == "too_many_columns"


@pytest.mark.parametrize("cell", ["1", "-1.5", "+.5", "5.", "1e5", "1.5E-07", " 2 ", "nan", "-INF", "+infinity"])
def test_numbers(cell: str) -> None:
    assert is_number(cell)


@pytest.mark.parametrize("cell", ["", ".", "1,5", "1e", "0x10", "1.5.2", "1 2", "e5", "nano", "--1"])
def test_no_numbers(cell: str) -> None:
    assert not is_number(cell)


def test_cells() -> None:
    assert cells_of(" a , b,", ",") == ["a", "b", ""]
    assert cells_of('"a, b"," c"', ",") == ["a, b", "c"]
    assert cells_of("a  b\tc", " ") == ["a", "b", "c"]
    assert cells_of('a "b', ",") == ['a "b']


# columns and units ---------------------------------------------------------------------------------------------------


def columns(names: list[str], configured: dict[str, str | tuple[str, ...]] | None = None) -> Columns:
    return find_columns(Dialect(",", ".", tuple(names), b"", None, 1), configured or {}, IMU_DEFAULTS, "imu", "log.csv")


def test_the_first_of_the_usual_times_is_taken() -> None:
    assert columns(["gx", "gy", "gz", "time", "t_s"]) == Columns(4, {"gyroscope": (0, 1, 2)})
    assert columns(["gx", "gy", "gz", "timestamp_ns", "time_ms"]).time == 4
    assert columns(["gx", "gy", "gz"]).time is None
    assert columns(["t_s", "clock"], {"t": "clock"}).time == 1
    assert columns(["w", "temp"], {"gyroscope": ("w", "w", "w")}).values == {
        "gyroscope": (0, 0, 0),
        "temperature": (1,),
    }
    assert columns(["amps"], {"current": "amps"}).values == {"current": (0,)}


def test_a_missing_column_is_told_with_the_three_nearest_or_the_first_twenty() -> None:
    with pytest.raises(UnreadableLog) as refused:
        columns(["gyro_x1", "gyro_x2", "gyro_x3", "gyro_x4", "zz"], {"gyroscope": ("gyro_x", "gyro_y", "gyro_z")})
    assert refused.value.sentence.count("'gyro_x") == 1 + 3
    with pytest.raises(UnreadableLog) as refused:
        columns([f"{i:02d}" for i in range(30)], {"gyroscope": ("omega", "b", "c")})
    assert "it has '00', '01'" in refused.value.sentence
    assert "'19'. " in refused.value.sentence


def test_units_that_disagree_are_one_finding_and_give_none() -> None:
    names = ("gx (deg/s)", "gy (deg/s)", "gz (rad/s)", "ax_g", "ay_g", "az_g")
    found = Columns(None, {"gyroscope": (0, 1, 2), "accelerometer": (3, 4, 5), "temperature": (0,)})
    summary = LogSummary("csv")
    assert declared_units(Dialect(",", ".", names, b"", None, 1), found, summary, "log.csv") == {"accelerometer": "g"}
    assert [(finding.code, finding.count) for finding in summary.findings] == [("unit_conflict", 1)]
    assert "(deg/s, rad/s)" in summary.findings[0].sentence
    row = ("rad/s", "rad/s", "rad/s", "-", "", "1")
    units = declared_units(Dialect(",", ".", names, b"", row, 1), found, LogSummary("csv"), "log.csv")
    assert units["gyroscope"] == "rad/s"


@pytest.mark.parametrize(
    ("sensor", "column", "cell", "unit"),
    [
        ("accelerometer", "ax", "[m/s²]", "m/s^2"),
        ("accelerometer", "ax", "mg", "mg"),
        ("accelerometer", "ax (g)", "-", "g"),
        ("accelerometer", "ax (g)", "", "g"),
        ("accelerometer", "ax_g", None, "g"),
        ("accelerometer", "a_g", None, "g"),
        ("accelerometer", "_g", None, None),
        ("accelerometer", "g", None, None),
        ("gyroscope", "gx_rad_s", None, "rad/s"),
        ("gyroscope", "gx_deg_per_s", None, "deg/s"),
        ("gyroscope", "gx", "°/s", "deg/s"),
        ("magnetometer", "mx {µT}", None, "uT"),
        ("magnetometer", "mx", "1", "norm"),
        ("magnetometer", "raw", None, None),
        ("magnetometer", "mx", None, None),
    ],
)
def test_unit_of_a_sensors_column(sensor: str, column: str, cell: str | None, unit: str | None) -> None:
    assert sensor_unit(sensor, column, cell) == unit


def test_unit_of_a_time_column() -> None:
    assert time_unit("t", "msec") == "ms"
    assert time_unit("t (us)", "m") == "us"
    assert time_unit("t_ns", None) == "ns"
    assert time_unit("t", None) is None


def test_a_row_of_units() -> None:
    assert is_units_row(["s", "rad/s", ""])
    assert not is_units_row(["", "-", "1"])
    assert not is_units_row(["s", "fast"])
    assert is_units_row(["-", "1", "m"])


# lines ---------------------------------------------------------------------------------------------------------------


def lines(tmp_path: Path, content: bytes) -> tuple[bytes, bool]:
    (tmp_path / "log.csv").write_bytes(content)
    blocks = LineBlocks(tmp_path / "log.csv")
    return b"".join(blocks), blocks.unterminated


@pytest.mark.parametrize(
    ("content", "text", "unterminated"),
    [
        (b"a\r\nb\rc\n", b"a\nb\nc\n", False),
        (b"a\nb\r", b"a\nb\n", False),
        (b"a\nb", b"a\n", True),
        (b"a\n \t\x1a", b"a\n", False),
        (b"a\0\0\0b\n", b"a\0b\n", False),
        (b"\xef\xbb\xbfa\n", b"a\n", False),
        (b"\xff\n", b"\xff\n", False),
    ],
)
@pytest.mark.parametrize("block_bytes", [1, 2, 1 << 22])
def test_lines_of_every_end(
    tmp_path: Path, content: bytes, text: bytes, unterminated: bool, block_bytes: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fieldcal.logs.csv.text.BLOCK_BYTES", block_bytes)
    if b"\0" in content and block_bytes < 4:
        text = content  # a run of NULs is one as far as it lies in one block
    found, left = lines(tmp_path, content)
    assert (found.replace(b"\0", b""), left) == (text.replace(b"\0", b""), unterminated)
    if block_bytes > 4:
        assert found == text


@pytest.mark.parametrize("order", ["le", "be"])
def test_utf_16_without_a_mark_is_told_by_its_zeros(tmp_path: Path, order: str) -> None:
    def read(text: str) -> bytes:
        return lines(tmp_path, text.encode(f"utf-16-{order}"))[0]

    assert read("abcdefg\n") == b"abcdefg\n"  # 8 pairs
    assert read("a,b\n1,2\n\u0174\u0175\n") != "a,b\n1,2\n\u0174\u0175\n".encode()  # 9 of 11 pairs: too few
    assert read("a,b\n1,2\n3,\u0174\n") == "a,b\n1,2\n3,\u0174\n".encode()  # 11 of 12
    assert read("abcdef\n") != b"abcdef\n"  # 7 pairs say too little
    tied = "abcdefgh\u0101\n"  # 9 of 10 pairs is not more than nine tenths
    assert read(tied) != tied.encode()
    (tmp_path / "log.csv").write_bytes(b"\0" * 40)
    assert LineBlocks(tmp_path / "log.csv")._encoding == "utf-8"


def test_a_line_of_a_mebibyte_is_text_and_a_longer_one_is_not(tmp_path: Path) -> None:
    assert lines(tmp_path, b"x" * (1 << 20)) == (b"", True)
    with pytest.raises(UnreadableLog, match="line of over 1048576 bytes"):
        lines(tmp_path, b"x" * ((1 << 20) + 1))


# rows ----------------------------------------------------------------------------------------------------------------

ABC = Dialect(",", ".", ("a", "b", "c"), b"a,b,c", None, 1)


def rows(
    text: str | bytes, of: Dialect = ABC, wanted: tuple[int, ...] = (0, 2)
) -> tuple[list[tuple[str, ...]], list[int], Losses]:
    losses = Losses()
    frame, numbers = read_rows(text if isinstance(text, bytes) else text.encode(), of, 11, wanted, losses)
    assert frame.columns == [str(i) for i in sorted(set(wanted))]
    return frame.rows(), numbers.tolist(), losses


def test_what_is_a_row_and_what_is_counted_as_lost() -> None:
    text = "1,2,3\n\n# c\n4,5,6,\n7,8\n9,10,11,12\na,b,c\n\t \n13,14,\n,,\n1\0,2,3\n15,16,17,x,\n1,2,3,,\n"
    cells, numbers, losses = rows(text)
    assert cells == [("1", "3"), ("4", "6"), ("13", None), (None, None)]
    assert numbers == [11, 14, 19, 20]
    assert losses.counts == {
        ReasonCode.RAGGED_ROW: 4, ReasonCode.NUL_BYTES: 1, ReasonCode.REPEATED_HEADER: 1
    }  # fmt: skip
    assert losses.first_lines == {
        ReasonCode.RAGGED_ROW: 15, ReasonCode.NUL_BYTES: 21, ReasonCode.REPEATED_HEADER: 17
    }  # fmt: skip


def test_two_slashes_begin_a_comment_and_one_does_not() -> None:
    """One alone is a row of one cell."""
    cells, numbers, losses = rows("//,2,3\n/,2,3\na/b,5,6\n//\n7,8,9\n/4,5\n1/,2\n/\n")
    assert cells == [("/", "3"), ("a/b", "6"), ("7", "9")]
    assert numbers == [12, 13, 15]
    assert losses.counts == {ReasonCode.RAGGED_ROW: 3}


@pytest.mark.parametrize("blank", ["", " ", "\t", " \t", "  "])
@pytest.mark.parametrize("place", [0, 1, 2])
def test_blank_lines_are_no_rows_wherever_they_stand(blank: str, place: int) -> None:
    text = ["1,2,3", "4,5,6"]
    cells, numbers, losses = rows("\n".join([*text[:place], blank, *text[place:], ""]))
    assert cells == [("1", "3"), ("4", "6")]
    assert numbers == [11 + (place == 0), 12 + (place < 2)]
    assert losses.counts == {}


def test_a_line_whose_quotes_do_not_close_is_no_row_of_one_column() -> None:
    cells, numbers, losses = rows('1\n"2\n3\n', Dialect(",", ".", ("a",), b"a", None, 1), (0,))
    assert (cells, numbers, losses.counts) == ([("1",), ("3",)], [11, 13], {ReasonCode.RAGGED_ROW: 1})


def test_quotes_are_resolved_and_those_that_do_not_close_cost_their_row() -> None:
    cells, numbers, losses = rows('"1","2","3"\n4,"x, y",6\n"7,8,9\n10,"a""b",12\n1,"2"x,3\n')
    assert cells == [("1", "3"), ("4", "6"), ("10", "12")]
    assert numbers == [11, 12, 14]
    assert (losses.counts, losses.first_lines) == ({ReasonCode.RAGGED_ROW: 2}, {ReasonCode.RAGGED_ROW: 13})


def test_blanks_as_separators_and_decimal_commas() -> None:
    blank = Dialect(" ", ".", ("a", "b", "c"), b"a b c", None, 1)
    assert rows("  1 \t 2  3\n4\t5 6 \na  b c\n", blank)[:2] == ([("1", "3"), ("4", "6")], [11, 12])
    comma = Dialect(";", ",", ("a", "b", "c"), b"a;b;c", None, 1)
    assert rows("1,5;2;3,25\n", comma)[0] == [("1.5", "3.25")]
    assert rows("# only\n")[:2] == ([], [])
    assert rows("1,2,3\n4,5,6,\n", wanted=(0, 1, 2))[0] == [("1", "2", "3"), ("4", "5", "6")]
    assert rows("1,2,3\n4,5,6\n", wanted=(2, 0, 2))[0] == [("1", "3"), ("4", "6")]
    headless = Dialect(",", ".", ("a", "b", "c"), b"", None, 1)
    assert rows("a,b,c\n", headless)[0] == [("a", "c")]


def test_a_line_that_several_tables_lose_counts_once_and_the_first_is_remembered() -> None:
    losses = Losses()
    losses.add(ReasonCode.BAD_NUMBER, np.array([7, 9]))
    losses.add(ReasonCode.BAD_NUMBER, np.array([5, 9]))
    losses.add(ReasonCode.BAD_NUMBER, np.array([5, 7, 9]))
    losses.add(ReasonCode.BAD_TIME, np.array([], int))
    assert losses.counts == {ReasonCode.BAD_NUMBER: 3}
    assert losses.first_lines == {ReasonCode.BAD_NUMBER: 5}
    losses.next_block()
    losses.add(ReasonCode.BAD_NUMBER, np.array([9]))
    assert losses.counts == {ReasonCode.BAD_NUMBER: 4}
    assert losses.first_lines == {ReasonCode.BAD_NUMBER: 5}


def test_cells_as_numbers() -> None:
    values, bad = numbers_of(
        pl.Series(["1.5", " +2 ", "-3e2", "", "NaN", "n/a", " NULL ", "-", None, "x", "inf", "1e999"])
    )
    np.testing.assert_array_equal(values, [1.5, 2.0, -300.0] + [np.nan] * 9)
    assert bad.tolist() == [False] * 9 + [True] * 3
    values, bad = numbers_of(pl.Series(["1", "2"]))
    assert values.tolist() == [1.0, 2.0]
    assert not bad.any()


def test_a_row_that_names_most_columns_in_another_order_is_another_header() -> None:
    def place(*changed: tuple[str, ...]) -> int | None:
        frame = pl.DataFrame([("1", "2", "3", "4"), *changed], schema=["0", "1", "2", "3"], orient="row")
        return other_header(frame, Dialect(",", ".", ("a", "b", "c", "7"), b"", None, 1))

    assert place(("b", "a", "c", "7")) == 1
    assert place(("x", "y", "z", "w"), (" a", "c ", "b", None)) == 2
    assert place(("a", "b", "c", "7")) is None
    assert place(("a", " b ", "c", "x")) == 1
    assert place(("a", "b", "x", "7")) is None  # two of four are not most
    assert place(("1", "2", "3", "7")) is None


# whole files ---------------------------------------------------------------------------------------------------------


def read(tmp_path: Path, content: str, csv: CsvMap | None = None) -> tuple[dict[str, pl.DataFrame], LogSummary]:
    (tmp_path / "log.csv").write_text(content)
    return read_log(tmp_path / "log.csv", vehicle(csv=csv))


@pytest.mark.parametrize("block_bytes", [40, 64, 1 << 22])
def test_lines_and_rows_are_counted_on_from_block_to_block(
    tmp_path: Path, block_bytes: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Rows come at a fixed rate whether they can be read or not; findings name the line of the file."""
    monkeypatch.setattr("fieldcal.logs.csv.text.BLOCK_BYTES", block_bytes)
    body = [f"{i},2,3" for i in range(40)]
    body[10], body[20], body[30], body[35] = "1,2", "x,2,3", "y,2,3", "1,,3"
    frames, summary = read(
        tmp_path, "# made\ngx,gy,gz\nrad/s,rad/s,rad/s\n" + "\n".join(body) + "\n", CsvMap(rate_hz=100.0)
    )
    kept = [i for i in range(40) if i not in (10, 20, 30, 35)]
    assert frames["imu"]["t_ns"].to_list() == [10_000_000 * i for i in kept]
    assert frames["imu"]["gyroscope_x"].to_list() == kept
    told = {finding.code: (finding.count, finding.sentence) for finding in summary.findings}
    assert {code: count for code, (count, _) in told.items()} == {"ragged_row": 1, "bad_number": 2, "incomplete_row": 1}
    for code, line in (("ragged_row", 14), ("bad_number", 24), ("incomplete_row", 39)):
        assert f"the first is line {line}." in told[code][1]
    assert summary.counts == {"imu": 36}


def test_a_file_of_which_most_rows_are_ragged_is_refused_and_half_is_not(tmp_path: Path) -> None:
    frames, _ = read(tmp_path, "t,gx,gy,gz\n" + 3 * "1,2,3,4\n" + 3 * "1,2\n")
    assert frames["imu"].height == 3
    with pytest.raises(UnreadableLog, match="first at line 5") as refused:
        read(tmp_path, "t,gx,gy,gz\n" + 3 * "1,2,3,4\n" + 4 * "1,2\n")
    assert refused.value.reason_code == "ragged_rows"


def test_nothing_behind_another_header_is_read(tmp_path: Path) -> None:
    frames, summary = read(tmp_path, "t,gx,gy,gz\n1,2,3,4\nt,gz,gy,gx\n2,4,3,2\n3,4,3,2\n")
    assert frames["imu"].rows() == [(1_000_000_000, 2.0, 3.0, 4.0, None, None, None)]
    assert [(f.code, f.count, f.loses_data) for f in summary.findings] == [("header_changed", 1, True)]
    assert "the first is line 3." in summary.findings[0].sentence


def test_power_needs_one_of_its_two_and_a_table_only_its_own_cells(tmp_path: Path) -> None:
    text = "t,gx,gy,gz,temp,current_a,throttle\n1,1,1,1,20,5,\n2,1,1,1,,,0.5\n3,1,1,1,x,,\n4,1,1,1,21,6,0.7\n"
    frames, summary = read(tmp_path, text)
    assert frames["imu"]["t_ns"].to_list() == [s * 10**9 for s in (1, 2, 3, 4)]
    assert frames["temperature"].rows() == [(10**9, 20.0), (4 * 10**9, 21.0)]
    power = frames["power"].fill_nan(None).rows()
    assert power == [(10**9, 5.0, None), (2 * 10**9, None, 0.5), (4 * 10**9, 6.0, 0.7)]
    assert [(f.code, f.count) for f in summary.findings] == [("bad_number", 1)]


def test_a_vps_without_its_position_is_kept(tmp_path: Path) -> None:
    text = "t,gx,gy,gz,qx,qy,qz,qw,px,py,pz\n1,1,1,1,0,0,0,1,,,\n2,1,1,1,0,0,0,1,5,6,\n3,1,1,1,0,0,,1,5,6,7\n"
    frames, summary = read(tmp_path, text)
    assert frames["vps"]["t_ns"].to_list() == [10**9, 2 * 10**9]
    assert [(f.code, f.count) for f in summary.findings] == [("incomplete_row", 1)]


def test_a_time_of_iso_8601_is_told_by_the_first_row(tmp_path: Path) -> None:
    text = "t,gx,gy,gz\n\n# pause\n2024-05-01T12:00:00Z,1,2,3\n"
    for comments in ("", 60 * "# made by hand\n"):
        frames, summary = read(tmp_path, comments + text)
        assert frames["imu"]["t_ns"].to_list() == [1714564800 * 10**9]
        assert summary.epoch_known
    frames, summary = read(tmp_path, "t,gx,gy,gz\n5,1,2,3\n2024-05-01T12:00:00Z,1,2,3\n")
    assert frames["imu"]["t_ns"].to_list() == [5 * 10**9]
    assert not summary.epoch_known
    assert [(f.code, f.count) for f in summary.findings] == [("bad_time", 1)]


def test_a_file_without_sensors_lists_its_first_twenty_columns(tmp_path: Path) -> None:
    names = [f"c{i:02d}" for i in range(30)]
    text = ",".join(names) + "\n" + ",".join("1" * 30) + "\n"
    with pytest.raises(UnreadableLog, match=r"it has c00, .*, c19\. Name") as refused:
        read(tmp_path, text)
    assert refused.value.reason_code == "missing_sensor"
    with pytest.raises(UnreadableLog, match=r"among gx, gy, gz, c00, .*, c16\. Name") as refused:
        read(tmp_path, "gx,gy,gz," + text.replace("\n1", "\n1,1,1,1"))
    assert refused.value.reason_code == "missing_time"
