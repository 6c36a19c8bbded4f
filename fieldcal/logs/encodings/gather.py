"""Values at many places of a stretch of bytes, taken at once."""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

T = TypeVar("T", bound=np.generic)


def gather(data: NDArray[np.uint8], offsets: NDArray[np.int64], dtype: np.dtype[T], count: int = 1) -> NDArray[T]:
    """Values of `dtype` lying at byte `offsets` of `data`: shape (n,), or (n, count) when `count` > 1.

    The caller has checked that every offset leaves room for the value.
    """
    size = dtype.itemsize * count
    if not offsets.size:
        return np.empty((0, count) if count > 1 else 0, dtype)
    windows: NDArray[np.void] = np.ndarray(
        (data.size - size + 1,), dtype=np.dtype((np.void, size)), buffer=data, strides=(1,)
    )
    values = windows[offsets].view(dtype)
    return values.reshape(-1, count) if count > 1 else values
