"""Ctrl-C and SIGTERM: stop within two seconds, whatever is going on. What is on disk is whole at any moment."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

PATIENCE_S = 1.5
INTERRUPTED = 130


@contextmanager
def interruptible() -> Iterator[None]:
    """Within the block a signal raises KeyboardInterrupt, and ends the process if that takes too long."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    former = {number: signal.signal(number, _stop) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in former.items():
            signal.signal(number, handler)


def _stop(number: int, frame: FrameType | None) -> None:
    if multiprocessing.parent_process() is not None:
        os._exit(INTERRUPTED)
    for child in multiprocessing.active_children():
        child.terminate()
    timer = threading.Timer(PATIENCE_S, _end)
    timer.daemon = True
    timer.start()
    raise KeyboardInterrupt


def _end() -> None:
    for child in multiprocessing.active_children():
        child.kill()
    print("fieldcal: Interrupted; what is done is kept, the next run goes on from there.", file=sys.stderr, flush=True)
    os._exit(INTERRUPTED)
