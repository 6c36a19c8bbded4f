"""YAML written as text: little of the language is used, and strings are quoted as JSON is."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from fieldcal.geometry.rotation import Array


def rows(matrix: Array, indent: str) -> Iterable[str]:
    """A matrix as a list of lists, a line a row."""
    return [f"{indent}- {row(values)}" for values in matrix]


def row(values: Array) -> str:
    """Numbers as a list."""
    return "[" + ", ".join(number(float(v)) for v in values) + "]"


def number(value: float) -> str:
    """A float as YAML 1.1 reads it: 1e-05 without a dot would be text."""
    if not np.isfinite(value):
        return ".nan"
    text = repr(value)
    return text.replace("e", ".0e", 1) if "e" in text and "." not in text else text
