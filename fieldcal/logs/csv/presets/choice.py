"""Which known format a CSV file is of: as the configuration says, else by recognition."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from fieldcal.config.configuration import CsvMap
from fieldcal.config.values import Paths
from fieldcal.errors import UnreadableLog
from fieldcal.logs.csv.presets.betaflight import BETAFLIGHT
from fieldcal.logs.csv.presets.by_columns import EUROC, MAVLOGDUMP, PHYPHOX, ROSTOPIC, ULOG2CSV, X_IO
from fieldcal.logs.csv.presets.layout import ATTITUDES, Layout, Meaning, Preset
from fieldcal.logs.csv.presets.motion_capture import MOTIVE, MOTIVE_Z_UP, QUALISYS, VICON_NEXUS
from fieldcal.logs.csv.presets.plotjuggler import PLOTJUGGLER
from fieldcal.logs.csv.presets.xsens import XSENS_MT
from fieldcal.logs.interface import LogSummary
from fieldcal.reason_codes import ReasonCode

PRESETS: Mapping[str, Preset] = {
    preset.name: preset
    for preset in (
        BETAFLIGHT,
        EUROC,
        MAVLOGDUMP,
        MOTIVE,
        MOTIVE_Z_UP,
        PHYPHOX,
        PLOTJUGGLER,
        QUALISYS,
        ROSTOPIC,
        ULOG2CSV,
        VICON_NEXUS,
        X_IO,
        XSENS_MT,
    )
}
"""Known formats by name. No file is recognised as two of them."""


@dataclass(frozen=True)
class ReadAs:
    """How one file is read: by which preset, none for names alone, and which of its tables ("imu", "vps")."""

    preset: Preset | None = None
    meaning: Meaning = field(default_factory=Meaning)
    tables: frozenset[str] = frozenset()

    def columns(self, table: str, configured: Mapping[str, Paths]) -> dict[str, Paths]:
        """Names of a table's columns: the configured ones, and the preset's for what is not configured."""
        own = dict({"imu": self.meaning.imu, "vps": self.meaning.vps}[table]) if table in self.tables else {}
        if any(key in configured for key in ATTITUDES):
            own = {key: names for key, names in own.items() if key not in ATTITUDES}
        return {**own, **configured}

    def has(self, table: str) -> bool:
        """Whether a table is read by the preset."""
        return table in self.tables and bool({"imu": self.meaning.imu, "vps": self.meaning.vps}[table])

    def units(self, columns: Iterable[str], configured: Mapping[str, Paths]) -> dict[str, str]:
        """Unit of each sensor whose columns are the preset's, where it fixes one."""
        own = self.meaning.imu if "imu" in self.tables else {}
        return {
            sensor: unit
            for sensor, unit in self.meaning.units.items()
            if sensor in columns and sensor in own and sensor not in configured
        }

    def time_unit(self, table: str, configured: Mapping[str, Paths]) -> str | None:
        """Unit of a table's time, where its column is the preset's."""
        return self.meaning.time_unit if table in self.tables and "t" not in configured else None

    def rate_hz(self, csv: CsvMap) -> float | None:
        """Rate of the file's rows or numbers. What a VPS's file says of itself goes before `csv.rate_hz`, which is the
        IMU's, unless the configuration names its time."""
        if self.tables == {"vps"} and self.meaning.rate_hz and "t" not in csv.vps:
            return self.meaning.rate_hz
        return csv.rate_hz or self.meaning.rate_hz

    def tell(self, summary: LogSummary, log_name: str) -> None:
        """Record the preset, and the conventions that it fixes for the tables that were read by it."""
        if self.preset is None:
            return
        if self.has("imu"):
            summary.body, summary.gravity_sign = self.meaning.body, self.meaning.gravity_sign
        if self.has("vps"):
            summary.world = self.meaning.world
        told = f"; {self.meaning.told}" if self.meaning.told else ""
        summary.add(
            ReasonCode.PRESET,
            1,
            f'{log_name} was read as {self.preset.of} format (csv.preset = "{self.preset.name}"){told}. What the '
            'configuration says of it goes first; csv.preset = "none" reads it by the names of columns alone.',
        )


def read_as(csv: CsvMap, layout: Layout, tables: Iterable[str], known: Iterable[str], log_name: str) -> ReadAs:
    """How a file is to be read.

    Parameters
    ----------
    csv : CsvMap
        Its `preset`.
    layout : Layout
        The beginning of the file.
    tables, known : iterable of str
        Which of "imu" and "vps" are looked for in it; those that configured or default names find, which recognition
        leaves alone.

    Raises
    ------
    UnreadableLog
        `preset_not_fitting`: the file is not of the configured format.
    """
    wanted = set(tables)
    if csv.preset == "none":
        return ReadAs()
    if csv.preset is not None:
        preset = PRESETS[csv.preset]
        concerned = {table for table in wanted if preset.concerns(table)}
        # A VPS's format says nothing of an IMU's file.
        if concerned and not (preset.table == "vps" and "imu" in wanted):
            return _by_name(preset, csv, layout, concerned, log_name)
    open_to_all = wanted - set(known)
    for preset in PRESETS.values():
        if not any(preset.concerns(table) for table in open_to_all):
            continue
        meaning = preset.read(layout)
        if isinstance(meaning, Meaning) and meaning.certain and _held(meaning) & open_to_all:
            return ReadAs(preset, meaning, frozenset(open_to_all))
    return ReadAs()


def _by_name(preset: Preset, csv: CsvMap, layout: Layout, tables: set[str], log_name: str) -> ReadAs:
    meaning = preset.read(layout)
    problem = meaning if isinstance(meaning, str) else None
    if isinstance(meaning, Meaning):
        configured = {"vps"} if any(key in csv.vps for key in ATTITUDES) else set()
        if not tables & (_held(meaning) | configured):
            problem = meaning.told or f"it holds nothing of the {' or '.join(sorted(tables)).upper()}"
        else:
            return ReadAs(preset, meaning, frozenset(tables))
    raise UnreadableLog(
        ReasonCode.PRESET_NOT_FITTING,
        f'{log_name} is not read as {preset.of} format, which csv.preset = "{preset.name}" asks for: {problem}. '
        "Correct csv.preset, or leave it out: files of known formats are recognised.",
    )


def _held(meaning: Meaning) -> set[str]:
    """Tables that a file holds by its meaning."""
    sensors = {"imu"} if meaning.imu else set()
    return sensors | ({"vps"} if any(key in meaning.vps for key in ATTITUDES) else set())


def only_by_name(layout: Layout) -> str:
    """What to tell of a file that may be of a format which is read only when asked for; empty where it is of none."""
    for preset in PRESETS.values():
        meaning = preset.read(layout)
        if isinstance(meaning, Meaning) and not meaning.certain:
            told = f" ({meaning.told})" if meaning.told else ""
            return f' It looks like {preset.of} format: csv.preset = "{preset.name}" reads it so{told}.'
    return ""
