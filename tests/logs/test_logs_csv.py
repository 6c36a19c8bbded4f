"""CSV logs: every way of writing them is read right or refused with a reason, and every row left out is counted."""

from __future__ import annotations

import contextlib
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from logs_support import Flight, vehicle

from fieldcal.config.configuration import CsvMap, Vehicle
from fieldcal.errors import UnreadableLog
from fieldcal.logs import LogSummary, open_log, read_log

HEADER = "t_s,gx,gy,gz,ax,ay,az,mx,my,mz"
GYRO = ["gyroscope_x", "gyroscope_y", "gyroscope_z"]
ACCEL = ["accelerometer_x", "accelerometer_y", "accelerometer_z"]
MAG = ["magnetometer_x", "magnetometer_y", "magnetometer_z"]


class Table:
    """A flight as text: rows of cells that Python's own float can check."""

    def __init__(self, rows: int = 50) -> None:
        flight = Flight(rows)
        self.t_ns = np.arange(rows) * 3_500_000 + 250
        self.values = np.hstack([flight.gyroscope, flight.accelerometer, flight.magnetometer])
        self.rows = [
            [f"{t // 10**9}.{t % 10**9:09d}", *(repr(value) for value in values)]
            for t, values in zip(self.t_ns.tolist(), self.values.tolist(), strict=True)
        ]

    def text(self, header: str | None = HEADER, separator: str = ",", end: str = "\n") -> str:
        """Header and rows, every line ended."""
        lines = [header.replace(",", separator)] if header else []
        return "".join(line + end for line in [*lines, *(separator.join(row) for row in self.rows)])

    def check(self, frames: dict[str, pl.DataFrame], rows: slice | list[int] = slice(None)) -> None:
        """Exactly these rows came back."""
        np.testing.assert_array_equal(frames["imu"]["t_ns"], self.t_ns[rows])
        np.testing.assert_array_equal(frames["imu"].select(GYRO + ACCEL), self.values[rows, :6])
        np.testing.assert_array_equal(frames["magnetometer"].select(MAG), self.values[rows, 6:])


@pytest.fixture(scope="module")
def table() -> Table:
    return Table()


def read(tmp_path: Path, content: str | bytes, of: Vehicle | None = None) -> tuple[dict[str, pl.DataFrame], LogSummary]:
    path = tmp_path / "log.csv"
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return read_log(path, of or vehicle())


def refusal(tmp_path: Path, content: str | bytes, of: Vehicle | None = None) -> UnreadableLog:
    with pytest.raises(UnreadableLog) as caught:
        read(tmp_path, content, of)
    assert "log.csv" in caught.value.sentence
    return caught.value


@pytest.mark.parametrize("separator", [",", ";", "\t", " ", "  \t "])
@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_separators_and_line_ends(tmp_path: Path, table: Table, separator: str, end: str) -> None:
    frames, summary = read(tmp_path, table.text(separator=separator, end=end))
    table.check(frames)
    assert summary.findings == []
    assert not summary.epoch_known
    assert set(summary.units.values()) == {"unknown"}


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "utf-16-le", "utf-16-be"])
def test_encodings(tmp_path: Path, table: Table, encoding: str) -> None:
    frames, summary = read(tmp_path, table.text().encode(encoding))
    table.check(frames)
    assert summary.findings == []


@pytest.mark.parametrize("separator", [";", "\t"])
def test_decimal_comma(tmp_path: Path, table: Table, separator: str) -> None:
    text = table.text(separator=separator).replace(".", ",")
    frames, summary = read(tmp_path, text)
    table.check(frames)
    assert summary.findings == []


def test_decimal_comma_with_comma_separator_is_refused(tmp_path: Path, table: Table) -> None:
    lines = table.text().splitlines()
    body = "\n".join(line.replace(".", ",") for line in lines[1:])
    assert refusal(tmp_path, f"{lines[0]}\n{body}\n").reason_code == "ragged_rows"


def test_blocks_of_any_size_give_the_same(tmp_path: Path, table: Table, monkeypatch: pytest.MonkeyPatch) -> None:
    for size in (1, 7, 100, 1000, 5000):
        monkeypatch.setattr("fieldcal.logs.csv.text.BLOCK_BYTES", size)
        frames, summary = read(tmp_path, table.text(end="\r\n"))
        table.check(frames)
        assert summary.findings == []


def test_a_units_row_gives_the_units(tmp_path: Path, table: Table) -> None:
    lines = table.text().splitlines(keepends=True)
    lines.insert(1, "s,deg/s,deg/s,deg/s,m/s²,m/s²,m/s²,µT,µT,µT\n")
    frames, summary = read(tmp_path, "".join(lines))
    table.check(frames)
    assert summary.units == {"gyroscope": "deg/s", "accelerometer": "m/s^2", "magnetometer": "uT"}
    assert summary.findings == []


@pytest.mark.parametrize(("unit", "scale"), [("ms", 1000), ("us", 1), ("ns", 1)])
def test_time_in_the_units_row_in_the_name_and_configured(tmp_path: Path, unit: str, scale: int) -> None:
    body = "5,1,2,3,4,5,6\n7,1,2,3,4,5,6\n"
    factor = {"ms": 1_000_000, "us": 1000, "ns": 1}[unit]
    texts = [
        f"t,gx,gy,gz,ax,ay,az\n{unit},LSB,LSB,LSB,LSB,LSB,LSB\n",
        f"t_{unit},gx,gy,gz,ax,ay,az\n",
        f"time ({unit}),gx,gy,gz,ax,ay,az\n",
        "t,gx,gy,gz,ax,ay,az\n",
    ]
    names = ["t", f"t_{unit}", f"time ({unit})", "t"]
    for number, (header, name) in enumerate(zip(texts, names, strict=True)):
        csv = CsvMap(imu={"t": name}, time_unit=unit if number == 3 else None)
        frames, _ = read(tmp_path, header + body, vehicle(csv=csv))
        assert frames["imu"]["t_ns"].to_list() == [5 * factor, 7 * factor]


def test_units_in_the_names(tmp_path: Path) -> None:
    axes = ("G {} (deg/s)", "a_{}_gs", "m_{}_microteslas")
    names = ["Time (s)", *(name.format(axis) for name in axes for axis in "xyz")]
    header = ",".join(names)
    imu = {"t": names[0], "gyroscope": tuple(names[1:4]), "accelerometer": tuple(names[4:7])}
    csv = CsvMap(imu={**imu, "magnetometer": tuple(names[7:])})
    frames, summary = read(tmp_path, header + "\n0.5,1,2,3,4,5,6,7,8,9\n", vehicle(csv=csv))
    assert frames["imu"].row(0) == (500_000_000, 1, 2, 3, 4, 5, 6)
    assert summary.units == {"gyroscope": "deg/s", "accelerometer": "g", "magnetometer": "uT"}
    _, summary = read(
        tmp_path, header + "\n0.5,1,2,3,4,5,6,7,8,9\n", vehicle(csv=csv, units={"accelerometer": "m/s^2"})
    )
    assert summary.units["accelerometer"] == "m/s^2"
    assert [finding.code for finding in summary.findings] == ["unit_conflict"]


def test_iso8601_times_are_epoch(tmp_path: Path) -> None:
    text = "t,gx,gy,gz,ax,ay,az\n2024-05-01T12:00:00.123456789Z,1,2,3,4,5,6\n2024-05-01 12:00:01,1,2,3,4,5,6\n"
    frames, summary = read(tmp_path, text)
    assert frames["imu"]["t_ns"].to_list() == [1714564800123456789, 1714564801000000000]
    assert summary.epoch_known


def test_sample_numbers_and_rows_without_time(tmp_path: Path) -> None:
    body = "".join(f"{number},1,2,3,4,5,6\n" for number in (0, 1, 5))
    csv = CsvMap(rate_hz=100.0, imu={"t": "sample"})
    frames, _ = read(tmp_path, "sample,gx,gy,gz,ax,ay,az\n" + body, vehicle(csv=csv))
    assert frames["imu"]["t_ns"].to_list() == [0, 10_000_000, 50_000_000]
    untimed = "gx,gy,gz\n1,2,3\n4,5,6\n7,8,9\n"
    frames, summary = read(tmp_path, untimed, vehicle(csv=CsvMap(rate_hz=250.0)))
    assert frames["imu"]["t_ns"].to_list() == [0, 4_000_000, 8_000_000]
    assert frames["imu"]["accelerometer_x"].null_count() == 3
    assert not summary.epoch_known
    assert refusal(tmp_path, untimed).reason_code == "missing_time"


def test_an_unterminated_last_row_is_dropped_and_told(tmp_path: Path, table: Table) -> None:
    text = table.text()
    for cut in (1, 3, 60):
        frames, summary = read(tmp_path, text[:-cut])
        table.check(frames, slice(-1))
        assert [(f.code, f.count, f.loses_data) for f in summary.findings] == [("unterminated_row", 1, True)]


def test_a_time_behind_the_cells_of_a_short_first_row(tmp_path: Path) -> None:
    frames, summary = read(tmp_path, "gx,gy,gz,t_s\n1,2,3\n1,2,3,0.5\n4,5,6,0.6\n7,8,9,0.7\n")
    assert frames["imu"]["t_ns"].to_list() == [500_000_000, 600_000_000, 700_000_000]
    assert [(f.code, f.count) for f in summary.findings] == [("ragged_row", 1)]


def test_a_row_with_half_a_sensor_and_no_time_is_counted_once(tmp_path: Path) -> None:
    _, summary = read(tmp_path, "t_s,gx,gy,gz\n0.1,1,2,3\nx,1,,3\nx,1,2,3\n0.4,1,2,3\n")
    assert [(f.code, f.count) for f in summary.findings] == [("incomplete_row", 1), ("bad_time", 1)]


def test_headers_alone_are_no_rows(tmp_path: Path) -> None:
    """However often: none of them is ragged."""
    assert refusal(tmp_path, (HEADER + "\n") * 3).reason_code == "no_rows"


def test_short_long_damaged_and_wordy_rows_are_counted_with_their_line(tmp_path: Path, table: Table) -> None:
    lines = table.text().splitlines()
    lines[5] = "1.0,2.0"
    lines[6] = lines[6] + ",1"
    lines[10] = lines[10].replace(".", "x", 2)
    lines[12] = lines[12][:20] + "\0" + lines[12][21:]
    lines[20] = "later" + lines[20][lines[20].index(",") :]
    lines[30] = ",".join([*lines[30].split(",")[:6], "", *lines[30].split(",")[7:]])
    frames, summary = read(tmp_path, "\n".join(lines) + "\n")
    table.check(
        frames | {"magnetometer": frames["magnetometer"].filter(pl.col("t_ns") != table.t_ns[29])},
        kept := [row for row in range(50) if row not in (4, 5, 9, 11, 19, 29)],
    )
    assert len(kept) == 44
    told = {finding.code: (finding.count, finding.sentence) for finding in summary.findings}
    assert told.keys() == {"ragged_row", "bad_number", "nul_bytes", "bad_time", "incomplete_row"}
    assert told["ragged_row"][0] == 2
    for code, line in (
        ("ragged_row", 6),
        ("bad_number", 11),
        ("nul_bytes", 13),
        ("bad_time", 11),
        ("incomplete_row", 31),
    ):
        assert f"line {line}." in told[code][1]
        assert (" is none: " in told[code][1]) == (code == "bad_time")
    assert all(finding.loses_data for finding in summary.findings)


def test_comments_empty_lines_quotes_and_a_repeated_header(tmp_path: Path, table: Table) -> None:
    lines = table.text().splitlines()
    quoted = [",".join(f'"{cell}"' for cell in line.split(",")) for line in lines]
    text = "\n".join(["# made by hand", "", *lines[:20], "# pause", "", lines[0], *quoted[20:]]) + "\n"
    frames, summary = read(tmp_path, text)
    table.check(frames)
    assert [(finding.code, finding.loses_data) for finding in summary.findings] == [("repeated_header", False)]


def test_quotes_that_do_not_close_cost_their_own_row(tmp_path: Path, table: Table) -> None:
    lines = table.text().splitlines()
    lines[3] = '"' + lines[3]
    lines[7] = lines[7].replace(",", '",', 1)
    lines[9] = lines[9].replace(",", '","', 1)
    frames, summary = read(tmp_path, "\n".join(lines) + "\n")
    kept = [row for row in range(50) if row not in (2, 6, 8)]
    table.check(frames, kept)
    assert sum(finding.count for finding in summary.findings if finding.loses_data) == 3


def test_a_commented_header_is_a_header(tmp_path: Path, table: Table) -> None:
    frames, _ = read(tmp_path, "# recorded indoors\n# " + table.text())
    table.check(frames)


def test_a_slower_magnetometer_leaves_cells_empty(tmp_path: Path, table: Table) -> None:
    slow = Table()
    for number, row in enumerate(slow.rows):
        if number % 4:
            row[7:] = ["", "nan", "NULL"]
    frames, summary = read(tmp_path, slow.text())
    np.testing.assert_array_equal(frames["imu"]["t_ns"], table.t_ns)
    np.testing.assert_array_equal(frames["magnetometer"].select(MAG), table.values[::4, 6:])
    assert summary.findings == []


def test_imu_and_vps_in_one_file(tmp_path: Path, table: Table) -> None:
    both = Table()
    for number, row in enumerate(both.rows):
        row += ["0.0", "0.6", "0.0", "0.8", "1", "2", "3"] if number % 2 else [""] * 7
    frames, summary = read(tmp_path, both.text(HEADER + ",qx,qy,qz,qw,px,py,pz"))
    table.check(frames)
    np.testing.assert_array_equal(frames["vps"]["t_ns"], table.t_ns[1::2])
    assert frames["vps"].row(0)[1:] == (0.0, 0.6, 0.0, 0.8, 1.0, 2.0, 3.0)
    assert summary.findings == []


def test_a_folder_and_one_with_a_broken_vps(tmp_path: Path, table: Table) -> None:
    (tmp_path / "imu.csv").write_text(table.text())
    (tmp_path / "vps.csv").write_text("t_s,qx,qy,qz,qw\n1.5,0,0,0,1\n")
    frames, summary = read_log(tmp_path, vehicle())
    table.check(frames)
    assert frames["vps"].row(0) == (1_500_000_000, 0, 0, 0, 1, None, None, None)
    assert summary.counts == {"imu": 50, "magnetometer": 50, "vps": 1}
    for broken in ("", "1,2,3\n", "t_s,qx,qy,qz\n1,2,3,4\n", "t_s,qx,qy,qz,qw\n1,2\n"):
        (tmp_path / "vps.csv").write_text(broken)
        frames, summary = read_log(tmp_path, vehicle())
        table.check(frames)
        assert [(f.code, f.count, f.loses_data) for f in summary.findings] == [("vps_unreadable", 1, True)]


@pytest.mark.parametrize(
    ("text", "code", "words"),
    [
        ("", "empty_file", "empty"),
        ("\n\n", "no_rows", "no rows"),
        (HEADER + "\n", "no_rows", "not one usable row"),
        (HEADER, "no_rows", ""),
        ("0.1,1,2,3,4,5,6\n0.2,1,2,3,4,5,6\n", "missing_header", "no header"),
        (
            "t_s,gx,gy,ax,ay,az\n0,1,2,3,4,5\n",
            "missing_column",
            "no column 'gz' (csv.imu.gyroscope); nearest: 'gy', 'gx', 'az'",
        ),
        ("t_s,gx,gy,gz,gx\n0,1,2,3,4\n", "duplicate_column", "2 columns named 'gx'"),
        ("t_s,speed,height\n0,1,2\n", "missing_sensor", "t_s, speed, height"),
        (b"\x7fELF\x02\x01\x01" + bytes(200), "no_rows", ""),
        (b"\0\1\2\3" * 100 + b"\n" * 20, "not_text", ""),
        ("x" * 3_000_000, "not_text", "line of over"),
    ],
)
def test_refusals(tmp_path: Path, text: str | bytes, code: str, words: str) -> None:
    error = refusal(tmp_path, text)
    assert error.reason_code == code
    assert words in error.sentence


def test_a_configured_column_that_is_not_there(tmp_path: Path, table: Table) -> None:
    csv = CsvMap(imu={"gyroscope": ("gyr_x", "gyr_y", "gyr_z"), "t": "t_s"})
    error = refusal(tmp_path, table.text(), vehicle(csv=csv))
    assert error.reason_code == "missing_column"
    assert "'gyr_x' (csv.imu.gyroscope)" in error.sentence


def test_axes_in_different_units_are_told(tmp_path: Path) -> None:
    text = "t_s,gx,gy,gz\ns,rad/s,rad/s,deg/s\n0,1,2,3\n"
    _, summary = read(tmp_path, text)
    assert summary.units["gyroscope"] == "unknown"
    assert [finding.code for finding in summary.findings] == ["unit_conflict"]


def test_random_damage_is_read_or_refused(tmp_path: Path, table: Table) -> None:
    generator = np.random.default_rng(4)
    content = table.text().encode()
    for _ in range(150):
        damaged = bytearray(content)
        for place in generator.integers(0, len(content), int(generator.integers(1, 20))):
            damaged[place] = generator.integers(0, 256)
        path = tmp_path / "log.csv"
        path.write_bytes(bytes(damaged[: int(generator.integers(1, len(content)))]))
        with contextlib.suppress(UnreadableLog):
            for _, columns in open_log(path, vehicle()).batches():
                assert len({len(column) for column in columns.values()}) == 1
