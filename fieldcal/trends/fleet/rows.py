"""Rows of the history that trends are of, remembered by vehicle: a night reads the vehicles that flew.

`night/drift/<vehicle>.bin` has a vehicle's rows with what they were read from: its files by their records, decisions,
the code. It may be deleted at any time, and one that is torn is not used.
"""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import polars as pl
from polars.exceptions import PolarsError

from fieldcal.names import RESIDUAL, Status
from fieldcal.provenance.run_key import source_digest
from fieldcal.schemas import table_key
from fieldcal.schemas.columns import FLOWN_ORDER
from fieldcal.trends.fleet.groups import groups
from fieldcal.trends.reasons import AGREEMENT, VPS
from fieldcal.warehouse import Warehouse
from fieldcal.warehouse.decisions.withdrawn import counting
from fieldcal.warehouse.files import write_bytes
from fieldcal.warehouse.layout import checksum_path, encode_id, history_files, vehicle_name
from fieldcal.warehouse.sealed import BrokenSeal, seal_bytes, unseal_bytes

KEY = list(table_key("drift"))
ORDER = [*KEY, "started_at", "vehicle_id", "sequence", "flight_id"]
OF_UNITS = ("calibration", "sync", "fit")
READ = (*OF_UNITS, "flight")
PLACE = Path("night") / "drift"


@dataclass(frozen=True)
class Part:
    """Rows of one vehicle, sorted; `units`: how many each unit has, in their order; `whole`: none of them would go if
    the vehicle were alone."""

    rows: pl.DataFrame
    units: Mapping[str, int]
    whole: bool


def history_in_groups(root: Path, *, remember: bool = False) -> Iterator[pl.DataFrame]:
    """Values that were not refused: calibrated parameters, the VPS clock's lag and skew, Theil's coefficients.

    One row a flight and series, sorted by series and time; all flights of a unit are in one frame, of some vehicles. A
    series keeps to the unit of its last flight, and to flights with a time where any has one.

    Parameters
    ----------
    root : Path
        Data root.
    remember : bool
        Rows are kept by vehicle, and taken from there while nothing changed.
    """
    code = source_digest(_read, _part) if remember else None
    counts = counting(root)
    decided = hashlib.sha256(b"".join(_recorded(root, path) for path in history_files(root, "decision")))
    found: dict[str, list[Path]] = {}
    for table in READ:
        for path in history_files(root, table):
            found.setdefault(vehicle_name(path), []).append(path)
    if remember:
        for other in (root / PLACE).glob("*.bin"):
            if other.stem not in found:
                other.unlink(missing_ok=True)
    for vehicles in groups(root, OF_UNITS):
        blocks: dict[str, list[tuple[pl.DataFrame, bool]]] = {}
        for vehicle in vehicles:
            name, key = encode_id(vehicle), hashlib.sha256(f"{code}\0{decided.hexdigest()}".encode())
            for path in found.get(name, ()):
                told = f"\0{path.relative_to(root)}\0".encode("utf-8", "surrogateescape")
                key.update(told + _recorded(root, path))
            place = root / PLACE / f"{name}.bin"
            part = _remembered(place, key.hexdigest()) if remember else None
            if part is None:
                part = _part(_read(root, vehicle, counts))
                if remember:
                    _remember(place, key.hexdigest(), part)
            start = 0
            for unit, n in part.units.items():
                blocks.setdefault(unit, []).append((part.rows.slice(start, n), part.whole))
                start += n
        if blocks:
            yield pl.concat([_merged(blocks[unit]) for unit in sorted(blocks)])


def _merged(several: list[tuple[pl.DataFrame, bool]]) -> pl.DataFrame:
    """Rows of one unit, which may have flown on several vehicles."""
    (rows, whole), *others = several
    if not others and whole:
        return rows
    return pl.concat([rows for rows, _ in several]).sort(ORDER, nulls_last=False).filter(_stays())


def _stays() -> pl.Expr:
    timed = pl.col("started_at").is_not_null()
    return (pl.col("unit") == pl.col("unit").last().over(KEY)) & (timed | ~timed.any().over(KEY))


def _recorded(root: Path, path: Path) -> bytes:
    beside = checksum_path(root, path)
    return beside.read_bytes() if beside.exists() else hashlib.sha256(path.read_bytes()).digest()


def _part(rows: pl.DataFrame) -> Part:
    rows = rows.sort(ORDER, nulls_last=False)
    units = dict(rows.group_by("unit_id", maintain_order=True).len().iter_rows())
    return Part(rows, units, rows.filter(_stays()).height == rows.height)


def _remembered(place: Path, key: str) -> Part | None:
    try:
        head, _, content = unseal_bytes(place.read_bytes()).partition(b"\n")
        told = json.loads(head)
        if told["key"] != key:
            return None
        return Part(pl.read_ipc(io.BytesIO(content)), told["units"], told["whole"])
    except (OSError, BrokenSeal, ValueError, KeyError, PolarsError):
        return None


def _remember(place: Path, key: str, part: Part) -> None:
    stream = io.BytesIO()
    stream.write(json.dumps({"key": key, "units": part.units, "whole": part.whole}).encode() + b"\n")
    part.rows.write_ipc(stream, compression="zstd")
    write_bytes(place, seal_bytes(stream.getvalue()), durable=False)


def _read(root: Path, vehicle_id: str | None, counts: pl.Expr) -> pl.DataFrame:
    """Of one vehicle, or of all; `counts`: what nobody withdrew."""
    warehouse = Warehouse(root)
    lead = ["vehicle_id", "imu_id", "unit_id", "session_id", *FLOWN_ORDER]
    columns = [*lead, "sensor", "method", "parameter", "axis", "value", "sd", "unit", "temperature_degc"]
    # What remains of an autopilot's own correction steps with its parameters, not with the sensor.
    own = (pl.col("status") == Status.OK) & ~pl.col("parameter").str.starts_with(RESIDUAL)
    calibration = warehouse.scan("calibration", vehicle_id=vehicle_id).filter(own).select(columns)
    warm = warehouse.scan("flight", vehicle_id=vehicle_id).select(
        "vehicle_id", "flight_id", temperature_degc="temperature_mean_degc"
    )
    text = {"sensor": pl.lit(VPS), "method": pl.lit("sync"), "axis": pl.lit("")}
    flight = ["vehicle_id", "flight_id"]
    sync = (
        warehouse.scan("sync", vehicle_id=vehicle_id)
        .filter(pl.col("status") == Status.OK)
        .join(warm, on=flight, how="left")
    )
    clock = [
        sync.with_columns(**text, parameter=pl.lit(name), value=value, sd=sd, unit=pl.lit(unit)).select(columns)
        for name, value, sd, unit in (
            ("lag", pl.col("lag_mid_s"), pl.col("lag_sd_s"), "s"),
            ("skew", pl.col("skew_ppm"), pl.col("skew_sd_ppm"), "ppm"),
        )
    ]
    fit = (
        warehouse.scan("fit", vehicle_id=vehicle_id)
        .filter((pl.col("signal") == "raw") & (pl.col("sample") == "all"))
        .filter(counts)
        .join(warm, on=flight, how="left")
        .with_columns(
            sensor=pl.lit(AGREEMENT),
            parameter=pl.concat_str(pl.lit("tic_"), pl.col("quantity")),
            axis=pl.col("reference"),
            value=pl.col("tic"),
            sd=pl.lit(None, dtype=pl.Float64),
            unit=pl.lit("1"),
        )
        .select(columns)
    )
    return pl.concat([calibration, *clock, fit]).filter(pl.col("value").is_finite()).collect()
