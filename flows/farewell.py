"""Processes end in time: `serve` with its server, and none waits for one that is gone.

Prefect tells its server of every task from a queue, and at exit waits until all has been told: for ever, if nobody
listens any more. Its records are worth an attempt, not a night.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable

from fieldcal.words.talk import say

ATTEMPTS = 3
"""Before each one more than these Prefect waits for a second."""
LOOK_EVERY_S = 2.0


def end_with_server(lives: Callable[[], bool], sentence: str) -> None:
    """End this process with exit code 1 and a sentence when the server that it hosts schedules for is gone.

    At once: what would be said goodbye to is the server. The runs it had started end with it
    (`end_with_parent`).
    """

    def wait() -> None:
        while lives():
            time.sleep(LOOK_EVERY_S)
        say(f"fieldcal: {sentence}")
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


def tell_while_heard() -> None:
    """From now on, in this process, Prefect tries each event of a server that was lost a few times and at once only."""
    from prefect.events.clients import PrefectEventsClient
    from prefect.events.worker import EventsWorker
    from prefect.settings import PREFECT_API_URL

    # The address distinguishes this server's events from those of one that an earlier night had.
    EventsWorker.set_client_override(
        PrefectEventsClient, api_url=PREFECT_API_URL.value(), reconnection_attempts=ATTEMPTS
    )
