"""Histories of flights whose log an autopilot wrote, made of rows: a gyroscope's constants, and what was loaded."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from history_rows import rows

from fieldcal.warehouse.publish import publish

PARAMETERS = {"CAL_GYRO0_ID": 11.0, "CAL_GYRO1_ID": 12.0, "CAL_GYRO0_XOFF": 0.02, "CAL_GYRO1_XOFF": 0.5}
NOT_TURNED = np.eye(3).tolist()


def gyroscope(first: dict[str, Any], value: float, status: str = "ok") -> list[dict[str, Any]]:
    """Scale 1.01 and a zero, ± 1 mrad/s, of one flight at 31 °C."""
    common = {
        **first,
        "sensor": "gyroscope",
        "method": "joint",
        "status": status,
        "temperature_degc": 31.0,
        "sd": 1e-3,
    }
    return [
        {**common, "parameter": parameter, "axis": axis, "unit": unit, "value": number}
        for parameter, unit, number in (("scale", "1", 1.01), ("zero", "rad/s", value))
        for axis in "xyz"
    ]


def origin(
    device_id: int | None, parameters: Mapping[str, float] = PARAMETERS, sensor: str = "gyroscope", **changes: Any
) -> dict[str, Any]:
    loaded = {"autopilot": "px4", "device_id": device_id, "rotation": NOT_TURNED, "parameters": dict(parameters)}
    return {
        "body": "frd",
        "gravity_sign": "specific_force",
        "rotation_body_from_sensor": NOT_TURNED,
        "horizontal_field_g": None,
        "horizontal_share": None,
        "loaded": {} if device_id is None else {sensor: loaded},
        **changes,
    }


def composition(first: dict[str, Any], told: dict[str, Any] | None) -> dict[str, Any]:
    measured = {} if told is None else {"origin": told}
    return {**first, "stage": "composition", "status": "ok", "measured": json.dumps(measured), "run_key": "k" * 32}


def history(root: Path, *flights: tuple[list[dict[str, Any]], list[dict[str, Any]]]) -> Path:
    for constants, runs in flights:
        tables = {
            "calibration": rows("calibration", *constants),
            "run": rows("run", *runs),
            "flight": rows("flight", {"imu_rate_hz": 187.0, **runs[0], "log_uri": "x", "verdict": "ok"}),
        }
        publish(root, "v", tables, [runs[0]["flight_id"]])
    return root
