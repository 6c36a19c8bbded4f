"""How to talk to a Prefect server: past every proxy where it is on this machine, with the secret that it asks for."""

from __future__ import annotations

import os
import secrets
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from ipaddress import ip_address
from pathlib import Path
from urllib.parse import urlsplit

from fieldcal.errors import FieldcalError
from fieldcal.reason_codes import ReasonCode

ANSWER_TIMEOUT_S = 5.0
SECRET_FILE = "server.secret"
URL, SECRET = "PREFECT_API_URL", "PREFECT_API_AUTH_STRING"
USER = "fieldcal"
RANDOM_BYTES = 32
REFUSED = (401, 403)


def new_secret(home: Path) -> str:
    """A random secret, kept in a file below `home` that nobody else can read at any moment."""
    secret = f"{USER}:{secrets.token_urlsafe(RANDOM_BYTES)}"
    beside = home / f".{SECRET_FILE}.{os.getpid()}"
    beside.unlink(missing_ok=True)  # of a process that was killed; an existing file would keep its mode
    descriptor = os.open(beside, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
    with open(descriptor, "w", encoding="utf-8") as stream:
        stream.write(secret)
    beside.replace(home / SECRET_FILE)
    return secret


def kept_secret(home: Path) -> str:
    """The secret of the server that runs for `home`; empty when there is none."""
    try:
        return (home / SECRET_FILE).read_text(encoding="utf-8").strip()
    except (OSError, UnicodeDecodeError):
        return ""


def on_this_machine(url: str) -> bool:
    """Whether the address is one of the loopback, which no proxy reaches."""
    host = urlsplit(url).hostname or ""
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def environment_for(url: str, secret: str | None = None) -> dict[str, str]:
    """Environment in which Prefect, here and in processes started from here, talks to this server and to it alone.

    For a server on this machine proxies are off altogether: where one is named, HTTP clients prepare to use it, and
    fail if they cannot, though the address is excepted from it.
    """
    direct = {"NO_PROXY": "*", "no_proxy": "*"} if on_this_machine(url) else {}
    return {URL: url, **({SECRET: secret} if secret else {}), **direct}


@contextmanager
def connected(url: str, secret: str | None = None) -> Iterator[None]:
    """Within the block Prefect's clients in this process talk to the server, also if Prefect was imported before.

    Parameters
    ----------
    secret : str, optional
        Else the one in the environment.
    """
    from prefect.settings import PREFECT_API_AUTH_STRING, PREFECT_API_URL, temporary_settings

    secret = secret or os.environ.get(SECRET)
    with temporary_settings({PREFECT_API_URL: url, **({PREFECT_API_AUTH_STRING: secret} if secret else {})}):
        yield


def answers(url: str) -> bool:
    """Whether a Prefect server answers at an API address. It is asked without the secret."""
    try:
        past = [urllib.request.ProxyHandler({})] if on_this_machine(url) else []
        with urllib.request.build_opener(*past).open(f"{url}/health", timeout=ANSWER_TIMEOUT_S) as answer:
            return bool(answer.status == 200)
    except (OSError, ValueError):
        return False


def need_entry(url: str, asked_by: str) -> None:
    """Make sure that a server which answers takes the secret in the environment.

    Parameters
    ----------
    asked_by : str
        Sentence that says where the secret comes from and what to do.

    Raises
    ------
    FieldcalError
        `wrong_secret`.
    """
    from prefect.client.orchestration import get_client
    from prefect.exceptions import PrefectHTTPStatusError

    with connected(url), get_client(sync_client=True) as client:
        try:
            client.hello()
        except PrefectHTTPStatusError as error:
            if error.response.status_code not in REFUSED:
                raise
            what = "does not take the secret that it was shown" if os.environ.get(SECRET) else "asks for a secret"
            raise FieldcalError(ReasonCode.WRONG_SECRET, f"The Prefect server at {url} {what}. {asked_by}") from error


def no_answer(url: str) -> str:
    """What to say of a server of the user's own that does not answer."""
    return (
        f"No Prefect server answers at PREFECT_API_URL={url}. Start it (`prefect server start`), or unset "
        "PREFECT_API_URL to use the one that comes with fieldcal."
    )


OF_THE_USER = (
    "Set PREFECT_API_AUTH_STRING to what the server has as PREFECT_SERVER_API_AUTH_STRING, or unset PREFECT_API_URL to "
    "use the server that comes with fieldcal."
)


def of_ours(home: Path) -> str:
    """Where the secret of a server of ours comes from, for `need_entry`."""
    return (
        f"The secret in {home / SECRET_FILE} is not the one that the server started with: end the commands that use "
        "this warehouse, `fieldcal serve` too; the next one starts a server with a secret of its own."
    )
