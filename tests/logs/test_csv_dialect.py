"""Where a CSV file's header is and how its times read, in small tables: each case stands at the limit of a rule."""

from __future__ import annotations

from datetime import UTC, datetime
from decimal import Decimal

import polars as pl
import pytest

from fieldcal.errors import UnreadableLog
from fieldcal.logs.csv.dialect import comment_lines, find_dialect, header_place
from fieldcal.logs.csv.time import looks_iso8601, looks_time_of_day, nanoseconds, sample_numbers

S = 10**9
ROW, TITLE = "1,2,3,4", "made by hand"


def of_day(hours: int, minutes: int, seconds: int, below_ns: int = 0) -> int:
    return ((hours * 60 + minutes) * 60 + seconds) * S + below_ns


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("23:59:59", of_day(23, 59, 59)),
        ("24:00:00", None),
        ("7:05:09", of_day(7, 5, 9)),
        ("07:05:09,5", of_day(7, 5, 9, S // 2)),
        ("07:05:09.1234567894", of_day(7, 5, 9, 123_456_789)),
        ("07:05:09.1234567895", of_day(7, 5, 9, 123_456_790)),
        ("07:05:09.12345678949", of_day(7, 5, 9, 123_456_789)),
        ("23:59:59.9999999995", of_day(24, 0, 0)),
        ("0:60:00", None),
        ("0:00:60", None),
        ("00:00", None),
    ],
)
def test_times_of_day(text: str, expected: int | None) -> None:
    assert nanoseconds(pl.Series([text]), "time_of_day").to_list() == [expected]
    assert looks_time_of_day(f" {text} ") is (expected is not None or text == "24:00:00")


@pytest.mark.parametrize(
    ("zone", "east_s"),
    [("", 0), ("Z", 0), ("z", 0), ("+05:30", 19_800), ("-03:30", -12_600), ("+0100", 3600), ("-1200", -43_200)],
)
@pytest.mark.parametrize(
    ("fraction", "below"),
    [
        ("", 0),
        (".5", S // 2),
        (",25", S // 4),
        (".1234567894", 123_456_789),
        (".1234567895", 123_456_790),
        (".12345678949", 123_456_789),
        (".9999999995", S),
    ],
)
def test_dates_in_zones(zone: str, east_s: int, fraction: str, below: int) -> None:
    begin = int(datetime(2024, 2, 29, 12, 34, 56, tzinfo=UTC).timestamp())
    text = f"2024-02-29T12:34:56{fraction}{zone}"
    assert looks_iso8601(text)
    assert nanoseconds(pl.Series([text]), "iso8601").to_list() == [(begin - east_s) * S + below]


def test_dates_end_where_nanoseconds_do() -> None:
    """2^63 ns are 9223372036.85… s; the last whole second before is refused too."""
    cells = ["2262-04-11T23:47:15Z", "2262-04-11T23:47:16Z", "1677-09-21T00:12:45Z", "1677-09-21T00:12:44Z"]
    assert nanoseconds(pl.Series(cells), "iso8601").to_list() == [9_223_372_035 * S, None, -9_223_372_035 * S, None]


def test_times_as_numbers_round_half_up_and_end_where_nanoseconds_do() -> None:
    cells = [
        "1.0000000004",
        "1.0000000005",
        "1.00000000049",
        "-1.0000000005",
        "9223372035.9",
        "9223372036",
        "-0.5",
        "+2",
    ]
    wanted = [S, S + 1, S, -S - 1, 9_223_372_035_900_000_000, None, -S // 2, 2 * S]
    assert nanoseconds(pl.Series(cells), "s").to_list() == wanted
    most = 2**63 - 2
    cells = ["7.4", "7.5", "7.49", str(most), str(most + 1)]
    assert nanoseconds(pl.Series(cells), "ns").to_list() == [7, 8, 7, most, None]
    assert nanoseconds(pl.Series(["12", "0.00015"]), "100us").to_list() == [1_200_000, 15]


def test_a_time_with_an_exponent_has_at_most_a_hundred_characters() -> None:
    whole, longer = (f"1.{'0' * zeros}e0" for zeros in (96, 97))
    assert (len(whole), len(longer)) == (100, 101)
    cells = [whole, longer, None, "1e-9", "15e-10", "14e-10", "-15e-10", "1e9999", ".5e1", "2E+3"]
    wanted = [int((Decimal(text).scaleb(9) + Decimal("0.5")) // 1) for text in ("1e-9", "15e-10", "14e-10")]
    found = nanoseconds(pl.Series(cells, dtype=pl.String), "s").to_list()
    assert found == [S, None, None, *wanted, -2, None, 5 * S, 2000 * S]


def test_sample_numbers_are_whole_and_exact() -> None:
    cells = [
        "0",
        " 7 ",
        "-3",
        "2.0",
        "2.5",
        "",
        "x",
        "inf",
        "nan",
        str(2**53 - 1),
        str(2**53),
        str(1 - 2**53),
        str(-(2**53)),
        None,
    ]
    wanted = [0, 7, -3, 2, None, None, None, None, None, 2**53 - 1, None, 1 - 2**53, None, None]
    assert sample_numbers(pl.Series(cells, dtype=pl.String)).to_list() == wanted


# header --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("lines", "place"),
    [
        (["t,a,b,c", ROW, ROW], 0),
        ([TITLE, "t,a,b,c", ROW, ROW], 1),
        (["k,v", "rate,100", "t,a,b,c", ROW, ROW, ROW, ROW], 2),
        ([TITLE, "t,a,b,c", "s,deg,deg,deg", ROW, ROW, ROW], 1),  # a row of units between
        ([TITLE, "s,deg,deg,deg", ROW, ROW, ROW], 0),  # which is no header
        (["s,deg,deg,deg", ROW, ROW], 0),
        ([TITLE, "t,a,b", ROW, ROW, ROW], 1),  # rows may end with a separator
        ([TITLE, "t,a", ROW, ROW, ROW], 0),
        ([TITLE, "t,a,b,c,d", ROW, ROW, ROW], 0),
        ([TITLE, "9,8,7,6", ROW, ROW, ROW], 0),  # names are no numbers
        ([TITLE, ",,,", ROW, ROW, ROW], 0),
        ([TITLE, "9,a,b,6", ROW, ROW, ROW], 1),
        ([TITLE, "t,a,b", "1,2,3", "1,2,3", "1,2,3"], 0),  # a time and two axes are too little
        ([TITLE, "t,a,b,c", ROW], 0),  # of one row nothing can be told
        ([TITLE, "t,a,b,c", ROW, "x"], 0),  # as many that are none
        ([TITLE, "t,a,b,c", ROW, ROW, "x"], 1),
        ([TITLE, "t,a,b,c", ROW, "x", "y", ROW, ROW, ROW], 1),
        ([ROW, "x", ROW, "y", "t,a,b,c", ROW, ROW, ROW], 0),
        (["t,a,b,c", ROW, "x"], 0),
        (["t,a,b,c", ROW, "x", "y"], 0),
        (["t;a;b;c", "1;2;3;4", "1;2;3;4"], 0),
        (["made", "t a b c", "1 2 3 4", "1 2 3 4"], 1),
        (["made", "t\ta\tb\tc", "1\t2\t3\t4", "1\t2\t3\t4"], 1),
        ([TITLE, "t;a;b;c", "1,5;2;3;4", "1;2,5;3;4"], 1),
        ([TITLE, "t,a,b,c", "1,x,y,4", "1,x,y,4"], 0),  # as many words as numbers
        ([TITLE, "t,a,b,c", "1,x,3,4", "1,x,3,4"], 1),
        ([TITLE, "t,a,b,c", "1,,,x", "1,,,x"], 0),
        (["Format Version,1.23", "Frame,Time,X", "0,0.1,1"], 1),
        (["Format Version,1.23", "0,0.1,1"], 0),
        (["t,a,b,c", "Frame,Time,X", "0,0.1,1"], 0),
    ],
)
def test_the_header_is_the_line_above_the_rows(lines: list[str], place: int) -> None:
    assert header_place(lines, None, None) == place


def test_half_of_the_lines_looked_at_are_no_rows_of_the_first_line() -> None:
    """Where most lines fit the first, it is the header, whatever may stand below."""
    below = ["t,a,b,c,d,e", *["1,2,3,4,5,6"] * 3]
    for rows, place in ((3, 4), (4, 5), (5, 0), (6, 0)):
        assert header_place(["t,a,b", *["1,2,3"] * rows, *below], None, None) == place


@pytest.mark.parametrize(("cell", "decimal", "place"), [("1,5", None, 1), ("1,5", ",", 1), ("1,5", ".", 0)])
def test_a_decimal_comma_is_a_number_unless_points_are_configured(cell: str, decimal: str | None, place: int) -> None:
    row = ";".join([cell] * 4)
    assert header_place([TITLE, "t;a;b;c", row, row], None, decimal) == place


def test_comments_above_and_how_far_a_header_is_looked_for() -> None:
    assert [comment_lines(text) for text in (b"", b"t,a\n", b"# a\n\n // b\nt\n# c\n", b"# a")] == [0, 0, 3, 0]
    header = "t,gx,gy,gz\n" + "1,2,3,4\n" * 3
    for lines, found in ((997, True), (998, False)):  # of a thousand lines two have to be rows
        text = ("title\n" * lines + header).encode()
        assert (find_dialect(text, "log", None, None).names == ("t", "gx", "gy", "gz")) is found
    for comments in (0, 199, 200, 201, 1500):
        text = ("# made\n" * comments + "k,v\n" + header).encode()
        found_dialect = find_dialect(text, "log", None, None)
        assert (found_dialect.header_line, found_dialect.first_row) == (comments + 2, comments + 2)
        assert found_dialect.preamble == 1


@pytest.mark.parametrize("content", [b"a\0b,c\n1,2\n", b"a\x01b,c\n1,2\n", b"\0\x01\n1,2\n"])
def test_a_header_of_other_than_text_is_none(content: bytes) -> None:
    with pytest.raises(UnreadableLog) as refused:
        find_dialect(content, "log", None, None)
    assert refused.value.reason_code == "not_text"


def test_a_header_may_have_tabs() -> None:
    assert find_dialect(b"t\tgx\n1\t2\n", "log", None, None).names == ("t", "gx")


def test_words_with_a_point_are_no_numbers_with_one() -> None:
    assert find_dialect(b"a;b\n1,5;x.y\n2;z.w\n", "log", None, None).decimal == ","
    assert find_dialect(b"a;b\n1,5;2\n2;3\n", "log", None, None).decimal == ","
    assert find_dialect(b"a;b\n1;2\n2;3\n", "log", None, None).decimal == "."


def test_a_name_is_kept_up_to_two_hundred_characters() -> None:
    found = find_dialect(f"t,{'x' * 200},{'y' * 201}\n1,2,3\n".encode(), "log", None, None)
    assert [len(name) for name in found.names] == [1, 200, 200]
