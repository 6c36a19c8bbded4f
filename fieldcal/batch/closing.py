"""What closes a night, once its flights are published: the fleet's trends, what is new in them, reports, the site."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path

from fieldcal.batch.sources import TRENDS, sources
from fieldcal.batch.trends import INPUTS, update_trends
from fieldcal.provenance.run_key import run_key
from fieldcal.report.fitness import Criteria, fleet_fitness
from fieldcal.report.standing.memory import remember, remembered, remembered_fleet
from fieldcal.report.standing.news import Change, news
from fieldcal.schemas import FLEET_TABLES, HISTORY_TABLES, TABLES
from fieldcal.schemas.arrow import VERSION_KEY
from fieldcal.warehouse.checksums import assure, history_digest
from fieldcal.warehouse.decisions.withdrawn import decisions
from fieldcal.warehouse.errors import disk
from fieldcal.warehouse.layout import history_files
from fieldcal.warehouse.lock import fleet_lock
from fieldcal.warehouse.publish import settle
from fieldcal.warehouse.remote.copy import refresh
from fieldcal.warehouse.remote.share import share
from fieldcal.warehouse.store import read_facts
from fieldcal.warehouse.upkeep.verify import night_files

MOST_PAGES = 10


@dataclass
class Closing:
    """What is new in the fleet, and where its report and its site are."""

    changes: list[Change] = field(default_factory=list)
    report: Path | None = None
    site: Path | None = None


def close_night(root: Path, criteria: Criteria, *, with_site: bool = True, workers: int = 1) -> Closing:
    """Bring trends and reports up to the history; what is to be told tonight that was not told before.

    Trends are regressed only where the history, or the code that makes them, is another than last time. The fleet is
    judged once: the site, the terminal and messages say the same. Of the site, which has a page of everything, only
    what changed is written, by so many `workers`, who draw flights' pages while the trends are made. Of reports the
    fleet's page is written, and without a site the pages of vehicles of which something is told; `fieldcal report`
    makes any.

    The history is held against its records first, so that no night ends well over damage that it had no need to read.

    Raises
    ------
    WarehouseError
        As `fieldcal.trends.drift_table.update_drift`; `damaged_file`, `busy`.
    """
    from fieldcal.report import write_night_reports
    from fieldcal.site.drawing import Drawing
    from fieldcal.site.snapshot import Snapshot
    from fieldcal.site.write import draw_ahead, write_pages

    now = datetime.now(UTC)
    with fleet_lock(root):
        refresh(root)
        assure(root, [path for table in HISTORY_TABLES for path in history_files(root, table)], strict=True)
        _forget_damaged(root)
        before = remembered(root)
        _forget_older_versions(root)
        for vehicle_id in decisions(root)["vehicle_id"].unique().sort().to_list():
            settle(root, vehicle_id)  # where deciding was interrupted, rows do not follow yet
        made_from = _made_from(root)
        with Drawing(root, workers) as drawing:
            if before.get("made_from") != made_from or before.get("made") != history_digest(root, FLEET_TABLES):
                if with_site:
                    draw_ahead(root, drawing)
                update_trends(root)
                made_from = _made_from(root)
            snapshot = Snapshot(root)
            fleet = fleet_fitness(snapshot, criteria, now)
            told = news(fleet, remembered_fleet(root))
            site = write_pages(snapshot, fleet, drawing) if with_site else None
            pages: list[str] = [] if with_site else _to_read(told)
            report = write_night_reports(root, pages, fleet if with_site else ())[0]
        made = history_digest(root, FLEET_TABLES)
        remember(root, fleet, criteria, {"made_from": made_from, "made": made})
        share(root)
        return Closing(told, report, site)


def _to_read(told: Sequence[Change]) -> list[str]:
    """Vehicles of which something is told that their page shows."""
    vehicles = dict.fromkeys(change.vehicle_id for change in told if change.kind not in ("expired", "idle"))
    return list(vehicles)[:MOST_PAGES]


def _forget_damaged(root: Path) -> None:
    """Remove what nights remember where it is damaged: it is made anew."""
    for shown, wrong in night_files(root):
        if wrong is not None:
            with disk(root / shown, "removed"):
                (root / shown).unlink(missing_ok=True)


def _forget_older_versions(root: Path) -> None:
    """Remove trends that an older release wrote in another form: they follow from the history and are made anew. Those
    of a newer one stay, and whoever reads them says so."""
    for table, path in [(name, path) for name in FLEET_TABLES for path in history_files(root, name)]:
        try:
            version = int(read_facts(path).get(VERSION_KEY, "0"))
        except (OSError, ValueError):
            continue  # damaged, which publishing tells
        if version < TABLES[table].version:
            with disk(path, "removed"):
                path.unlink()


def _made_from(root: Path) -> str:
    """Digest of what trends are made from: the history and the code that makes them of it."""
    return run_key(TRENDS, sources()[TRENDS], {}, {"history": history_digest(root, INPUTS)})
