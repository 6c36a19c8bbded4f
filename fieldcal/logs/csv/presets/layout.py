"""What presets look at, and what they say: the words in which every known CSV format is described."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from fieldcal.config.values import Paths
from fieldcal.logs.csv.dialect import Dialect, cells_of, is_number, line_text
from fieldcal.names import Body, CsvPreset, GravitySign, World

XYZ = ("x", "y", "z")
ATTITUDES = ("quaternion_xyzw", "quaternion_wxyz", "roll_pitch_yaw", "rotation_matrix", "rotation_vector")
"""Keys under which an attitude may stand. The last two are presets' alone: nine cells of the matrix from body to world,
column by column; a rotation vector from body to world."""


@dataclass(frozen=True)
class Layout:
    """The beginning of a file: names of its columns, cells of its units row (none: empty), the lines above its header,
    the cells of its first row."""

    names: tuple[str, ...]
    units: tuple[str, ...]
    above: tuple[str, ...]
    first_cells: tuple[str, ...]
    separator: str

    def has(self, *names: str) -> bool:
        """Whether columns of these names are there, each once."""
        return all(self.names.count(name) == 1 for name in names)

    def cell(self, name: str) -> str:
        """What the first row has in a column."""
        place = self.names.index(name)
        return self.first_cells[place] if place < len(self.first_cells) else ""

    def above_cells(self, from_header: int) -> list[str]:
        """Cells of the line so many above the header (1: the one next to it), as many as there are columns."""
        cells = cells_of(self.above[-from_header], self.separator) if len(self.above) >= from_header else []
        return (cells + [""] * len(self.names))[: len(self.names)]


def layout_of(block: bytes, dialect: Dialect, first_cells: list[str]) -> Layout:
    """The layout of a file whose first lines are `block`."""
    above = tuple(
        line_text(line).strip() for line in block.split(b"\n", dialect.header_line)[: dialect.header_line - 1]
    )
    above = tuple(line for line in above if line)
    return Layout(dialect.names, dialect.unit_row or (), above, tuple(first_cells), dialect.separator)


@dataclass(frozen=True)
class Meaning:
    """What a preset fixes of one file.

    `imu`, `vps`: keys of the configuration, and `ATTITUDES`, → names of columns; `t` among them. `names`: names for all
    columns, where the file's own are not unique. `time_unit`: of both `t`; `rate_hz`: of the rows, where no `t` is
    there, else of the numbers in it. `units`: sensor → unit, one that the configuration has or the same with a prefix
    (mgauss); `factors`: sensor → what its readings are multiplied by to be in it. `metre`: length of the position's
    unit, m. `world_from_logged`: quaternion (x, y, z, w) that brings poses to `world`. `world`, `body`, `gravity_sign`:
    None where the format does not fix it. `certain`: False where the file may mean something else, so that it is only
    read so when the configuration asks. `told`: what has to be known beside the name, as the end of a sentence.
    """

    imu: Mapping[str, Paths] = field(default_factory=dict)
    vps: Mapping[str, Paths] = field(default_factory=dict)
    names: tuple[str, ...] | None = None
    time_unit: str | None = None
    rate_hz: float | None = None
    units: Mapping[str, str] = field(default_factory=dict)
    factors: Mapping[str, float] = field(default_factory=dict)
    metre: float = 1.0
    world_from_logged: tuple[float, float, float, float] | None = None
    world: World | None = None
    body: Body | None = None
    gravity_sign: GravitySign | None = None
    certain: bool = True
    told: str = ""


@dataclass(frozen=True)
class Preset:
    """A format known by name. `of`: whose it is, as sentences say it. `table`: what its files hold, "imu", "vps" or
    "both" (in one file or in one each). `read`: what it fixes of a file, or what the file lacks, as "it has no …"."""

    name: CsvPreset
    of: str
    table: str
    read: Callable[[Layout], Meaning | str]

    def concerns(self, table: str) -> bool:
        """Whether files of this format may hold a table ("imu", "vps")."""
        return self.table in (table, "both")


def axes(pattern: str, over: tuple[str, ...] = XYZ) -> tuple[str, ...]:
    """Names of columns, one for each of `over` in the place of `*`."""
    return tuple(pattern.replace("*", axis) for axis in over)


def positive(text: str) -> float | None:
    """A finite number above zero, as a rate or a scale must be; None for any other text."""
    value = float(text) if is_number(text) else math.nan
    return value if 0.0 < value < math.inf else None
