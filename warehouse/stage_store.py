"""The cache of stages: one folder an execution, complete when its `run.json` says so and what it lists is whole.

Large tables are files beside it, small ones lie in it. Of tables that are only handed on (made again in less time than
their files would take) it has the digest alone.

It may be deleted at any time, in whole or in part. A killed process leaves whole files or none; nothing here waits for
the disk (which would be most of a stage's time): what a power cut tears has another sha256 and is made again.
"""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NotRequired, TypedDict, cast

import polars as pl

from fieldcal.names import Json
from fieldcal.reason_codes import ReasonCode
from fieldcal.schemas import fits
from fieldcal.schemas.frames import frame
from fieldcal.warehouse.errors import WarehouseError, disk
from fieldcal.warehouse.files import write_bytes
from fieldcal.warehouse.layout import prepare, stage_folder
from fieldcal.warehouse.rows_as_json import as_json, digest, from_json
from fieldcal.warehouse.sealed import BrokenSeal, seal, unseal
from fieldcal.warehouse.store import conform, read_arrow, write_table

RECORD = "run.json"


MOST_VALUES_INSIDE = 4096
"""Of a table that lies in the record."""


class StageOutput(TypedDict):
    """A table that an execution wrote: what it holds, and where. `sha256`: of its file, else of its rows."""

    sha256: str
    rows: int
    file: NotRequired[str]
    bytes: NotRequired[int]
    columns: NotRequired[dict[str, Sequence[Json]]]
    """Of one that lies in the record."""
    handed_on: NotRequired[bool]
    """Whether it is nowhere."""


def outputs_of(record: Mapping[str, object]) -> dict[str, StageOutput]:
    """The tables that a record lists. Its seal held, so that they are as `StageStore.save` wrote them."""
    return cast(dict[str, StageOutput], record["outputs"])


class StageStore:
    """Outputs of stages below a data root, by stage, flight and run key."""

    def __init__(self, root: Path) -> None:
        self.root = root

    def folder(self, stage: str, flight_id: str, run_key: str) -> Path:
        """Where this execution's outputs are or would be."""
        return stage_folder(self.root, stage, flight_id, run_key)

    def record(self, stage: str, flight_id: str, run_key: str) -> dict[str, Json] | None:
        """What `save` was given as record, with `outputs` added; None when absent, torn or of another execution."""
        return _record(self.folder(stage, flight_id, run_key), stage, flight_id, run_key)

    def complete(self, stage: str, flight_id: str, run_key: str) -> dict[str, Json] | None:
        """The record, if the execution is complete: every output there with the sha256 it says; else None.

        The record's `outputs` is `{table: StageOutput}`.
        """
        folder = self.folder(stage, flight_id, run_key)
        record = _record(folder, stage, flight_id, run_key)
        return None if record is None or any(broken_outputs(folder, record)) else record

    def latest(self, stage: str, flight_id: str) -> dict[str, Json] | None:
        """The record last written for this stage of this flight, whatever its key; None when there is none."""
        found = self.folder(stage, flight_id, "any").parent.glob(f"*/{RECORD}")
        for path in sorted(found, key=lambda path: (_written_ns(path), path), reverse=True):
            try:
                return unseal(path.read_bytes())
            except (OSError, BrokenSeal):
                continue
        return None

    def save(
        self,
        stage: str,
        flight_id: str,
        run_key: str,
        tables: Mapping[str, pl.DataFrame],
        record: Mapping[str, object],
        *,
        handed_on: Collection[str] = (),
    ) -> dict[str, Json]:
        """Write the outputs but those that are `handed_on` and, last, the record; the record as `complete` returns it.

        `record` is plain JSON (no NaN, no numpy values); the keys stage, flight_id, run_key and outputs are set here.
        Another process may be writing the same execution, and may be reading it already: a record that is there stays
        until the new one replaces it, and says by its sha256s which outputs it means.
        """
        folder = self.folder(stage, flight_id, run_key)
        prepare(self.root)
        outputs: dict[str, StageOutput] = {}
        for table, rows in tables.items():
            if table in handed_on:
                outputs[table] = {"sha256": digest(rows), "rows": rows.height, "handed_on": True}
            elif rows.height * rows.width <= MOST_VALUES_INSIDE:
                whole = rows if fits(rows, table, stage=True) else frame(conform(rows, table, stage=True))
                outputs[table] = {"sha256": digest(whole), "rows": rows.height, "columns": as_json(whole)}
            else:
                path = folder / f"{table}.parquet"
                sha256 = write_table(rows, table, path, stage=True, durable=False)
                size = path.stat().st_size
                outputs[table] = {"sha256": sha256, "rows": rows.height, "file": path.name, "bytes": size}
        own = {"stage": stage, "flight_id": flight_id, "run_key": run_key, "outputs": outputs}
        sealed = seal({**record, **own})
        write_bytes(folder / RECORD, sealed, durable=False)
        return unseal(sealed)

    def forget(self, stage: str, flight_id: str, run_key: str) -> None:
        """Let an execution count as not complete."""
        (self.folder(stage, flight_id, run_key) / RECORD).unlink(missing_ok=True)

    def load(
        self, stage: str, flight_id: str, run_key: str, tables: Iterable[str] | None = None
    ) -> dict[str, pl.DataFrame]:
        """Outputs of a complete execution (those named, or all that are kept), each checked against its sha256.

        Raises
        ------
        WarehouseError
            `stage_incomplete`: there is no such complete execution, or not that table in it.
        """
        folder = self.folder(stage, flight_id, run_key)
        record = _record(folder, stage, flight_id, run_key)
        if record is None:
            raise WarehouseError(
                ReasonCode.STAGE_INCOMPLETE, f"{folder} holds no complete result of stage {stage}; run it again."
            )
        outputs = outputs_of(record)
        kept = [table for table, output in outputs.items() if is_kept(output)]
        wanted = list(kept if tables is None else tables)
        if absent := [table for table in wanted if table not in kept]:
            raise WarehouseError(
                ReasonCode.STAGE_INCOMPLETE, f"stage {stage} of this run kept no table {absent[0]} ({folder})."
            )
        return {table: _output(folder, table, outputs[table]) for table in wanted}


def _record(folder: Path, stage: str, flight_id: str, run_key: str) -> dict[str, Json] | None:
    try:
        found = unseal((folder / RECORD).read_bytes())
    except (OSError, BrokenSeal):
        return None
    same = (found.get("stage"), found.get("flight_id"), found.get("run_key")) == (stage, flight_id, run_key)
    return found if same else None


def _written_ns(path: Path) -> int:
    try:
        return path.stat().st_mtime_ns
    except OSError:
        return 0


def broken_outputs(folder: Path, record: Mapping[str, Json]) -> Iterator[tuple[Path, str]]:
    """Outputs that are not what the record says, each with what is wrong."""
    for output in outputs_of(record).values():
        if "file" not in output:
            continue
        path = folder / output["file"]
        try:
            data = path.read_bytes() if path.stat().st_size == output["bytes"] else b""
        except OSError:
            yield path, "it is missing"
            continue
        if hashlib.sha256(data).hexdigest() != output["sha256"]:
            yield path, "its content is not what was written: the sha256 differs"


def is_kept(output: StageOutput) -> bool:
    """Whether a table is there to be read, not only handed on."""
    return not output.get("handed_on", False)


def _output(folder: Path, table: str, output: StageOutput) -> pl.DataFrame:
    if "columns" in output:
        return from_json(output["columns"], table)
    path = folder / output["file"]
    with disk(path, "read"):
        data = path.read_bytes()
    if hashlib.sha256(data).hexdigest() != output["sha256"]:
        raise WarehouseError(ReasonCode.STAGE_INCOMPLETE, f"{path} is not what the stage wrote; run the stage again.")
    return frame(read_arrow(data, table, stage=True, name=str(path)))
