"""About a warehouse as a whole: what it holds (`schemas`), as one file for others (`export-warehouse`), and what of it
may go (`prune`)."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import fieldcal
from fieldcal.cli.options import AsJson, Root, UnusedConfig, Wide
from fieldcal.reason_codes import ReasonCode


def prune(
    *,
    stages: bool = False,
    signals_before: str | None = None,
    vehicle: str | None = None,
    yes: bool = False,
    as_json: AsJson = False,
    warehouse: Root = None,
    config: UnusedConfig = None,
) -> int:
    """Make room: remove what no night or question needs. Without --yes it only says what would go, and what is lost.

    Of itself it removes results of stages by settings, code or logs of before, with which nothing is lost.

    Parameters
    ----------
    stages
        All results of stages: the next night runs them again.
    signals_before
        Readings of flights that started before this date, 2026-05-04: logs are read again where they are needed.
    vehicle
        All that is kept of this vehicle, its history too.
    yes
        Remove it.
    """
    from fieldcal.cli.show import print_json
    from fieldcal.warehouse.lock import fleet_lock
    from fieldcal.warehouse.questions import existing, moment_of
    from fieldcal.warehouse.remote.garbage import Garbage, garbage
    from fieldcal.warehouse.upkeep.prune import Removable, all_results, former_results, of_vehicle, remove
    from fieldcal.warehouse.upkeep.prune import signals_before as old_signals

    root = existing(fieldcal.Warehouse(warehouse).root).root
    removable = [all_results(root) if stages else former_results(root)]
    former = garbage(root)
    if signals_before is not None:
        if former is not None:
            told = "--signals-before is for a warehouse on this machine; by URL readings stay."
            raise fieldcal.FieldcalError(ReasonCode.WRONG_OPTION, told)
        moment = moment_of("--signals-before", signals_before)
        if moment > datetime.now(UTC):
            told = f"--signals-before {signals_before} has not come yet."
            raise fieldcal.FieldcalError(ReasonCode.WRONG_OPTION, told)
        removable.append(old_signals(root, moment))
    if vehicle is not None:
        removable.append(of_vehicle(root, vehicle))
    every: list[Removable | Garbage] = [*removable, *([former] if former is not None else [])]
    told_of = [{"what": one.what, "lost": one.lost, "files": len(one.files), "bytes": one.size_bytes} for one in every]
    lines = [f"{one.what}: {len(one.files)} files, {one.size_bytes / 1e6:.1f} MB. Lost is {one.lost}." for one in every]
    if yes:
        with fleet_lock(root):
            for one in removable:
                remove(root, one)
            if former is not None:
                former.remove()
    if as_json:
        print_json({"removed": yes, "what": told_of})
        return 0
    print("\n".join(lines))
    if not yes:
        print("Nothing was removed: fieldcal prune --yes with the same options does.")
    return 0


def schemas(name: str | None = None, /, *, wide: Wide = False, as_json: AsJson = False, markdown: bool = False) -> int:
    """The tables and views that can be asked: columns with type, unit and meaning.

    Parameters
    ----------
    name
        One of them; else all, by name.
    markdown
        As Markdown, whole.
    """
    from fieldcal.cli.present.screen import console, table
    from fieldcal.cli.show import print_json
    from fieldcal.warehouse.questions import nearest
    from fieldcal.warehouse.reference import markdown as as_markdown
    from fieldcal.warehouse.reference import relations

    known = relations()
    if name is not None and name not in known:
        told = f"There is no table or view {name!r}; {nearest(name, known)}."
        raise fieldcal.FieldcalError(ReasonCode.NOT_FOUND, told)
    asked = list(known.values()) if name is None else [known[name]]
    if as_json:
        print_json([one.as_json() for one in asked])
    elif markdown:
        print(as_markdown(asked))
    elif name is None:
        lines = [
            [one.name, one.kind, one.meaning.partition(". ")[0].partition(": ")[0].removesuffix(".")] for one in asked
        ]
        console(wide=wide).print(table(["name", "kind", "what"], lines))
        print("fieldcal schemas NAME: its columns.")
    else:
        (one,) = asked
        console(wide=wide).print(f"{one.name} ({one.kind}): {one.meaning}", markup=False)
        lines = [[f"{c.name} *" if c.key else c.name, c.type, c.unit, c.meaning] for c in one.columns]
        console(wide=wide).print(table(["column", "type", "unit", "meaning"], lines))
        if one.example:
            print(f'fieldcal sql "{one.example}"')
    return 0


def export_warehouse(
    *,
    duckdb: Path,
    replace: bool = False,
    as_json: AsJson = False,
    warehouse: Root = None,
    config: UnusedConfig = None,
) -> int:
    """The history in one file, with its views, for tools that know nothing of fieldcal.

    Parameters
    ----------
    duckdb
        The DuckDB file to write.
    replace
        Replace a file that is there.
    """
    from fieldcal.cli.show import print_json
    from fieldcal.warehouse.upkeep.duckdb_file import write_duckdb

    written = write_duckdb(fieldcal.Warehouse(warehouse).root, duckdb, replace=replace)
    if as_json:
        print_json(written)
        return 0
    rows = ", ".join(f"{table} {count}" for table, count in written["tables"].items())
    print(f"{written['path']}: rows of {rows}; views {', '.join(written['views'])}")
    return 0
