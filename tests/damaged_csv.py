"""Damaged and oddly written CSV logs, made from one table of numbers, with the rows that must come back."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from fieldcal.config.configuration import CsvMap

OK, LOSSY, CONTRADICTORY, NOTHING = ("ok",), ("partial",), ("quarantined",), ("rejected",)
NAMES = ("t_s", "gx", "gy", "gz", "ax", "ay", "az")
STEP_NS = 5_000_000
ROWS = 400


@dataclass(frozen=True)
class Written:
    """One file. `rows`: the rows of the table that must come back, no other (None: any of them, unaltered)."""

    name: str
    content: bytes
    verdicts: tuple[str, ...] = OK
    rows: tuple[int, ...] | None = None
    csv: CsvMap = field(default_factory=CsvMap)
    says: str = ""


class Table:
    """Stamps (n,) in ns and readings (n, 6), with six digits behind the point."""

    def __init__(self, rows: int = ROWS) -> None:
        rng = np.random.default_rng(12)
        self.t_ns = np.arange(rows) * STEP_NS
        self.micro = rng.integers(-9_000_000, 9_000_000, (rows, 6))
        self.values = self.micro / 1e6

    def cells(self, row: int) -> list[str]:
        """The cells of one row."""
        t = int(self.t_ns[row])
        return [f"{t // 10**9}.{t % 10**9:09d}", *(f"{value:.6f}" for value in self.values[row])]

    def lines(self, separator: str = ",") -> list[str]:
        """Header and rows."""
        return [separator.join(NAMES), *(separator.join(self.cells(row)) for row in range(len(self.t_ns)))]


EVERY = tuple(range(ROWS))


def without(*rows: int) -> tuple[int, ...]:
    return tuple(row for row in EVERY if row not in rows)


def joined(lines: list[str], end: str = "\n") -> bytes:
    return "".join(line + end for line in lines).encode()


def written_files(table: Table) -> Iterator[Written]:
    """Every kind, from one table."""
    yield from _dialects(table)
    yield from _headers(table)
    yield from _rows(table)
    yield from _cuts(table)
    yield from _times(table)
    yield from _floods(table)


def _dialects(table: Table) -> Iterator[Written]:
    for name, separator in (("comma", ","), ("semicolon", ";"), ("tab", "\t"), ("blanks", "  ")):
        for end_name, end in (("LF", "\n"), ("CR LF", "\r\n"), ("CR", "\r"), ("CR CR LF", "\r\r\n")):
            yield Written(f"{name}, {end_name}", joined(table.lines(separator), end), OK, EVERY)
    plain = joined(table.lines())
    for encoding in ("utf-8-sig", "utf-16", "utf-16-le", "utf-16-be"):
        yield Written(f"encoding {encoding}", plain.decode().encode(encoding), OK, EVERY)
    yield Written("encoding utf-32", plain.decode().encode("utf-32"), NOTHING)
    yield Written("UTF-16 cut inside a character", plain.decode().encode("utf-16")[:-3], LOSSY, without(ROWS - 1))
    for name, separator in (("semicolon", ";"), ("tab", "\t")):
        comma = joined(table.lines(separator)).replace(b".", b",")
        yield Written(f"decimal comma, {name}", comma, OK, EVERY)
    lines = table.lines()
    comma = joined([lines[0], *(line.replace(".", ",") for line in lines[1:])])
    yield Written("decimal comma between commas", comma, NOTHING, says="separator")
    quoted = joined([lines[0], *(",".join(f'"{cell}"' for cell in line.split(",")) for line in lines[1:])])
    yield Written("every cell quoted", quoted, OK, EVERY)
    named = joined([",".join(f'"{n}"' for n in NAMES), *lines[1:]])
    yield Written("the header quoted", named, OK, EVERY)
    for separator in (";", ","):
        excel = joined([f"sep={separator}", *table.lines(separator)], "\r\n")
        yield Written(f"a spreadsheet's line sep={separator}", excel, OK, EVERY)
    yield Written("a separator behind every row", joined([line + "," for line in lines]), OK, EVERY)
    yield Written("blanks about every cell", joined([line.replace(",", " , ") for line in lines]), OK, EVERY)
    yield Written(
        "plus signs", joined([lines[0], *(line.replace(",", ",+").replace("+-", "-") for line in lines[1:])]), OK, EVERY
    )


def _headers(table: Table) -> Iterator[Written]:
    lines = table.lines()
    yield Written("no header", joined(lines[1:]), NOTHING, says="header")
    yield Written("a header in a comment", joined(["# " + lines[0], *lines[1:]]), OK, EVERY)
    yield Written("comments before the header", joined(["# made by hand", "#", *lines]), OK, EVERY)
    yield Written("empty lines before the header", b"\n\r\n\n" + joined(lines), OK, EVERY)
    yield Written("a line of prose before the header", joined(["Recorded on Tuesday", *lines]), OK, EVERY)
    yield Written("a units row", joined([lines[0], "s,rad/s,rad/s,rad/s,m/s^2,m/s^2,m/s^2", *lines[1:]]), OK, EVERY)
    yield Written(
        "a units row of other units", joined([lines[0], "s,mdps,mdps,mdps,mg,mg,mg", *lines[1:]]), says="converted"
    )
    yield Written(
        "a column's name twice", joined([lines[0].replace("gy", "gx"), *lines[1:]]), NOTHING, says="2 columns"
    )
    two = joined([lines[0] + ",note,note", *(line + ",1,2" for line in lines[1:])])
    yield Written("another column's name twice", two, OK, EVERY)
    yield Written("an axis missing", joined([lines[0].replace("gz", "gw"), *lines[1:]]), NOTHING, says="gz")
    yield Written("no time", joined([line.split(",", 1)[1] for line in lines]), NOTHING, says="time")
    yield Written("a header alone", joined(lines[:1]), NOTHING)
    yield Written("bytes of another alphabet in the header", joined(lines).replace(b"az", b"az,\xb0C", 1), NOTHING)
    yield Written("the header again", joined([*lines[:200], lines[0], *lines[200:]]), OK, EVERY)
    other = ",".join([NAMES[0], *NAMES[4:], *NAMES[1:4]])
    yield Written(
        "another header mid-file",
        joined([*lines[:200], other, *lines[200:]]),
        LOSSY,
        tuple(range(199)),
        says="line 201",
    )
    yield Written("another header of other width", joined([*lines[:200], "a,b,c", *lines[200:]]), LOSSY, EVERY)


def _rows(table: Table) -> Iterator[Written]:
    lines = table.lines()

    def changed(row: int, text: str) -> bytes:
        return joined([*lines[: row + 1], text, *lines[row + 2 :]])

    cells = table.cells(50)
    swaps = {
        "a short row": ",".join(cells[:-1]),
        "a long row": ",".join([*cells, "1"]),
        "a row of words": ",".join(["later", *cells[1:]]),
        "a cell of words": ",".join([*cells[:3], "x", *cells[4:]]),
        "a cell with two points": ",".join([*cells[:3], "1.2.3", *cells[4:]]),
        "a hexadecimal cell": ",".join([*cells[:3], "0x1F", *cells[4:]]),
        "an infinite cell": ",".join([*cells[:3], "inf", *cells[4:]]),
        "an empty cell": ",".join([*cells[:3], "", *cells[4:]]),
        "a cell nan": ",".join([*cells[:3], "nan", *cells[4:]]),
        "a cell with a minus of typographers": ",".join([*cells[:3], "−1.5", *cells[4:]]),
        "a thousands separator": ",".join([*cells[:3], "1'000.5", *cells[4:]]),
        "a quote that does not close": '"' + ",".join(cells),
        "two rows in one line": ",".join(cells) + lines[60],
        "NUL bytes": ",".join(cells)[:20] + "\0" * 5 + ",".join(cells)[25:],
        "an empty time": ",".join(["", *cells[1:]]),
        "a time beyond all bounds": ",".join(["99999999999999", *cells[1:]]),
    }
    for name, text in swaps.items():
        yield Written(name, changed(50, text), LOSSY, without(50), says="line 52")
    raw = joined(lines)
    at = raw.index(lines[51].encode()) + 10
    for name, size in (("4 KB", 4096), ("3 MB", 3 << 20)):
        block = raw[:at] + bytes(size) + raw[at:]
        yield Written(f"{name} of NUL inside a row", block, LOSSY, without(50), says="line 52")
        yield Written(f"{name} of NUL at the end", raw + bytes(size), LOSSY, EVERY)
    yield Written("bytes that are no text", raw[:at] + b"\xff\xfe\x80" + raw[at + 3 :], LOSSY, without(50))
    yield Written("comments and empty lines between", joined([*lines[:90], "", "# pause", *lines[90:]]), OK, EVERY)
    yield Written("rows of blanks", joined([*lines[:90], "   ", "\t", *lines[90:]]), OK, EVERY)
    yield Written("a row twice", joined([*lines[:90], lines[89], *lines[90:]]), OK, EVERY)
    twice = lines[89].replace(lines[89].split(",")[2], "9.5", 1)
    yield Written("a stamp twice with other values", joined([*lines[:90], twice, *lines[90:]]), LOSSY, EVERY)
    yield Written("rows out of order", joined([*lines[:90], *lines[100:110], *lines[90:100], *lines[110:]]), OK, EVERY)
    mixed = [lines[0], *(line.replace(",", ";") if i % 2 else line for i, line in enumerate(lines[1:]))]
    yield Written("every other row with another separator", joined(mixed), (*LOSSY, *NOTHING))


def _cuts(table: Table) -> Iterator[Written]:
    raw = joined(table.lines())
    for cut in (1, 2, 5, 30):
        yield Written(f"cut {cut} bytes before the end", raw[:-cut], LOSSY, without(ROWS - 1))
    yield Written("cut inside the header", raw[:5], NOTHING)
    yield Written("cut behind the header", raw[: raw.index(b"\n") + 1], NOTHING)
    yield Written("cut inside the first row", raw[: raw.index(b"\n") + 9], NOTHING)
    yield Written("a Ctrl-Z at the end", raw + b"\x1a", OK, EVERY)


def _times(table: Table) -> Iterator[Written]:
    lines = table.lines()

    def stamped(name: str, stamps: list[str]) -> bytes:
        rows = zip(stamps, lines[1:], strict=True)
        return joined([lines[0].replace("t_s", name), *(f"{t},{line.split(',', 1)[1]}" for t, line in rows)])

    t = table.t_ns.tolist()
    yield Written("time in ms", stamped("t_ms", [f"{x / 1e6:.3f}" for x in t]), OK, EVERY)
    yield Written("time in us", stamped("t_us", [str(x // 1000) for x in t]), OK, EVERY)
    yield Written("time in ns", stamped("t_ns", [str(x) for x in t]), OK, EVERY)
    iso = [f"1970-01-01T00:00:{x // 10**9:02d}.{x % 10**9:09d}Z" for x in t]
    yield Written("time in ISO 8601", stamped("time", iso), OK, EVERY)
    yield Written(
        "milliseconds where seconds are meant", stamped("t", [f"{x / 1e6:g}" for x in t]), CONTRADICTORY, says="Hz"
    )
    yield Written(
        "microseconds where seconds are meant", stamped("t", [str(x // 1000) for x in t]), CONTRADICTORY, says="Hz"
    )
    rounded = [f"{1.7e9 + x / 1e9:.3e}" for x in t]
    yield Written("times that a spreadsheet rounded", stamped("t_s", rounded), NOTHING, says="same time")


def _floods(table: Table) -> Iterator[Written]:
    lines = table.lines()
    yield Written("empty", b"", NOTHING)
    yield Written("zeros", bytes(1 << 20), NOTHING)
    yield Written("noise", np.random.default_rng(2).bytes(1 << 20), NOTHING)
    yield Written("one line of 9 MB", b"1," * 4_500_000, NOTHING)
    yield Written("9 MB of line ends", b"\n" * 9_000_000, NOTHING)
    yield Written("9 MB of separators and line ends", joined(lines) + b",\n" * 4_500_000, (*LOSSY, *NOTHING))
    yield Written("9 MB of quotes", joined(lines) + b'"\n' * 4_500_000, (*LOSSY, *NOTHING))
    wide = ",".join(f"c{i}" for i in range(150_000))
    yield Written(
        "150,000 columns",
        joined([lines[0] + "," + wide, *(line + ",1" * 150_000 for line in lines[1:6])]),
        (*OK, *NOTHING),
    )
    yield Written("a quoted title of 900 KB", b'"' + b"x" * 900_000 + b'"\n' + joined(lines), OK, EVERY)
    yield Written("an open quote of 900 KB", joined(lines[:90]) + b'"' + b"x" * 900_000 + b"\n", LOSSY)
    row = b"0,1,2,3,4,5,6\n"
    yield Written("9 MB of the same row", lines[0].encode() + b"\n" + row * (9_000_000 // len(row)), NOTHING)
    dense = "".join(f"{i}e-4,1,2,3,4,5,6\n" for i in range(450_000))
    yield Written("9 MB of short rows", (lines[0] + "\n" + dense).encode(), OK, ())
    yield Written("an MCAP by another name", b"\x89MCAP0\r\n" + struct.pack("<BQ", 1, 8) + bytes(8), NOTHING)
