"""The few things that are asked of an object store, by obstore, and its errors as sentences."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime, timedelta
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Literal, NamedTuple

from fieldcal.reason_codes import ReasonCode
from fieldcal.remote.credentials import given_by_profile
from fieldcal.remote.url import SCHEMES, RemoteError

if TYPE_CHECKING:
    from obstore import UpdateVersion
    from obstore.store import ObjectStore

MOST_RETRIES = 6
RETRY_FOR = timedelta(seconds=60)
MANY_DELETED = 500


@dataclass(frozen=True)
class Listed:
    """An object as a listing tells of it."""

    key: str
    size: int
    e_tag: str
    modified: datetime


class Tag(NamedTuple):
    """What tells one version of an object from others: S3 and Azure by `e_tag`, Google by `version`."""

    e_tag: str
    version: str | None


class Objects:
    """The objects below a URL (`url.checked`), by keys relative to it.

    Raises
    ------
    RemoteError
        By each method: `no_obstore`, `no_bucket`, `permission_denied`, `not_reached`, `store_error`.
    """

    def __init__(self, url: str) -> None:
        self.url = url
        self._store = opened(url)

    def listed(self, prefix: str = "") -> list[Listed]:
        """All objects whose key begins with the folders `prefix`."""
        import obstore

        with _told(self.url):
            found = [one for page in obstore.list(self._store, prefix or None) for one in page]
        return [Listed(one["path"], one["size"], one["e_tag"] or "", one["last_modified"]) for one in found]

    def get(self, key: str) -> tuple[bytes, Tag] | None:
        """Content and tag of an object; None where there is none."""
        import obstore

        with _told(self.url):
            try:
                found = obstore.get(self._store, key)
                return bytes(found.bytes()), Tag(found.meta["e_tag"] or "", found.meta["version"])
            except FileNotFoundError as error:
                if _is_about_bucket(error):
                    raise
                return None

    def fetch(self, key: str, path: Path) -> tuple[Listed, str] | None:
        """Stream an object into a file; what it is, and the sha256 of what came. None where there is none."""
        import obstore

        digest = hashlib.sha256()
        with _told(self.url):
            try:
                found = obstore.get(self._store, key)
            except FileNotFoundError as error:
                if _is_about_bucket(error):
                    raise
                return None
            with path.open("wb") as file:
                for piece in found.stream(min_chunk_size=4 << 20):
                    digest.update(piece)
                    file.write(piece)
            meta = found.meta
        return Listed(key, meta["size"], meta["e_tag"] or "", meta["last_modified"]), digest.hexdigest()

    def put(self, key: str, data: bytes | Path, kind: str | None = None) -> None:
        """Write an object, which is there whole or not at all; one that is there is replaced. `kind`: for browsers."""
        import obstore

        with _told(self.url):
            obstore.put(self._store, key, data, attributes={"Content-Type": kind} if kind else None)

    def swap(self, key: str, data: bytes, tag: Tag | None) -> str | None:
        """Replace an object if it is still the version `tag` (None: create it); the new one's `e_tag`, or None where
        another was faster."""
        import obstore
        from obstore.exceptions import AlreadyExistsError, PreconditionError

        mode: Literal["create"] | UpdateVersion = "create"
        if tag is not None:
            mode = {"e_tag": tag.e_tag} if tag.version is None else {"e_tag": tag.e_tag, "version": tag.version}
        with _told(self.url):
            try:
                done = obstore.put(self._store, key, data, mode=mode)
            except (AlreadyExistsError, PreconditionError):
                return None
            except FileNotFoundError as error:  # it was removed by hand
                if _is_about_bucket(error):
                    raise
                return None
        return done["e_tag"] or ""

    def copy(self, key: str, to: str) -> None:
        """Copy an object within the store, over what is there."""
        import obstore

        with _told(self.url):
            obstore.copy(self._store, key, to)

    def delete(self, keys: Sequence[str]) -> None:
        """Remove objects; those that are gone already are passed over."""
        import obstore

        for i in range(0, len(keys), MANY_DELETED):
            with _told(self.url):
                obstore.delete(self._store, list(keys[i : i + MANY_DELETED]))


@cache
def opened(url: str) -> ObjectStore:
    """The store of a URL, once in a process."""
    try:
        from obstore.store import from_url
    except ImportError as error:
        told = f'{url} needs the library obstore: pip install "fieldcal[remote]".'
        raise RemoteError(ReasonCode.NO_OBSTORE, told) from error
    retrying: dict[str, object] = {"max_retries": MOST_RETRIES, "retry_timeout": RETRY_FOR}
    with _told(url):
        store: ObjectStore = from_url(url, retry_config=retrying, **given_by_profile(url))  # type: ignore[call-overload]
    return store


@contextmanager
def _told(url: str) -> Iterator[None]:
    """Errors of the library as one sentence that names the URL and what to do."""
    from obstore.exceptions import BaseError

    try:
        yield
    except (BaseError, FileNotFoundError) as error:
        raise _explained(url, error) from error


def _explained(url: str, error: Exception) -> RemoteError:
    text = str(error)
    scheme = url.partition(":")[0]
    first_line = text.partition("\n")[0]
    if "169.254.169.254" in text or "must be specified" in text:
        told = f"{url}: no credentials are found: set {SCHEMES[scheme]}, or run where the machine has a role."
        return RemoteError(ReasonCode.PERMISSION_DENIED, told)
    if _is_about_bucket(error):
        return RemoteError(ReasonCode.NO_BUCKET, f"{url}: there is no such bucket; create it, or mend the URL.")
    if any(code in text for code in (" 401 ", " 403 ")) or type(error).__name__ in REFUSALS:
        why = text.partition("<Code>")[2].partition("</Code>")[0] or "access is denied"
        told = f"{url}: the store refuses access ({why}): check the credentials ({SCHEMES[scheme]}) and their rights."
        return RemoteError(ReasonCode.PERMISSION_DENIED, told)
    if "error sending request" in text or "HTTP error" in text:
        told = f"{url}: the store cannot be reached; check the network and the endpoint, then run it again."
        return RemoteError(ReasonCode.NOT_REACHED, told)
    return RemoteError(ReasonCode.STORE_ERROR, f"{url}: the store answers with an error ({first_line[:300]}).")


REFUSALS = ("PermissionDeniedError", "UnauthenticatedError")


def _is_about_bucket(error: Exception) -> bool:
    return any(code in str(error) for code in ("NoSuchBucket", "ContainerNotFound", "bucket does not exist"))
