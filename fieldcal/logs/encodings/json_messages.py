"""JSON messages, decoded one by one: the field names of ROS, or of Foxglove's schemas."""

from __future__ import annotations

import json
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from fieldcal.logs.encodings.decoded import (
    COMPONENTS,
    NANOSECOND_NAMES,
    NANOSECONDS,
    SECOND_NAMES,
    STAMP_FIELDS,
    Decoded,
    Want,
    decode_each,
)
from fieldcal.names import Json

MESSAGE_CAP_BYTES = 1 << 20
"""As an object JSON takes many times its length; a reading is some hundred bytes long."""


class JsonDecoder:
    """Reads `wants` from JSON objects. A message that lacks one, is too long or no JSON, is left out."""

    def __init__(self, wants: Mapping[str, Want]) -> None:
        self._wants = dict(wants)

    def decode(self, data: NDArray[np.uint8], starts: NDArray[np.int64], sizes: NDArray[np.int64]) -> Decoded:
        """See `Decoder.decode`."""
        return decode_each(self._read, self._wants, data, starts, sizes)

    def _read(self, payload: bytes) -> tuple[int | None, list[list[float]]]:
        if len(payload) > MESSAGE_CAP_BYTES:
            raise ValueError("too long for a reading")
        message: Json = json.loads(payload)
        return _stamp(message), [_numbers(message, want) for want in self._wants.values()]


def _stamp(message: Json) -> int | None:
    for path in STAMP_FIELDS:
        try:
            stamp = _field(message, path)
        except KeyError:
            continue
        if not isinstance(stamp, dict):
            continue
        seconds = [stamp[name] for name in SECOND_NAMES if name in stamp]
        nanoseconds = [stamp[name] for name in NANOSECOND_NAMES if name in stamp]
        if seconds:
            return _whole(seconds[0]) * NANOSECONDS + _whole(nanoseconds[0] if nanoseconds else 0)
    return None


def _whole(value: Json) -> int:
    if not isinstance(value, str | int | float):
        raise TypeError("not a number")
    return int(value)


def _numbers(message: Json, want: Want) -> list[float]:
    if len(want.paths) > 1:
        return [_number(_field(message, path)) for path in want.paths]
    value = _field(message, want.paths[0])
    if want.width == 1:
        return [_number(value)]
    if isinstance(value, dict):
        parts: list[Json] = [value[component] for component in COMPONENTS[want.width]]
    elif isinstance(value, list):
        parts = value
    else:
        raise TypeError("neither an array nor an object")
    if len(parts) != want.width:
        raise ValueError(f"not {want.width} numbers")
    return [_number(part) for part in parts]


def _number(value: Json) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise TypeError("not a number")
    return float(value)


def _field(message: Json, path: str) -> Json:
    for name in path.split("."):
        if not isinstance(message, dict):
            raise KeyError(name)
        message = message[name]
    return message
