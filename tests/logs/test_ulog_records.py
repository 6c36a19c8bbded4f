"""ULog's messages one by one: what fits a kind and what just does not, as PX4's description of the format has it."""

from __future__ import annotations

import struct

import numpy as np
import pytest

from fieldcal.logs.ulog import records
from fieldcal.logs.ulog.records import Field, fields_of, fits, number_of, read_keyed, row_kind, text_of


def keyed(key: str, value: bytes, before: bytes = b"") -> bytes:
    return before + bytes([len(key)]) + key.encode() + value


@pytest.mark.parametrize(
    ("kind", "payload", "fitting"),
    [
        ("F", b"a:", True),
        ("F", b"a/b:uint8_t x;c[12345] y_2;", True),
        ("F", b"a:uint8_t[123456] x;", False),
        ("F", b"a:uint8_t x", False),
        ("F", b"a", False),
        ("I", keyed("uint32_t a", b"1234"), True),
        ("I", keyed("uint32_t a", b"123"), False),
        ("I", keyed("uint32_t a", b"12345"), False),
        ("I", keyed("char[3] sys-name.b/c", b"abc"), True),
        ("I", keyed("char[3] a", b"abcd"), False),
        ("I", keyed("uint16_t[2] a", b"abcd"), True),
        ("I", keyed("other a", b"a"), False),
        ("I", keyed("char  a", b"a"), False),
        ("I", keyed("char a", b"a")[:-1], False),
        ("I", b"", False),
        ("I", b"\x06", False),
        ("I", b"\xffchar a", False),
        ("M", keyed("char[2] a", b"ab", b"\1"), True),
        ("M", keyed("char[2] a", b"ab"), False),
        ("M", b"\0\0", False),
        ("P", keyed("int32_t A", b"1234"), True),
        ("P", keyed("float A", b"1234"), True),
        ("P", keyed("double A", b"12345678"), False),
        ("P", keyed("float A", b"1234", b"\1"), False),
        ("Q", keyed("float A", b"1234", b"\1"), True),
        ("Q", keyed("float A", b"1234"), False),
        ("A", b"\0\1\0", False),
        ("A", b"\0\1\0a", True),
        ("A", b"\0\1\0a:b", False),
        ("L", b"6" + b"\0" * 8, True),
        ("L", b"6" + b"\0" * 7, False),
        ("L", b"0" + b"\0" * 8 + b"hello", True),
        ("L", b"7" + b"\0" * 8 + b"\0x", False),
        ("L", b"7" + b"\0" * 8 + b"x\0", False),
        ("L", b"8" + b"\0" * 8, False),
        ("C", b"6" + b"\0" * 10, True),
        ("C", b"6" + b"\0" * 9, False),
        ("C", b"6" + b"\0" * 10 + b"\0", False),
        ("C", b"8" + b"\0" * 10, False),
        ("S", records.SYNC, True),
        ("S", records.SYNC[:-1], False),
        ("R", b"\0\0", True),
        ("R", b"\0", False),
        ("O", b"\1\0", True),
        ("O", b"\1\0\0", False),
        ("B", bytes(40), True),
        ("B", bytes(39), False),
        ("B", bytes(48), True),
        ("Z", bytes(40), False),
        ("D", b"\0\0", False),
    ],
)
def test_what_fits_a_kind(kind: str, payload: bytes, fitting: bool) -> None:
    assert fits(ord(kind), payload) is fitting


def test_keys_types_and_values() -> None:
    assert read_keyed(keyed("char[2] a", b"xy")) == ("char[2]", "a", b"xy")
    assert read_keyed(keyed("float B", b"1234", b"\7"), 1) == ("float", "B", b"1234")
    assert number_of("int32_t", struct.pack("<i", -5)) == -5
    assert number_of("float", struct.pack("<f", 0.5)) == 0.5
    assert number_of("float", b"123") is None
    assert number_of("double", bytes(8)) is None


@pytest.mark.parametrize(
    ("type_name", "value", "text"),
    [
        ("char[3]", b"ab\0", "ab"),
        ("char[3]", b"a\0b", "a\0b"),
        ("char", b"a", "a"),
        ("uint16_t", b"\1\0", "1"),
        ("uint16_t[2]", b"\1\0\2\1", "1 258"),
        ("uint16_t", b"\1\0\2", "010002"),
        ("uint16_t", b"", ""),
        ("other", b"\1", "01"),
        ("float", struct.pack("<f", 1.5), "1.5"),
    ],
)
def test_informations_as_text(type_name: str, value: bytes, text: str) -> None:
    assert text_of(type_name, value) == text


def test_fields() -> None:
    assert fields_of("uint8_t a;inner[3] b_1;") == [Field("a", "uint8_t", None), Field("b_1", "inner", 3)]
    assert fields_of("") == []


def size_of(text: str, **more: str) -> tuple[int, int] | None:
    """Bytes of a row and of its padding; None where the format is refused."""
    try:
        kind, padding = row_kind("t", {"t": text, **more})
    except ValueError:
        return None
    return kind.itemsize, padding


@pytest.mark.parametrize(
    ("text", "sizes"),
    [
        ("uint64_t timestamp;", (8, 0)),
        ("uint64_t timestamp;uint8_t a;uint8_t[7] _padding0;", (9, 7)),
        ("uint8_t a;uint8_t _padding0;uint8_t[2] _padding1;", (1, 3)),
        ("uint8_t _padding0;uint8_t a;", (2, 0)),  # in between it is a field
        ("in b;uint8_t[2] _padding0;", (3, 2)),  # and within another format
        ("in[2] b;", (6, 0)),
        ("uint8_t[4096] a;", (4096, 0)),
        ("uint8_t[4097] a;", None),
        ("uint8_t[0] a;", None),
        ("uint8_t[1] a;", (1, 0)),
        ("char a;char[5] b;", (6, 0)),
        ("uint8_t a;uint8_t a;", None),
        ("missing a;", None),
        ("block[15] a;uint8_t[4093] b;", (65533, 0)),  # two bytes of id make it the largest message
        ("block[15] a;uint8_t[4094] b;", None),
        ("block[15] a;uint8_t[4000] b;uint8_t[93] _padding0;", (65440, 93)),
        ("block[15] a;uint8_t[4000] b;uint8_t[94] _padding0;", None),
    ],
)
def test_rows_of_a_format(text: str, sizes: tuple[int, int] | None) -> None:
    assert size_of(text, **{"in": "uint16_t x;uint8_t _padding0;", "block": "uint8_t[4096] x;"}) == sizes


@pytest.mark.parametrize(("depth", "sizes"), [(7, (1, 0)), (8, (1, 0)), (9, None)])
def test_formats_are_nested_eight_deep(depth: int, sizes: tuple[int, int] | None) -> None:
    nested = {f"n{i}": f"n{i + 1} a;" for i in range(1, depth)}
    assert size_of("n1 a;", **nested, **{f"n{depth}": "uint8_t a;"}) == sizes


def test_characters_are_texts_and_other_numbers_arrays() -> None:
    kind, _ = row_kind("t", {"t": "char a;char[5] b;uint8_t c;uint8_t[5] d;uint8_t[1] e;"})
    told = {name: (kind[name].base.str, kind[name].shape) for name in "abcde"}
    assert told == {"a": ("|S1", ()), "b": ("|S5", ()), "c": ("|u1", ()), "d": ("|u1", (5,)), "e": ("|u1", (1,))}


def test_types_are_as_wide_as_their_names_say() -> None:
    for name, code in records.BASIC_TYPES.items():
        bits = (
            "".join(c for c in name if c.isdigit()) or {"float": "32", "double": "64", "bool": "8", "char": "8"}[name]
        )
        assert np.dtype(code).itemsize * 8 == int(bits)
        assert np.dtype(code).kind == {"i": "i", "u": "u", "f": "f", "d": "f", "b": "u", "c": "S"}[name[0]]


def test_a_topics_messages_have_their_padding_or_not() -> None:
    kind, padding = row_kind("t", {"t": "uint64_t timestamp;uint8_t a;uint8_t[7] _padding0;"})
    assert records.Topic("t", 0, 5, kind, padding).sizes == (11, 18)
