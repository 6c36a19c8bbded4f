"""What an autopilot had loaded for each sensor of a log."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.linalg import polar

from fieldcal.logs.facts import LoadedFacts
from fieldcal.logs.interface import SensorSource


def loaded(sources: Sequence[SensorSource]) -> dict[str, LoadedFacts]:
    """Sensor → what its autopilot had loaded for it at the end of the log. `sources`: one a sensor."""
    return {
        str(one.sensor): {
            "autopilot": one.autopilot,
            "device_id": one.device_id,
            "rotation": _mounting(one),
            "parameters": dict(one.parameters),
        }
        for one in sources
        if one.autopilot is not None
    }


def _mounting(source: SensorSource) -> list[list[float]]:
    """How the last correction turned the readings; raw ones are in the axes of the sensor."""
    if not source.corrections:
        return np.eye(3).tolist()
    turn = polar(np.array(source.corrections[-1].matrix), side="left")[0]
    return np.asarray(turn).tolist()
