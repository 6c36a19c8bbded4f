"""Small JSON records that carry their own digest, so that a changed byte is found."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from typing import Any

_SEAL = "sealed_sha256"


class BrokenSeal(ValueError):
    """The record is torn or was changed after it was written."""


def seal(record: Mapping[str, Any]) -> bytes:
    """Canonical JSON of `record` with its digest inside. Plain JSON only: no NaN, no objects of other kinds."""
    body = {key: value for key, value in record.items() if key != _SEAL}
    return _canonical({**body, _SEAL: hashlib.sha256(_canonical(body)).hexdigest()})


def unseal(data: bytes) -> dict[str, Any]:
    """The record of `seal`.

    Raises
    ------
    BrokenSeal
        A byte differs from what was written.
    """
    try:
        record = json.loads(data)
    except ValueError as error:
        raise BrokenSeal("it is not JSON") from error
    if not isinstance(record, dict) or _SEAL not in record:
        raise BrokenSeal("it has no digest of its own")
    body = {key: value for key, value in record.items() if key != _SEAL}
    if seal(body) != data:
        raise BrokenSeal("it is not what was written")
    return body


def _canonical(record: Mapping[str, Any]) -> bytes:
    return (json.dumps(record, indent=1, sort_keys=True, allow_nan=False, ensure_ascii=False) + "\n").encode()
