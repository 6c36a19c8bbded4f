"""Credentials as the ecosystem has them. Environment and role of the machine the library knows itself; profiles of AWS
are read by AWS's own library."""

from __future__ import annotations

import os
from pathlib import Path

from fieldcal.reason_codes import ReasonCode
from fieldcal.remote.url import RemoteError

GIVEN = ("AWS_ACCESS_KEY_ID", "AWS_WEB_IDENTITY_TOKEN_FILE", "AWS_CONTAINER_CREDENTIALS_RELATIVE_URI")
"""Any of them in the environment goes before a profile that nobody names."""


def given_by_profile(url: str) -> dict[str, object]:
    """What opens the store of `url` by a profile; nothing where none is meant.

    Raises
    ------
    RemoteError
        `permission_denied`: the profile that is named cannot be used.
    """
    named = os.environ.get("AWS_PROFILE")
    if not url.startswith("s3:") or any(name in os.environ for name in GIVEN):
        return {}
    if named is None and not _default_file().is_file():
        return {}
    try:
        from boto3 import Session
        from botocore.exceptions import BotoCoreError
        from obstore.auth.boto3 import Boto3CredentialProvider
    except ImportError as error:
        if named is None:
            return {}
        told = f'{url}: the profile {named} (AWS_PROFILE) needs AWS\'s library: pip install "fieldcal[remote]".'
        raise RemoteError(ReasonCode.NO_OBSTORE, told) from error
    try:
        session = Session()
        if session.get_credentials() is None:
            return {}
        given: dict[str, object] = {"credential_provider": Boto3CredentialProvider(session)}
    except (BotoCoreError, ValueError) as error:
        profile = named or "default"
        told = f"{url}: the profile {profile} gives no credentials ({error}); set AWS_PROFILE to one that does."
        raise RemoteError(ReasonCode.PERMISSION_DENIED, told) from error
    return given | ({"region": session.region_name} if session.region_name else {})


def _default_file() -> Path:
    named = os.environ.get("AWS_SHARED_CREDENTIALS_FILE")
    return Path(named or os.path.join(os.path.expanduser("~"), ".aws", "credentials"))
