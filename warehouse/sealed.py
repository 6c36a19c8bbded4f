"""Small records that carry their own digest, so that a changed byte is found."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping

from fieldcal.names import Json

_SEAL = "sealed_sha256"
_END = b"\n}\n"
_DIGEST_BYTES = 32


class BrokenSeal(ValueError):
    """The record is torn or was changed after it was written."""


def seal(record: Mapping[str, object]) -> bytes:
    """JSON of `record`, keys sorted, its digest in the last line.

    Raises
    ------
    TypeError, ValueError
        It is not plain JSON: an object (the types do not tell, since they know no typed dictionary as JSON), or NaN.
    """
    body = {key: value for key, value in record.items() if key != _SEAL}
    if not body:
        raise ValueError("an empty record has nothing to seal")
    inner = json.dumps(body, sort_keys=True, allow_nan=False, ensure_ascii=False, separators=(",", ":"))[1:-1]
    text = f"{{\n{inner}".encode() + _END
    return text.removesuffix(_END) + _last_line(text)


def unseal(data: bytes) -> dict[str, Json]:
    """The record of `seal`.

    Raises
    ------
    BrokenSeal
        A byte differs from what was written.
    """
    head, comma, _ = data.rpartition(b",\n")
    if (not comma or head + _last_line(head + _END) != data) and not _formerly_sealed(data):
        raise BrokenSeal("it is not what was written")
    try:
        record: dict[str, Json] = json.loads(data)
    except ValueError as error:
        raise BrokenSeal("it is not JSON") from error
    del record[_SEAL]
    return record


def seal_bytes(data: bytes) -> bytes:
    """Content of any kind behind its digest."""
    return hashlib.sha256(data).digest() + data


def unseal_bytes(data: bytes) -> bytes:
    """The content of `seal_bytes`.

    Raises
    ------
    BrokenSeal
        A byte differs from what was written.
    """
    digest, content = data[:_DIGEST_BYTES], data[_DIGEST_BYTES:]
    if hashlib.sha256(content).digest() != digest:
        raise BrokenSeal("it is not what was written")
    return content


def _formerly_sealed(data: bytes) -> bool:
    """Whether it is as the first nights wrote it: the digest among the other keys, in their order."""
    try:
        record = json.loads(data)
        digest = record.pop(_SEAL)
        return hashlib.sha256(_text(record)).hexdigest() == digest and _text({**record, _SEAL: digest}) == data
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):  # whatever a torn file may hold
        return False


def _text(record: Mapping[str, object]) -> bytes:
    return (json.dumps(record, indent=1, sort_keys=True, allow_nan=False, ensure_ascii=False) + "\n").encode()


def _last_line(text: bytes) -> bytes:
    """What follows the body of a record whose JSON is `text`."""
    return f',\n "{_SEAL}": "{hashlib.sha256(text).hexdigest()}"'.encode() + _END
