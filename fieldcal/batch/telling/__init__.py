"""What a night says to people and machines elsewhere: one message, and a file of metrics."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from fieldcal.batch.documents import NightDocument
from fieldcal.batch.night import Night
from fieldcal.batch.telling.message import failure_of, news_of
from fieldcal.batch.telling.metrics import write_metrics
from fieldcal.batch.telling.send import tell_once
from fieldcal.errors import FieldcalError
from fieldcal.words.talk import say


@contextmanager
def telling(night: Night) -> Iterator[Callable[[NightDocument], None]]:
    """Within the block a night may tell those whom `[alerts]` names what came of it; that it failed is told by itself.
    What goes wrong with telling is talk, and no night's failure."""
    alerts, began_s = night.configuration.alerts, time.time()

    def tell(result: NightDocument) -> None:
        if alerts.metrics is not None:
            now_s = time.time()
            try:
                write_metrics(Path(alerts.metrics), result, night.root, ended_at_s=now_s, seconds=now_s - began_s)
            except FieldcalError as error:
                say(error.sentence)
            except OSError as error:
                say(f"{alerts.metrics} cannot be written: {error.strerror}.")
        if message := news_of(result, night.archive, alerts.link):
            tell_once(night.root, message, alerts.to, os.environ)

    try:
        yield tell
    except Exception as error:
        tell_once(night.root, failure_of(error, night.archive), alerts.to, os.environ)
        raise
