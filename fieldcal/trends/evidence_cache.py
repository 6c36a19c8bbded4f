"""What the histories of an IMU say by themselves, kept from night to night: only what changed is regressed again.

The key is the histories' content and the code; the file may be deleted at any time, and one that is torn is not used.
"""

from __future__ import annotations

import hashlib
import io
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path

import numpy as np

from fieldcal.estimation.segments import run_starts
from fieldcal.trends.evidence import ESTIMATES, Evidence, evidence
from fieldcal.trends.series import Histories
from fieldcal.warehouse.files import write_bytes
from fieldcal.warehouse.sealed import BrokenSeal, seal_bytes, unseal_bytes

PLACE = Path("night") / "drift_evidence.npz"
BY_ROW = tuple(field.name for field in fields(Evidence) if field.name not in ("estimates", "kept"))
Arrays = dict[str, np.ndarray]


class Memory:
    """Evidence by content. `folder`: the warehouse's root, None keeps nothing beyond this object; `code`: digest of the
    code that makes it. `regressed` counts the IMUs whose evidence was not there."""

    def __init__(self, folder: Path | None = None, code: str = "") -> None:
        self._path = None if folder is None else folder / PLACE
        self._code = code
        self._known = {} if self._path is None else dict(_read(self._path))
        self._stored = set(self._known)
        self._used: dict[str, Evidence] = {}
        self.regressed = 0

    def of(self, h: Histories, imu: np.ndarray) -> Evidence:
        """Evidence of all histories; `imu` (g,), ascending in runs: equal for the histories of one IMU."""
        bounds = np.append(run_starts(imu), len(imu))
        starts = np.searchsorted(h.row, bounds)
        blocks = zip(bounds[:-1], bounds[1:], starts[:-1], starts[1:], strict=True)
        return _joined([self._one(_block(h, *block)) for block in blocks])

    def save(self) -> None:
        """Keep what was used since this object was made, where that is anything else than what is kept."""
        if self._path is None or set(self._used) == self._stored:
            return
        keys = sorted(self._used)
        several = [self._used[key] for key in keys]
        everything = _joined(several)
        arrays = {name: getattr(everything, name) for name in (*BY_ROW, "kept")}
        arrays |= {f"estimate_{name}": everything.estimates[name] for name in ESTIMATES}
        sizes = np.array([[len(e.unit), len(e.kept)] for e in several])
        stream = io.BytesIO()
        np.savez_compressed(stream, keys=np.array(keys), sizes=sizes, **arrays)
        write_bytes(self._path, seal_bytes(stream.getvalue()), durable=False)

    def _one(self, h: Histories) -> Evidence:
        key = _key(h, self._code)
        found = self._used.get(key) or self._known.get(key)
        if found is None:
            found = evidence(h)
            self.regressed += 1
        self._used[key] = found
        return found


def _block(h: Histories, first_row: int, end_row: int, start: int, end: int) -> Histories:
    """The histories of one IMU, numbered from 0: the same whatever else the fleet has."""
    flights, rows = slice(start, end), slice(first_row, end_row)
    known = None if h.slope_per_degc is None else h.slope_per_degc[rows]
    known_sd = None if h.slope_per_degc_sd is None else h.slope_per_degc_sd[rows]
    if known is not None and np.isnan(known).all():
        known = known_sd = None
    return Histories(
        row=h.row[flights].astype(np.int64) - first_row,
        session=np.unique(h.session[flights], return_inverse=True)[1],
        time_day=h.time_day[flights],
        temperature_degc=h.temperature_degc[flights],
        value=h.value[flights],
        sd=h.sd[flights],
        slope_per_degc=known,
        slope_per_degc_sd=known_sd,
    )


def _key(h: Histories, code: str) -> str:
    digest = hashlib.sha256(code.encode())
    for field in fields(Histories):
        column = getattr(h, field.name)
        digest.update(f"\0{field.name}\0".encode())
        if column is not None:
            digest.update(np.ascontiguousarray(column).tobytes())
    return digest.hexdigest()


def _joined(several: list[Evidence]) -> Evidence:
    columns = {name: np.concatenate([getattr(e, name) for e in several]) for name in (*BY_ROW, "kept")}
    return Evidence(
        **columns, estimates={name: np.concatenate([e.estimates[name] for e in several]) for name in ESTIMATES}
    )


def _read(path: Path) -> Iterator[tuple[str, Evidence]]:
    try:
        data = unseal_bytes(path.read_bytes())
    except (OSError, BrokenSeal):
        return
    with np.load(io.BytesIO(data), allow_pickle=False) as stored:
        arrays: Arrays = {name: stored[name] for name in stored.files}
    if set(arrays) != {"keys", "sizes", "kept", *BY_ROW, *(f"estimate_{name}" for name in ESTIMATES)}:
        return
    ends = np.cumsum(arrays["sizes"], axis=0)
    for key, (g, n), (row_end, end) in zip(arrays["keys"].tolist(), arrays["sizes"], ends, strict=True):
        rows = slice(row_end - g, row_end)
        yield (
            key,
            Evidence(
                **{name: arrays[name][rows] for name in BY_ROW},
                estimates={name: arrays[f"estimate_{name}"][rows] for name in ESTIMATES},
                kept=arrays["kept"][end - n : end],
            ),
        )
