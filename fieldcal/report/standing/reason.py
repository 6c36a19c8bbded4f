"""Why a vehicle needs a look: a sentence, and what it is about, by which a night knows what it has told already."""

from __future__ import annotations

from dataclasses import dataclass

from fieldcal.names import GRAVEST_FIRST

STATUSES = tuple(str(status) for status in GRAVEST_FIRST[:3])
LIMIT, LAST_FLIGHT, LATEST_LOG, RECOVERED, EXPIRED, IDLE, FEW = (
    "limit",
    "last_flight",
    "latest_log",
    "recovered",
    "expired",
    "idle",
    "few",
)
KINDS = (*STATUSES, LIMIT, LAST_FLIGHT, LATEST_LOG, RECOVERED, EXPIRED, IDLE, FEW)
"""The gravest first."""
NO_NEWS = (LATEST_LOG, FEW)
"""Logs are told by themselves; that a vehicle is new is none."""


@dataclass(frozen=True)
class Reason:
    """One of them. `parameters`: of the axis, the one that tells first; `mark`: what makes it another of its kind, as
    the moment of a step."""

    kind: str
    sentence: str
    imu_id: str | None = None
    unit_id: str | None = None
    sensor: str | None = None
    axis: str | None = None
    parameters: tuple[str, ...] = ()
    mark: str = ""

    @property
    def place(self) -> tuple[str, str, str]:
        """Which axis of which unit."""
        return self.unit_id or "", self.sensor or "", self.axis or ""

    @property
    def key(self) -> tuple[str, ...]:
        """Equal where the same was told."""
        return self.kind, *self.place, self.mark
