"""Linear algebra on one thread, so that a result does not depend on how many cores or workers there are."""

from __future__ import annotations

from contextlib import AbstractContextManager


def one_thread() -> AbstractContextManager[object]:
    """Within the block the linear algebra libraries use one thread: sums are always taken in the same order."""
    from threadpoolctl import threadpool_limits

    limited: AbstractContextManager[object] = threadpool_limits(1)
    return limited
