"""What all flights tell together, brought up to the history: the tables `drift` and `pooled`."""

from __future__ import annotations

from pathlib import Path

from fieldcal.schemas import FLIGHT_TABLES
from fieldcal.warehouse.checksums import history_digest
from fieldcal.warehouse.remote.copy import refresh

INPUTS = (*FLIGHT_TABLES, "decision")
"""Tables that trends are made from."""
_MOST_ROUNDS = 20
"""Others may publish flights all the time; the last of them brings up the trends."""


def update_trends(root: Path) -> set[str]:
    """Regress the trends anew; vehicles whose trends became others. The caller holds the fleet's lock.

    By URL that lock keeps nobody else away: where others have published flights meanwhile, trends are made once more,
    so that whoever ends last has made them of all flights.

    Raises
    ------
    WarehouseError
        As `fieldcal.trends.drift_table.update_drift`.
    """
    from fieldcal.trends.drift_table import update_drift  # regressions, which a night with nothing new does not need

    changed: set[str] = set()
    for _ in range(_MOST_ROUNDS):
        made_from = history_digest(root, INPUTS)
        changed |= set(update_drift(root))
        if not refresh(root) or history_digest(root, INPUTS) == made_from:
            break
    return changed
