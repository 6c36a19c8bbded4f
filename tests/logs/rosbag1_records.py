"""Records of ROS 1 bags, laid out by struct."""

from __future__ import annotations

import struct


def length(size: int) -> bytes:
    return struct.pack("<I", size)


def field(name: str, value: bytes) -> bytes:
    content = name.encode() + b"=" + value
    return length(len(content)) + content


def record(header: bytes, data: bytes, declared: int | None = None) -> bytes:
    return length(len(header)) + header + length(len(data) if declared is None else declared) + data


def message(connection: int, seconds: int, nanoseconds: int, payload: bytes) -> bytes:
    time = struct.pack("<II", seconds, nanoseconds)
    return record(field("op", b"\2") + field("conn", length(connection)) + field("time", time), payload)


def chunk(content: bytes, size: int, compression: bytes = b"none", declared: int | None = None) -> bytes:
    header = field("op", b"\5") + field("compression", compression) + field("size", length(size))
    return record(header, content, declared)
