"""Processes that work for the one that started them, and end with it."""

from __future__ import annotations

import multiprocessing
import os
import threading


def one_of_many() -> None:
    """Begin a process that shares the processors with others: it ends with the one that started it, and polars, which
    must not be loaded yet, asks one thread: to hand small tables around among several costs more than it brings."""
    os.environ.setdefault("POLARS_MAX_THREADS", "1")
    end_with_parent()


def end_with_parent() -> None:
    """End this process, at once, when the one that started it is gone, killed say; whatever is on disk is whole."""
    parent = multiprocessing.parent_process()
    if parent is None:
        return

    def wait() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()
