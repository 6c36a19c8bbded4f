"""Files to take away from a page: what its figures show, and a vehicle's constants in every format that takes them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from urllib.parse import quote

from fieldcal.errors import FieldcalError
from fieldcal.exports import FORMATS, export_to
from fieldcal.exports.calibration_at import constants_of
from fieldcal.report.page import Column, Part, Section, Table, Text, link
from fieldcal.schemas.reference import REFERENCE_DEGC
from fieldcal.site.charts import Charts
from fieldcal.warehouse import Warehouse
from fieldcal.warehouse.store import frame_bytes

CONSTANTS = "constants"
ENDINGS = {
    "px4": "params",
    "ardupilot": "param",
    "ros": "yaml",
    "imu_calib": "yaml",
    "imu_pipeline": "yaml",
    "kalibr": "yaml",
    "json": "json",
    "c": "h",
}
"""Endings of the files of `exports.FORMATS`."""


def figures_file(charts: Charts) -> bytes | None:
    """What a page's figures show as Parquet, a row a point; None without figures."""
    rows = charts.rows()
    return None if rows.is_empty() else frame_bytes(rows, {})


def constants_files(warehouse: Warehouse, vehicle_id: str, stem: str) -> tuple[dict[str, bytes], Section]:
    """Files by their names below the site, and the section of the page that links to them or says why there is none."""
    try:
        constants = constants_of(warehouse.root, vehicle_id, warehouse=warehouse)
    except FieldcalError as error:
        return {}, Section("take", "Take the constants along", [Text(error.sentence)])
    files: dict[str, bytes] = {}
    lines: list[Sequence[str]] = []
    for name in FORMATS:
        file = f"{CONSTANTS}/{stem}-{name}.{ENDINGS[name]}"
        try:
            export = export_to(name, constants)
        except FieldcalError as error:
            lines.append([name, "–", error.sentence])
            continue
        files[file] = export.text.encode()
        lines.append([name, link(quote(file), Path(file).name), " ".join(export.warnings) or "–"])
    parts: list[Part] = [
        Text(
            f"At {REFERENCE_DEGC:g} °C, of the units that it flew with last. What is taken from here is not remembered:"
            " fieldcal export remembers it, and fieldcal compare tells later whether it was loaded."
        ),
        Table(
            "Constants in the formats of others",
            (Column("format"), Column("file"), Column("what it cannot hold, or why there is none", "wide")),
            lines,
        ),
    ]
    return files, Section("take", "Take the constants along", parts)
