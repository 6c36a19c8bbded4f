"""What is known of a log once it is read: plain JSON, as it is kept beside the log's signals."""

from __future__ import annotations

from typing import TypedDict

from fieldcal.logs.applied import Applied


class FindingFacts(TypedDict):
    """One thing worth knowing about a log. `code` is a `ReasonCode`."""

    code: str
    count: int
    sentence: str


class Declared(TypedDict):
    """What the log says of itself: unit by sensor, axes of world and body, what the accelerometer reads at rest, and
    whether every sample was under a checksum that held. None: it does not say."""

    units: dict[str, str]
    world: str | None
    body: str | None
    gravity_sign: str | None
    verifiable: bool


class Judged(TypedDict):
    """What the log is good for: a `Verdict`, and where that is not "ok" the gravest finding's code and sentence."""

    verdict: str
    reason_code: str | None
    reason: str | None
    findings: list[FindingFacts]


class Facts(Declared, Judged):
    """All of it. `rows` by signal table; `applied` by sensor; `position` mean latitude and longitude, degrees, and
    altitude, m."""

    duration_s: float | None
    imu_rate_hz: float | None
    vps_rate_hz: float | None
    n_samples: int | None
    rows: dict[str, int]
    temperature_min_degc: float | None
    temperature_mean_degc: float | None
    temperature_max_degc: float | None
    started_at_ns: int | None
    position: list[float] | None
    applied: dict[str, Applied]
