"""A night in OpenMetrics text, as node_exporter's textfile collector reads it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

import polars as pl

from fieldcal.batch.documents import NightDocument
from fieldcal.names import Verdict
from fieldcal.report.history import last_usable
from fieldcal.warehouse import Warehouse
from fieldcal.warehouse.files import write_bytes


def write_metrics(path: Path, night: NightDocument, root: Path, *, ended_at_s: float, seconds: float) -> None:
    """Write the file, whole: what a collector reads meanwhile is the former one.

    Parameters
    ----------
    ended_at_s : float
        When the night ended, s since 1970.
    seconds : float
        How long it took.

    Raises
    ------
    WarehouseError
        The disk's refusal.
    """
    counts: Mapping[str, object] = night
    drift = Warehouse(root).scan("drift").group_by("status").len().sort("status").collect()
    latest = (
        last_usable(Warehouse(root)).filter(pl.col("last_at").is_not_null()).sort("vehicle_id", "unit_id", "sensor")
    )
    lines = [
        *_family("fieldcal_night_end_timestamp_seconds", "When the last night ended.", [({}, ended_at_s)]),
        *_family("fieldcal_night_duration_seconds", "How long the last night took.", [({}, seconds)]),
        *_family("fieldcal_logs", "Logs of the archive by verdict.", [({"verdict": v}, counts[v]) for v in Verdict]),
        *_family("fieldcal_news", "Changes in the fleet that the last night told.", [({}, len(night["changes"]))]),
        *_family(
            "fieldcal_trends", "Constants by the status of their trend.", [({"status": s}, n) for s, n in drift.rows()]
        ),
        *_family(
            "fieldcal_calibrated_timestamp_seconds",
            "Start of the latest flight that calibrated a sensor.",
            [
                ({"vehicle": r["vehicle_id"], "unit": r["unit_id"], "sensor": r["sensor"]}, r["last_at"].timestamp())
                for r in latest.rows(named=True)
            ],
        ),
        "# EOF",
    ]
    write_bytes(path, ("\n".join(lines) + "\n").encode("utf-8", "backslashreplace"), durable=False)
    path.chmod(0o644)  # the collector is another user


def _family(name: str, told: str, samples: Iterable[tuple[Mapping[str, str], object]]) -> list[str]:
    lines = [f"# TYPE {name} gauge", f"# HELP {name} {told}"]
    for labels, value in samples:
        inner = ",".join(f'{label}="{_escaped(text)}"' for label, text in labels.items())
        lines.append(f"{name}{{{inner}}} {value}" if inner else f"{name} {value}")
    return lines


def _escaped(text: str) -> str:
    return text.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n")
