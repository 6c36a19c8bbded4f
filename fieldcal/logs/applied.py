"""What an autopilot had done to the readings of a flight, as one map from raw to logged readings."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypedDict

import numpy as np
from scipy.linalg import polar

from fieldcal.logs.interface import SensorSource


class Applied(TypedDict):
    """logged = matrix · raw + offset, raw readings in the axes of the logged ones: the mounting is taken out.

    `matrix` (3, 3) symmetric; `offset` (3,) in the logged unit, at the flight's temperatures; `matrix_sd`, `offset_sd`
    (3,): how far they changed within the flight; `offset_per_degc` (3,): slope of the offset over temperature, where
    the autopilot compensates for it; `parameters`: those of the longest stretch; `known`: false where the log does not
    have them, so that what was done is not known."""

    matrix: list[list[float]]
    offset: list[float]
    matrix_sd: float
    offset_sd: list[float]
    offset_per_degc: list[float]
    parameters: dict[str, float]
    known: bool


def applied(sources: Sequence[SensorSource], first_ns: int, last_ns: int) -> dict[str, Applied]:
    """Sensor → what had been done to its readings between two times, the mean over time; sensors whose readings are
    raw are absent. `sources`: one a sensor."""
    out: dict[str, Applied] = {}
    for source in sources:
        if not source.corrections:
            continue
        begins = np.array([one.from_ns for one in source.corrections], dtype=np.float64)
        ends = np.append(begins[1:], max(float(last_ns), begins[-1] + 1.0))
        span = np.clip(np.minimum(ends, last_ns) - np.maximum(begins, first_ns), 0.0, None)
        if begins[0] > first_ns:  # before the first word of it the first is the best guess
            span[0] += begins[0] - first_ns
        weight = span / span.sum() if span.sum() > 0.0 else np.full(len(span), 1.0 / len(span))
        matrices = np.array([polar(np.array(one.matrix), side="left")[1] for one in source.corrections])
        offsets = np.array([one.offset for one in source.corrections])
        matrix, offset = np.tensordot(weight, matrices, 1), weight @ offsets
        out[str(source.sensor)] = {
            "matrix": matrix.tolist(),
            "offset": offset.tolist(),
            "matrix_sd": float(np.sqrt(np.max(np.tensordot(weight, (matrices - matrix) ** 2, 1)))),
            "offset_sd": np.sqrt(weight @ (offsets - offset) ** 2).tolist(),
            "offset_per_degc": (weight @ np.array([one.offset_per_degc for one in source.corrections])).tolist(),
            "known": all(one.parameters for one in source.corrections),
            "parameters": dict(source.corrections[int(np.argmax(weight))].parameters),
        }
    return out
