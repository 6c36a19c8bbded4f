"""Which session folders of an archive have landed: their files changed, and then stopped changing."""

from __future__ import annotations

from pathlib import Path

Stamp = tuple[tuple[str, int, int], ...]


class Landing:
    """Watches an archive by looking at it, which also works on network drives.

    Sessions that are there when it is made count as known: the night takes those.

    Parameters
    ----------
    archive : Path
        Folder of `<vehicle>/<session>/` folders.
    quiet_s : float
        A session has landed when none of its files changed for so long.
    """

    def __init__(self, archive: Path, quiet_s: float) -> None:
        self._archive = archive
        self._quiet_s = quiet_s
        self._told: dict[Path, Stamp] = self._look()
        self._seen: dict[Path, tuple[Stamp, float]] = {}

    def finished(self, now_s: float) -> list[Path]:
        """Sessions that landed since the last call; each state of a folder is told once.

        Parameters
        ----------
        now_s : float
            A clock that only goes forward.
        """
        landed = []
        present = self._look()
        for folder, stamp in present.items():
            if not stamp or self._told.get(folder) == stamp:
                self._seen.pop(folder, None)
                continue
            before, since_s = self._seen.get(folder, (None, now_s))
            if before != stamp:
                self._seen[folder] = (stamp, now_s)
            elif now_s - since_s >= self._quiet_s:
                self._told[folder] = stamp
                landed.append(folder)
        self._seen = {folder: seen for folder, seen in self._seen.items() if folder in present}
        return landed

    def _look(self) -> dict[Path, Stamp]:
        return {folder: _stamp(folder) for folder in sorted(self._archive.glob("*/*")) if folder.is_dir()}


def _stamp(folder: Path) -> Stamp:
    """Names, sizes and times of change of all files in a folder; files that vanish meanwhile do not count."""
    found = []
    for path in sorted(folder.rglob("*")):
        try:
            stat = path.stat()
        except OSError:
            continue
        if path.is_file():
            found.append((path.relative_to(folder).as_posix(), stat.st_size, stat.st_mtime_ns))
    return tuple(found)
