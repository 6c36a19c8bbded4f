"""What a ULog file is made of: message headers, definitions, and the few messages that are looked at one by one.

A file is 16 bytes (magic, version, start in µs since boot), then messages: two bytes size, one byte type, payload.
There is no checksum. What a message says of itself is therefore checked against all that is known of its kind.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np

MAGIC = b"ULog\x01\x12\x35"
FILE_HEAD_BYTES = 16
HEAD_BYTES = 3
SYNC = b"\x2f\x73\x13\x20\x25\x0c\xbb\x12"
SYNC_MESSAGE = struct.pack("<HB", len(SYNC), ord("S")) + SYNC
FLAG_BITS_BYTES = 40
DATA_APPENDED = 1
"""The only incompatible flag that is known: data was written behind the end, at the offsets that the flags give."""

FLAGS, FORMAT, INFO, INFO_MULTIPLE, PARAMETER, PARAMETER_DEFAULT = b"BFIMPQ"
SUBSCRIPTION, UNSUBSCRIPTION, DATA, TEXT, TAGGED_TEXT, SYNC_KIND, DROPOUT = b"ARDLCSO"
KINDS = bytes(
    (
        *(FLAGS, FORMAT, INFO, INFO_MULTIPLE, PARAMETER, PARAMETER_DEFAULT, SUBSCRIPTION, UNSUBSCRIPTION),
        *(DATA, TEXT, TAGGED_TEXT, SYNC_KIND, DROPOUT),
    )
)
KIND_COUNT = 256

BASIC_TYPES: Mapping[str, str] = {
    "int8_t": "i1",
    "uint8_t": "u1",
    "int16_t": "<i2",
    "uint16_t": "<u2",
    "int32_t": "<i4",
    "uint32_t": "<u4",
    "int64_t": "<i8",
    "uint64_t": "<u8",
    "float": "<f4",
    "double": "<f8",
    "bool": "u1",
    "char": "S1",
}
MOST_ELEMENTS = 4096
MOST_NESTED = 8
MESSAGE_ID_BYTES = 2
LARGEST_PAYLOAD = 65535

_FORMAT = re.compile(rb"[\w/]+:(?:[\w/]+(?:\[\d{1,5}\])? \w+;)*")
_FIELD = re.compile(r"([\w/]+)(?:\[(\d+)\])? (\w+)")
_KEY = re.compile(rb"(\w+)(?:\[(\d{1,5})\])? [\w.\-/]+")
_NAME = re.compile(rb"[\w/]+")
_VALUE = {"int32_t": struct.Struct("<i"), "float": struct.Struct("<f")}


@dataclass(frozen=True)
class Field:
    """A field of a message: `type_name` basic or of another format, `count` None for a single value."""

    name: str
    type_name: str
    count: int | None


@dataclass(frozen=True)
class Topic:
    """One instance of a topic, as the log subscribes it. `kind`: its rows, trailing padding left out."""

    name: str
    instance: int
    message_id: int
    kind: np.dtype[np.void]
    padding_bytes: int

    @property
    def sizes(self) -> tuple[int, int]:
        """Least and largest payload of its data messages: padding at the end is logged, or not."""
        least = MESSAGE_ID_BYTES + self.kind.itemsize
        return least, least + self.padding_bytes


def fits(kind: int, payload: bytes) -> bool:
    """Whether a payload is one of this kind by itself; data messages are checked against their topic instead."""
    if kind == FORMAT:
        return _FORMAT.fullmatch(payload) is not None
    if kind in (INFO, INFO_MULTIPLE):
        return _keyed(payload, int(kind == INFO_MULTIPLE))
    if kind in (PARAMETER, PARAMETER_DEFAULT):
        return _keyed(payload, int(kind == PARAMETER_DEFAULT), _VALUE)
    if kind == SUBSCRIPTION:
        return _NAME.fullmatch(payload[3:]) is not None
    if kind == TEXT:
        return len(payload) >= 9 and payload[:1] in b"01234567" and b"\0" not in payload[9:]
    if kind == TAGGED_TEXT:
        return len(payload) >= 11 and payload[:1] in b"01234567" and b"\0" not in payload[11:]
    if kind == SYNC_KIND:
        return payload == SYNC
    if kind in (UNSUBSCRIPTION, DROPOUT):
        return len(payload) == 2
    return kind == FLAGS and len(payload) >= FLAG_BITS_BYTES


def read_format(payload: bytes) -> tuple[str, str]:
    """Name of a format that `fits`, and its fields as text: most of a file's formats are not asked for."""
    name, _, fields = payload.decode("ascii").partition(":")
    return name, fields


def fields_of(text: str) -> list[Field]:
    """The fields in a format's text."""
    found = (_FIELD.fullmatch(own) for own in text.split(";") if own)
    return [Field(match[3], match[1], None if match[2] is None else int(match[2])) for match in found if match]


def read_keyed(payload: bytes, before: int = 0) -> tuple[str, str, bytes]:
    """Type, key and value of an information or parameter that `fits`; `before` bytes stand before its key."""
    split = before + 1 + payload[before]
    type_name, _, key = payload[before + 1 : split].decode("ascii").partition(" ")
    return type_name, key, payload[split:]


def number_of(type_name: str, value: bytes) -> float | None:
    """A parameter's value; None where it is none of ULog's two types."""
    reader = _VALUE.get(type_name)
    return float(reader.unpack(value)[0]) if reader and len(value) == reader.size else None


def text_of(type_name: str, value: bytes) -> str:
    """An information's value as text."""
    base = type_name.partition("[")[0]
    if base == "char":
        return value.decode("utf-8", "replace").rstrip("\0")
    kind = np.dtype(BASIC_TYPES.get(base, "V1"))
    if kind.kind == "V" or not value or len(value) % kind.itemsize:
        return value.hex()
    return " ".join(str(number) for number in np.frombuffer(value, kind).tolist())


def row_kind(name: str, formats: Mapping[str, str], depth: int = 0) -> tuple[np.dtype[np.void], int]:
    """The structured type of a topic's rows without its trailing padding, and how many bytes that padding has.

    Raises ValueError where a nested format is missing, or sizes are none that a logger writes.
    """
    if name not in formats or depth > MOST_NESTED:
        raise ValueError(f"format {name} is not defined")
    names: list[str] = []
    kinds: list[np.dtype] = []
    fields = fields_of(formats[name])
    padding = 0
    while depth == 0 and fields and fields[-1].name.startswith("_padding"):
        padding += fields.pop().count or 1
    for field in fields:
        if field.name in names or not (field.count is None or 0 < field.count <= MOST_ELEMENTS):
            raise ValueError(f"format {name} has an impossible field {field.name}")
        if field.type_name == "char" and field.count is not None:
            kind: np.dtype = np.dtype(f"S{field.count}")
        else:
            basic = BASIC_TYPES.get(field.type_name)
            kind = np.dtype(basic) if basic else row_kind(field.type_name, formats, depth + 1)[0]
            if field.count is not None:
                kind = np.dtype((kind, (field.count,)))
        names.append(field.name)
        kinds.append(kind)
    rows = np.dtype({"names": names, "formats": kinds})
    if rows.itemsize + padding + MESSAGE_ID_BYTES > LARGEST_PAYLOAD:
        raise ValueError(f"format {name} is larger than a message")
    return rows, padding


def _keyed(payload: bytes, before: int, allowed: Collection[str] = BASIC_TYPES) -> bool:
    """Whether a key of one of the allowed types and a value of its size make up the payload."""
    if len(payload) <= before:
        return False
    split = before + 1 + payload[before]
    match = _KEY.fullmatch(payload[before + 1 : split])
    if not match or match[1].decode() not in allowed:
        return False
    return len(payload) - split == np.dtype(BASIC_TYPES[match[1].decode()]).itemsize * int(match[2] or 1)
