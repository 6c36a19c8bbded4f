"""What can go wrong, by who must act.

`ValueError` stays Python's own for a caller's mistake in the numerics (wrong shape, non-finite input).
Everything below carries a `reason_code` for tables and a sentence for people.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


class FieldcalError(Exception):
    """Base of every error fieldcal raises on purpose.

    Parameters
    ----------
    reason_code : str
        Short stable identifier, stored in tables (`too_little_motion`, `format_not_supported`, ...).
    sentence : str
        What happened and what to do next.
    measured : mapping, optional
        The numbers that decided it.
    """

    def __init__(self, reason_code: str, sentence: str, measured: Mapping[str, Any] | None = None) -> None:
        super().__init__(sentence)
        self.reason_code = reason_code
        self.sentence = sentence
        self.measured: dict[str, Any] = dict(measured or {})

    def __reduce__(self) -> tuple[Any, ...]:
        """Copies whole, also between processes."""
        return type(self), (self.reason_code, self.sentence, self.measured)


class ConfigurationError(FieldcalError):
    """The configuration is wrong: nothing runs until it is mended."""


class UnreadableLog(FieldcalError):
    """This log cannot be read, or holds nothing usable. Other logs are not concerned."""


class UnusableFlight(FieldcalError):
    """The recording does not determine what was asked of it (planar motion, no excitation, flat peak)."""


class EstimationError(FieldcalError):
    """Enough information, yet the estimator reached no minimum."""


class Refused(FieldcalError):
    """A value was asked for that fieldcal refused; the sentence says why."""


def unforeseen(log_uri: str, error: Exception) -> str:
    """What an unforeseen error says to people."""
    told = " ".join(str(error).split())
    what = f"{type(error).__name__}: {told[:300]}"
    return f"an error of fieldcal's own stopped it on {log_uri} ({what}). Please report it."
