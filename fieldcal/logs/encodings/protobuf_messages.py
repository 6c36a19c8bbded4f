"""Protobuf messages, decoded one by one with the FileDescriptorSet that their schema record carries."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fieldcal.logs.encodings.decoded import (
    COMPONENTS,
    NANOSECOND_NAMES,
    NANOSECONDS,
    SECOND_NAMES,
    STAMP_FIELDS,
    Decoded,
    MissingField,
    UnsupportedSchema,
    Want,
    decode_each,
)

if TYPE_CHECKING:
    from google.protobuf.message import Message


class ProtobufDecoder:
    """Reads `wants` from messages of type `name`.

    Parameters
    ----------
    name : str
        Full name of the message type.
    descriptors : bytes
        A serialised FileDescriptorSet with it and all it depends on.
    wants : mapping
        Value name -> field.

    Raises
    ------
    UnsupportedSchema
        The descriptors do not form that type, or protobuf is not installed.
    MissingField
        The type has no such field.
    """

    def __init__(self, name: str, descriptors: bytes, wants: Mapping[str, Want]) -> None:
        self._message_class, parse_error = _message_class(name, descriptors)
        self._parse_error = parse_error
        self._wants = dict(wants)
        self._stamp = self._stamp_path()
        self._paths = {value: self._resolved(want) for value, want in self._wants.items()}

    def decode(self, data: NDArray[np.uint8], starts: NDArray[np.int64], sizes: NDArray[np.int64]) -> Decoded:
        """See `Decoder.decode`."""
        return decode_each(self._read, self._wants, data, starts, sizes)

    def _read(self, payload: bytes) -> tuple[int | None, list[list[float]]]:
        message = self._message_class()
        try:
            message.ParseFromString(payload)
        except self._parse_error as error:
            raise ValueError(str(error)) from error
        stamp = None
        if self._stamp is not None:
            seconds, nanoseconds = (_value(message, path) for path in self._stamp)
            stamp = int(seconds) * NANOSECONDS + int(nanoseconds)
        rows = []
        for name, paths in self._paths.items():
            values = [_value(message, path) for path in paths]
            row = values if len(paths) > 1 or self._wants[name].width == 1 else list(values[0])
            if len(row) != self._wants[name].width:
                raise ValueError(f"{name} has {len(row)} numbers")
            rows.append(row)
        return stamp, rows

    def _stamp_path(self) -> tuple[str, str] | None:
        for stamp in STAMP_FIELDS:
            for second in SECOND_NAMES:
                for nanosecond in NANOSECOND_NAMES:
                    if self._has(f"{stamp}.{second}") and self._has(f"{stamp}.{nanosecond}"):
                        return f"{stamp}.{second}", f"{stamp}.{nanosecond}"
        return None

    def _resolved(self, want: Want) -> tuple[str, ...]:
        paths = want.paths
        if len(paths) == 1 and want.width > 1:
            parts = tuple(f"{paths[0]}.{component}" for component in COMPONENTS[want.width])
            paths = parts if any(self._has(part) for part in parts) else paths
        for path in paths:
            if not self._has(path):
                raise MissingField(path, [field.name for field in self._message_class.DESCRIPTOR.fields])
        return paths

    def _has(self, path: str) -> bool:
        descriptor = self._message_class.DESCRIPTOR
        for name in path.split("."):
            field = None if descriptor is None else descriptor.fields_by_name.get(name)
            if field is None:
                return False
            descriptor = field.message_type
        return True


# Any: protobuf makes its classes at run time, so that no type knows their fields; `decode_each` makes numbers of what
# they hold.
def _value(message: Message, path: str) -> Any:
    """The value at a dotted path. Raises ValueError where a message on the way is not set."""
    *parents, last = path.split(".")
    for name in parents:
        if not message.HasField(name):
            raise ValueError(f"{name} is not set")
        message = getattr(message, name)
    return getattr(message, last)


def _message_class(name: str, descriptors: bytes) -> tuple[type[Message], type[Exception]]:
    try:
        from google.protobuf import descriptor_pb2, descriptor_pool, message, message_factory
    except ImportError as error:
        raise UnsupportedSchema(f"{name}: reading protobuf messages needs the package protobuf") from error
    try:
        files = descriptor_pb2.FileDescriptorSet.FromString(descriptors)
        pool = descriptor_pool.DescriptorPool()
        waiting = {file.name: file for file in files.file}
        while waiting:
            ready = [file for file in waiting.values() if not any(needed in waiting for needed in file.dependency)]
            if not ready:
                raise UnsupportedSchema(f"{name}: its descriptors depend on each other in a circle")
            for file in ready:
                pool.Add(waiting.pop(file.name))
        return message_factory.GetMessageClass(pool.FindMessageTypeByName(name)), message.DecodeError
    except (message.DecodeError, KeyError, TypeError, ValueError) as error:
        raise UnsupportedSchema(f"{name}: its protobuf descriptors cannot be used ({error})") from error
