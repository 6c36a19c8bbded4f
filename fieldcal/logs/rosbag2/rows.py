"""Rows of a table in an SQLite file that may be damaged: all that can be reached, in the order of their row ids."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from pathlib import Path

Value = int | float | str | bytes | None

PROBES_CAP = 20_000
_FIRST, _LAST = -(2**63), 2**63 - 1
_LARGEST_VALUE_BYTES = 256 << 20


def open_read_only(path: Path) -> sqlite3.Connection:
    """The file as it lies on the disk. Raises sqlite3.Error.

    Nothing is written, locked or run: not even the journals beside it are looked at.
    """
    connection = sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro&immutable=1", uri=True, isolation_level=None)
    connection.text_factory = lambda raw: raw.decode("utf-8", "replace")
    connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, _LARGEST_VALUE_BYTES)
    connection.execute("PRAGMA trusted_schema = OFF")
    connection.execute("PRAGMA cell_size_check = ON")
    # Else SQLite refuses a file that was cut as a whole.
    connection.execute("PRAGMA writable_schema = ON")
    return connection


class Rows:
    """Walks `columns` (SQL) of `table` by row id. Where a page is damaged it goes on at the first row behind it.

    Attributes
    ----------
    gaps : list of (int, int)
        Row ids between which rows may be lost: the last one read, and the last one not found; `_LAST`: to the end.
    damage : str or None
        The first thing SQLite said.
    gave_up : bool
        There was so much damage that the rest was not searched.
    """

    def __init__(self, connection: sqlite3.Connection, table: str, columns: str) -> None:
        self._connection = connection
        # Not "> ?", which SQLite answers by way of that row itself.
        self._query = f"SELECT rowid, {columns} FROM {table} NOT INDEXED WHERE rowid >= ? ORDER BY rowid"
        self.gaps: list[tuple[int, int]] = []
        self.damage: str | None = None
        self.gave_up = False
        self._probes = 0

    def __iter__(self) -> Iterator[tuple[int, tuple[Value, ...]]]:
        """(row id, values)."""
        after = _FIRST
        while True:
            try:
                for rowid, *values in self._connection.execute(self._query, (after + 1,)):
                    if rowid <= after:
                        raise sqlite3.DatabaseError("row ids are out of order")
                    after = rowid
                    yield rowid, tuple(values)
                return
            except sqlite3.DatabaseError as error:
                self.damage = self.damage or str(error)
            # Python's cursor looks a row ahead: the last one before the damage is still to be had.
            last = self._row_behind(after)
            if last is not None:
                after = int(last[0])
                yield after, tuple(last[1:])
                continue
            behind = self._behind(after)
            self.gaps.append((after, _LAST if behind is None else behind))
            if behind is None:
                return
            after = behind

    def _behind(self, after: int) -> int | None:
        """The least row id behind which reading works again; None: nowhere."""
        failing, step = after, 1
        while not self._readable(min(after + step, _LAST - 1)):
            failing = min(after + step, _LAST - 1)
            if failing == _LAST - 1:
                return None
            step *= 2
        working = min(after + step, _LAST - 1)
        while working - failing > 1:
            middle = (working + failing) // 2
            if self._readable(middle):
                working = middle
            else:
                failing = middle
        return None if self.gave_up else working

    def _readable(self, after: int) -> bool:
        self._probes += 1
        if self._probes > PROBES_CAP:
            self.gave_up = True
            return False
        try:
            self._connection.execute(self._query + " LIMIT 1", (after + 1,)).fetchone()
        except sqlite3.DatabaseError:
            return False
        return True

    def _row_behind(self, after: int) -> tuple[int, ...] | None:
        """The next row alone; None where it cannot be read, or has no larger row id."""
        try:
            row: tuple[int, ...] | None = self._connection.execute(self._query + " LIMIT 1", (after + 1,)).fetchone()
        except sqlite3.DatabaseError:
            return None
        return row if row is not None and row[0] > after else None
