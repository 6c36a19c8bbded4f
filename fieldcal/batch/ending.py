"""How every night ends once its flights are published, and a night that has nothing else to do: nothing of Prefect."""

from __future__ import annotations

from collections.abc import Sequence

from fieldcal.batch.closing import Closing, close_night
from fieldcal.batch.documents import NightDocument
from fieldcal.batch.ledgers.room import make_room
from fieldcal.batch.night import Night, Watcher
from fieldcal.batch.outcome import Outcome
from fieldcal.batch.telling import telling
from fieldcal.report.fitness import Criteria


def end_night(night: Night, outcomes: Sequence[Outcome], workers: int) -> tuple[NightDocument, Closing]:
    """Remember what came out, bring trends, reports and the site up to it, keep the warehouse to its size; the JSON of
    the night, and what is new in it."""
    night.remember(outcomes)
    criteria, with_site = Criteria.of(night.configuration), night.configuration.writes_site
    closing = close_night(night.root, criteria, with_site=with_site, workers=workers)
    if outcomes:
        make_room(night)
    return night.document(outcomes, closing), closing


def quiet_night(night: Night, watcher: Watcher | None, workers: int) -> NightDocument:
    """Carry out a night without work (`Night.has_work`): time alone may have made something new, which is told."""
    with telling(night) as tell:
        if watcher is not None:
            watcher.planned(len(night.plan.jobs), 0, len(night.plan.done))
        result, _ = end_night(night, [], workers)
        tell(result)
        return result
