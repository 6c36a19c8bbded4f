"""What closes a night, once its flights are published: the fleet's trends, what is new in them, reports, the site."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path

from fieldcal.batch.sources import TRENDS, sources
from fieldcal.batch.trends import INPUTS, update_trends
from fieldcal.config.configuration import Alerts
from fieldcal.names import Json
from fieldcal.provenance.run_key import run_key
from fieldcal.schemas import FLEET_TABLES, HISTORY_TABLES, TABLES
from fieldcal.schemas.arrow import VERSION_KEY
from fieldcal.trends.changes import Change, changes, last_usable
from fieldcal.warehouse import Warehouse
from fieldcal.warehouse.checksums import assure, history_digest
from fieldcal.warehouse.decisions.withdrawn import decisions
from fieldcal.warehouse.errors import disk
from fieldcal.warehouse.files import write_bytes
from fieldcal.warehouse.layout import history_files
from fieldcal.warehouse.lock import fleet_lock
from fieldcal.warehouse.publish import settle
from fieldcal.warehouse.remote.copy import refresh
from fieldcal.warehouse.remote.share import share
from fieldcal.warehouse.sealed import BrokenSeal, seal, unseal
from fieldcal.warehouse.store import read_facts
from fieldcal.warehouse.upkeep.verify import night_files

MOST_PAGES = 10


@dataclass
class Closing:
    """What is new in the fleet, and where its report and its site are."""

    changes: list[Change] = field(default_factory=list)
    report: Path | None = None
    site: Path | None = None


def close_night(root: Path, alerts: Alerts) -> Closing:
    """Bring trends and reports up to the history; what is to be told tonight that was not told before.

    Trends are regressed only where the history, or the code that makes them, is another than last time. Reports: the
    fleet's page, and the pages of vehicles of which something is told; `fieldcal report` makes any other. The site has
    all of them, and of it only what changed is written.

    The history is held against its records first, so that no night ends well over damage that it had no need to read.

    Raises
    ------
    WarehouseError
        As `fieldcal.trends.drift_table.update_drift`; `damaged_file`, `busy`.
    """
    now = datetime.now(UTC)
    with fleet_lock(root):
        refresh(root)
        assure(root, [path for table in HISTORY_TABLES for path in history_files(root, table)], strict=True)
        _forget_damaged(root)
        before = _remembered(root)
        _forget_older_versions(root)
        for vehicle_id in decisions(root)["vehicle_id"].unique().sort().to_list():
            settle(root, vehicle_id)  # where deciding was interrupted, rows do not follow yet
        former = Warehouse(root).scan("drift").collect()
        made_from = _made_from(root)
        if before.get("made_from") != made_from or before.get("made") != history_digest(root, FLEET_TABLES):
            update_trends(root)
            made_from = _made_from(root)
        table = Warehouse(root).scan("drift").collect()
        # With other limits than last time, what they make old is told whenever it passed them.
        limits: dict[str, Json] = {"expires_days": alerts.expires_days, "idle_days": alerts.idle_days}
        at = before.get("at")
        since = datetime.fromisoformat(at) if isinstance(at, str) and before.get("alerts") == limits else None
        told = changes(former, table, last_usable(root), now=now, since=since, alerts=alerts)
        made = history_digest(root, FLEET_TABLES)
        record = {"at": now.isoformat(), "made_from": made_from, "made": made, "alerts": limits}
        write_bytes(_place(root), seal(record), durable=False)
        closing = Closing(told, _reports(root, told), _site(root, alerts, now))
        share(root)
        return closing


def _reports(root: Path, told: Sequence[Change]) -> Path:
    from fieldcal.report import write_night_reports

    vehicles = list(dict.fromkeys(change.vehicle_id for change in told if change.kind not in ("expired", "idle")))
    return write_night_reports(root, vehicles[:MOST_PAGES])[0]


def _site(root: Path, alerts: Alerts, now: datetime) -> Path:
    from fieldcal.site import write_site

    return write_site(root, alerts, now=now)


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


def _remembered(root: Path) -> Mapping[str, Json]:
    try:
        return unseal(_place(root).read_bytes())
    except (OSError, BrokenSeal):
        return {}


def _place(root: Path) -> Path:
    return root / "night" / "closing.json"
