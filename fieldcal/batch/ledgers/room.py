"""After a night: the warehouse back within the size that `[warehouse]` of fieldcal.toml gives it."""

from __future__ import annotations

from fieldcal.batch.ledgers.flights import Ledger
from fieldcal.batch.night import Night
from fieldcal.remote.cache import WAREHOUSES, origin
from fieldcal.warehouse.lock import fleet_lock
from fieldcal.warehouse.upkeep.prune import remove
from fieldcal.warehouse.upkeep.room import excess
from fieldcal.words.talk import say


def make_room(night: Night) -> None:
    """Remove, of the flights that flew longest ago, what is beyond the limit, and say so. Nights do not make it again
    until a setting, the code or the log is another. By URL readings stay: they are the store's."""
    limit_gb = night.configuration.largest_gb
    if limit_gb is None:
        return
    with fleet_lock(night.root):
        found = excess(night.root, limit_gb * 1e9, readings=origin(WAREHOUSES, night.root) is None)
        if found is None:
            return
        ledger = Ledger(night.root, night.configuration)
        whole = ledger.as_they_were(found.flights)
        remove(night.root, found.removable)
        ledger.let_go(whole)
    told = [f"The warehouse was {found.size_bytes / 1e9:.2f} GB, largest_gb is {limit_gb:g}."]
    if found.flights:
        told.append(f"Removed were {found.removable.what}. Lost is {found.removable.lost}.")
    if found.left_bytes > limit_gb * 1e9:
        told.append(f"{found.left_bytes / 1e9:.2f} GB are history, pages and records, which stay: give it more.")
    say(" ".join(told))
