"""What pooled units came to, kept from night to night: a unit whose flights, and the fleet's movement, are the same is
not pooled again.

Keys are contents and the code; the file may be deleted at any time, and one that is torn is not used.
"""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path

import polars as pl
from polars.exceptions import PolarsError

from fieldcal.estimation.pooled.strengths import Strengths
from fieldcal.estimation.pooled.unit import Kinds
from fieldcal.schemas.frames import empty_frame
from fieldcal.warehouse.files import write_bytes
from fieldcal.warehouse.sealed import seal_bytes, unseal_bytes

PLACE = Path("night") / "pooled.bin"
OF = "of"
"""Column of the kept rows: the key of the unit that they are of."""


class Memory:
    """Rows of pooled units, and the strengths that they were pooled with, by content. `folder`: the warehouse's root,
    None keeps nothing beyond this object; `code`: digest of the code that makes them. `pooled` counts the units whose
    rows were not there."""

    def __init__(self, folder: Path | None = None, code: str = "") -> None:
        self._path = None if folder is None else folder / PLACE
        self._code = code
        self._kinds: tuple[str, Kinds] = ("", {})
        self._known: dict[str, pl.DataFrame] = {}
        if self._path is not None:
            self._kinds, self._known = _read(self._path)
        self._stored = (self._kinds[0], set(self._known))
        self._used: dict[str, pl.DataFrame] = {}
        self.pooled = 0

    def kinds(self, units: Sequence[pl.DataFrame], make: Callable[[], Kinds]) -> Kinds:
        """The strengths that units of these flights show."""
        key = _digest(self._code, *map(_content, units))
        if self._kinds[0] != key:
            self._kinds = key, make()
        return self._kinds[1]

    def rows(self, unit: pl.DataFrame, kinds: Kinds, make: Callable[[], pl.DataFrame]) -> pl.DataFrame:
        """Rows of a unit of these flights, pooled with these strengths."""
        sensors = set(unit["sensor"].unique())
        own = {kind: strengths for kind, strengths in kinds.items() if kind[0] in sensors}
        key = _digest(self._code, _content(unit), json.dumps(_plain(own), sort_keys=True).encode())
        found = self._used.get(key, self._known.get(key))
        if found is None:
            found = make()
            self.pooled += 1
        self._used[key] = found
        return found

    def save(self) -> None:
        """Keep what was used since this object was made, where that is anything else than what is kept."""
        if self._path is None or (self._kinds[0], set(self._used)) == self._stored:
            return
        parts = [rows.with_columns(pl.lit(key).alias(OF)) for key, rows in sorted(self._used.items())]
        rows = pl.concat([_nothing(), *parts])
        head = {"kinds": [self._kinds[0], _plain(self._kinds[1])], "units": sorted(self._used)}
        stream = io.BytesIO()
        stream.write(json.dumps(head).encode() + b"\n")
        rows.write_ipc(stream, compression="zstd")
        write_bytes(self._path, seal_bytes(stream.getvalue()), durable=False)


def _read(path: Path) -> tuple[tuple[str, Kinds], dict[str, pl.DataFrame]]:
    nothing: tuple[tuple[str, Kinds], dict[str, pl.DataFrame]] = ("", {}), {}
    try:
        head, _, content = unseal_bytes(path.read_bytes()).partition(b"\n")
        told = json.loads(head)
        rows = pl.read_ipc(io.BytesIO(content))
        if rows.schema != _nothing().schema:  # an older release's
            return nothing
        parts = {str(key): part for (key,), part in rows.partition_by(OF, as_dict=True, include_key=False).items()}
        kinds = {(sensor, parameter): Strengths(**own) for sensor, parameter, own in told["kinds"][1]}
        return (told["kinds"][0], kinds), {key: parts.get(key, empty_frame("pooled")) for key in told["units"]}
    except (OSError, ValueError, KeyError, TypeError, PolarsError):
        return nothing


def _nothing() -> pl.DataFrame:
    return empty_frame("pooled").with_columns(pl.lit("").alias(OF))


def _plain(kinds: Kinds) -> list[list[object]]:
    return [[*kind, asdict(strengths)] for kind, strengths in sorted(kinds.items())]


def _content(rows: pl.DataFrame) -> bytes:
    stream = io.BytesIO()
    # Of the oldest form: in the newest, strings lie as they came to be, not as they are.
    rows.rechunk().write_ipc(stream, compression="uncompressed", compat_level=pl.CompatLevel.oldest())
    return hashlib.sha256(stream.getvalue()).digest()


def _digest(code: str, *parts: bytes) -> str:
    digest = hashlib.sha256(code.encode())
    for part in parts:
        digest.update(hashlib.sha256(part).digest())
    return digest.hexdigest()
