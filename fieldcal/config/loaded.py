"""What an autopilot had loaded for a sensor during a flight, as its log tells."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from fieldcal.names import Rotation

Autopilot = Literal["px4", "ardupilot"]


@dataclass(frozen=True)
class Loaded:
    """Parameters of a sensor's slot, and how the sensor is mounted.

    `device_id`: of the sensor, by which the autopilot finds its slot; None where the log does not tell. `rotation`:
    rows of the matrix that turns the axes of the sensor into those of the logged readings. `parameters`: those that
    concern the sensor, as they stood at the end of the log.
    """

    autopilot: Autopilot
    device_id: int | None
    rotation: Rotation
    parameters: Mapping[str, float]
