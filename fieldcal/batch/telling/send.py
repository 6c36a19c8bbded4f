"""Messages to where `[alerts]` says, by apprise: mail, Slack, Teams, ntfy, webhooks and many more, each by a URL."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from string import Template

from fieldcal.batch.telling.message import Message
from fieldcal.errors import FieldcalError
from fieldcal.reason_codes import ReasonCode
from fieldcal.warehouse.files import write_bytes
from fieldcal.warehouse.sealed import BrokenSeal, seal, unseal
from fieldcal.words.talk import say


@dataclass(frozen=True)
class Sent:
    """What became of a message at one place: its number and kind; `problem` None where it was taken."""

    place: str
    problem: str | None


def send(message: Message, to: Sequence[str], environment: Mapping[str, str]) -> list[Sent]:
    """Send a message to every place; one that fails keeps no other from it.

    Parameters
    ----------
    to : sequence of str
        Apprise's URLs; `$NAME` and `${NAME}` stand for variables of the environment, so that a secret need not be in a
        file.
    environment : mapping

    Raises
    ------
    FieldcalError
        `no_apprise`: apprise is not installed.
    """
    try:
        import apprise
    except ImportError as error:
        told = "Alerts need the package apprise: pip install 'fieldcal[alerts]'."
        raise FieldcalError(ReasonCode.NO_APPRISE, told) from error

    logging.getLogger("apprise").setLevel(logging.CRITICAL)  # its words may hold the URL
    found: list[Sent] = []
    for number, text in enumerate(to, 1):
        entry = f"alerts.to, entry {number}"
        try:
            url = Template(text).substitute(environment)
        except (KeyError, ValueError) as error:
            missing = error.args[0] if isinstance(error, KeyError) else "a $ that no name follows"
            found.append(Sent(entry, f"{missing} is not set in the environment"))
            continue
        service = apprise.Apprise.instantiate(url, suppress_exceptions=True)
        if service is None:
            found.append(Sent(entry, "it is no URL that apprise knows"))
            continue
        place = f"{entry} ({service.service_name})"
        try:
            taken = bool(service.notify(title=message.title, body=message.body))
        except Exception as error:  # a plugin's own fault must not end a night
            found.append(Sent(place, type(error).__name__))
            continue
        found.append(Sent(place, None if taken else "it did not take the message"))
    return found


def tell_once(root: Path, message: Message, to: Sequence[str], environment: Mapping[str, str]) -> list[Sent]:
    """Send a message unless it says what the last one said; problems are talk. Nothing without a place to send to."""
    if not to:
        return []
    place = root / "night" / "told.json"
    digest = hashlib.sha256(f"{message.title}\0{message.body}".encode()).hexdigest()
    try:
        if place.exists() and unseal(place.read_bytes()).get("sha256") == digest:
            return []
    except (BrokenSeal, OSError):
        pass  # told once more at worst
    try:
        sent = send(message, to, environment)
    except FieldcalError as error:
        say(error.sentence)
        return []
    for one in sent:
        if one.problem is not None:
            say(f"Nobody was told by {one.place}: {one.problem}. fieldcal alerts test tries it again.")
    if any(one.problem is None for one in sent):
        try:
            write_bytes(place, seal({"sha256": digest}), durable=False)
        except FieldcalError as error:
            say(f"The same may be told once more. {error.sentence}")
    return sent
