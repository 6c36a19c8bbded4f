"""Credentials as the ecosystem has them: the environment first, then a profile, then what the machine is."""

from __future__ import annotations

from pathlib import Path

import pytest

from fieldcal.remote.credentials import given_by_profile
from fieldcal.remote.url import RemoteError


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A user with two profiles and nothing in the environment."""
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY", "AWS_PROFILE", "AWS_REGION", "AWS_DEFAULT_REGION"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("AWS_SHARED_CREDENTIALS_FILE", str(tmp_path / "credentials"))
    monkeypatch.setenv("AWS_CONFIG_FILE", str(tmp_path / "config"))
    keys = "aws_access_key_id = {0}\naws_secret_access_key = {0}\n"
    (tmp_path / "credentials").write_text(f"[default]\n{keys.format('mine')}[fleet]\n{keys.format('fleets')}")
    (tmp_path / "config").write_text("[profile fleet]\nregion = eu-central-1\n")
    return tmp_path


def key_of(given: dict[str, object]) -> object:
    provider = given["credential_provider"]
    assert callable(provider)
    return provider()["access_key_id"]


def test_the_default_profile_is_taken_where_nothing_else_is_said(home: Path) -> None:
    assert key_of(given_by_profile("s3://logs/fleet")) == "mine"


def test_a_profile_that_is_named_is_taken_with_its_region(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AWS_PROFILE", "fleet")
    given = given_by_profile("s3://logs/fleet")
    assert (key_of(given), given["region"]) == ("fleets", "eu-central-1")


def test_the_environment_goes_first(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", "here")
    assert given_by_profile("s3://logs/fleet") == {}


def test_other_stores_and_other_machines_need_no_profile(home: Path) -> None:
    assert given_by_profile("gs://logs/fleet") == {}
    (home / "credentials").unlink()
    assert given_by_profile("s3://logs/fleet") == {}


def test_a_profile_that_is_not_there_is_one_sentence(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AWS_PROFILE", "nobody")
    with pytest.raises(RemoteError, match="s3://logs/fleet: the profile nobody gives no credentials"):
        given_by_profile("s3://logs/fleet")
