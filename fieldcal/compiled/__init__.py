"""The compiled kernel: the estimators' inner loops in C, where installation found a compiler (docs/adr, 0006).

Every function here has a NumPy counterpart, which runs where there is no kernel and which tests compare it with.
`FIELDCAL_KERNEL=numpy` in the environment leaves the kernel out. Functions take arrays and know no model; they write
into arrays that the caller has made, and allocate nothing.
"""

from __future__ import annotations

import ctypes
import hashlib
import importlib.machinery
import os
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

FOLDER = Path(__file__).parent
SWITCH = "FIELDCAL_KERNEL"
NUMPY = "numpy"


def source_digest() -> str:
    """12 hex digits of the C beside this file, as `setup.py` compiles them in."""
    sources = sorted([*FOLDER.glob("*.c"), *FOLDER.glob("*.h")])
    return hashlib.sha256(b"".join(path.read_bytes() for path in sources)).hexdigest()[:12]


def load() -> tuple[ctypes.CDLL | None, str]:
    """The kernel, or None, and a sentence on which one runs."""
    if os.environ.get(SWITCH, "").lower() == NUMPY:
        return None, f"NumPy, as {SWITCH} asks"
    built = [FOLDER / f"_kernel{suffix}" for suffix in importlib.machinery.EXTENSION_SUFFIXES]
    found = next((path for path in built if path.is_file()), None)
    if found is None:
        return None, "NumPy: none was compiled when fieldcal was installed"
    try:
        library = ctypes.CDLL(str(found))
        name = ctypes.c_char_p.in_dll(library, "fieldcal_source").value or b""
    except (OSError, ValueError) as error:
        return None, f"NumPy: {found.name} does not load ({error})"
    if name.decode() != source_digest():
        return None, f"NumPy: {found.name} was compiled from another source"
    library.eliminate.restype = ctypes.c_int64
    return library, f"C, {name.decode()}"


LIBRARY, DESCRIPTION = load()


def kernel_name() -> str:
    """What computes, for the key of a result: "numpy", or "c" and the digest of the C source."""
    return NUMPY if LIBRARY is None else f"c-{source_digest()}"


def pointer(array: np.ndarray) -> ctypes.c_void_p:
    """Of a contiguous array to hand to the kernel; the caller keeps the array."""
    if not array.flags.c_contiguous:
        raise ValueError("The kernel takes contiguous arrays.")
    return ctypes.c_void_p(array.ctypes.data)


def real(array: ArrayLike, *shape: int) -> np.ndarray:
    """As contiguous doubles, the shape checked: C reads as far as the shape says."""
    return _checked(np.ascontiguousarray(array, dtype=np.float64), shape)


def whole(array: ArrayLike, *shape: int) -> np.ndarray:
    """The same of 64-bit integers."""
    return _checked(np.ascontiguousarray(array, dtype=np.int64), shape)


def flags(array: ArrayLike, *shape: int) -> np.ndarray:
    """The same of booleans, a byte each."""
    return _checked(np.ascontiguousarray(array, dtype=np.bool_), shape)


def _checked(array: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    if array.shape != shape:
        raise ValueError(f"The kernel was given {array.shape} instead of {shape}.")
    return array
