"""What is known of a log once it is read: plain JSON, as it is kept beside the log's signals."""

from __future__ import annotations

from typing import TypedDict

from fieldcal.config.loaded import Autopilot
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


class LoadedFacts(TypedDict):
    """`config.loaded.Loaded` as plain JSON."""

    autopilot: Autopilot
    device_id: int | None
    rotation: list[list[float]]
    parameters: dict[str, float]


class UnitFacts(TypedDict):
    """One unit on board. `table`: of its readings, "imu" of the primary one, which has the primary magnetometer as
    well, "imu.1", "magnetometer.1", … of a further one. `devices`: what tells each of its sensors from others on board
    (`SensorSource.unit_id`); empty where the log does not tell. `applied`: what an autopilot had done to the readings
    of each sensor that enters the unit's estimate, the primary magnetometer's too. `loaded`: what an autopilot had
    loaded for them; sensors of other logs are absent."""

    table: str
    devices: dict[str, str]
    applied: dict[str, Applied]
    loaded: dict[str, LoadedFacts]


class Facts(Declared, Judged):
    """All of it. `rows` by signal table; `left_out` tables that no stage may read; `position` mean latitude and
    longitude, degrees, and altitude, m; `board_id` the autopilot's serial number; `units_on_board` the primary one
    first."""

    duration_s: float | None
    imu_rate_hz: float | None
    vps_rate_hz: float | None
    n_samples: int | None
    rows: dict[str, int]
    left_out: list[str]
    temperature_min_degc: float | None
    temperature_mean_degc: float | None
    temperature_max_degc: float | None
    started_at_ns: int | None
    position: list[float] | None
    board_id: str | None
    units_on_board: list[UnitFacts]
