"""Which places are URLs of an object store, and what such a URL may hold: no secret."""

from __future__ import annotations

from pathlib import Path
from urllib.parse import urlsplit

from fieldcal.errors import FieldcalError
from fieldcal.reason_codes import ReasonCode

SCHEMES = {"s3": "AWS_ACCESS_KEY_ID, AWS_PROFILE", "gs": "GOOGLE_APPLICATION_CREDENTIALS", "az": "AZURE_STORAGE_…"}
"""Scheme → where its credentials are looked for, besides the role of the machine."""


class RemoteError(FieldcalError):
    """An object store cannot be reached, refuses, or holds something else than was written there.

    Examples
    --------
    >>> import fieldcal
    >>> fieldcal.Warehouse("ftp://logs/fleet")
    Traceback (most recent call last):
    ...
    fieldcal.remote.url.RemoteError: ftp://logs/fleet is no place for logs or results: give a folder, or a URL ...
    """


def is_url(place: Path | str) -> bool:
    """Whether a place is named by a URL, not by a path."""
    return isinstance(place, str) and "://" in place


def checked(url: str) -> str:
    """The URL of a bucket and a prefix in it, as it is used: without a slash at its end.

    Raises
    ------
    RemoteError
        `wrong_option`: another scheme, no bucket, or something that might be a secret.
    """
    parts = urlsplit(url)
    if parts.scheme not in SCHEMES or not parts.netloc:
        known = ", ".join(f"{scheme}://…" for scheme in SCHEMES)
        told = f"{url} is no place for logs or results: give a folder, or a URL of a bucket and a prefix ({known})."
        raise RemoteError(ReasonCode.WRONG_OPTION, told)
    if "@" in parts.netloc or parts.query or parts.fragment:
        plain = f"{parts.scheme}://{parts.netloc.rpartition('@')[2]}{parts.path}"
        told = f"{plain}: a URL holds no credentials or options here; those belong in the environment or a profile."
        raise RemoteError(ReasonCode.WRONG_OPTION, told)
    return f"{parts.scheme}://{parts.netloc}{parts.path}".rstrip("/")


def below(url: str, name: str) -> str:
    """URL of something below another."""
    return f"{url}/{name}"


def above(url: str, levels: int) -> tuple[str, str]:
    """The URL so many levels up, and the way down from there.

    Raises
    ------
    RemoteError
        `wrong_option`: the URL has not so many.
    """
    whole = checked(url)
    parts = urlsplit(whole)
    names = parts.path.strip("/").split("/")
    if len(names) < levels or not all(names[-levels:]):
        told = f"{url} names no session: give the URL of ARCHIVE/<vehicle>/<session>."
        raise RemoteError(ReasonCode.NO_SESSION, told)
    down = "/".join(names[-levels:])
    return whole.removesuffix(f"/{down}"), down
