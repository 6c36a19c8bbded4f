"""A fleet's history with trends, made of rows: what the reports show when the table drift is there."""

from __future__ import annotations

import datetime as dt
import json
from pathlib import Path
from typing import Any

import numpy as np
from history_rows import START, rows

from fieldcal.warehouse.publish import publish

REFERENCE_DEGC = 25.0
SIGMA = {"scale": 2e-7, "zero_bias": 0.004, "bias": 0.006, "zero": 12.0}
CENTRE = {"scale": 2.2e-4, "zero_bias": 0.11, "bias": -9.5, "zero": 3.2e4}
UNITS = {"scale": "rad/s/counts", "zero_bias": "rad/s", "bias": "rad/s", "zero": "counts"}
METHODS = {"gyroscope": "output_error", "accelerometer": "ellipsoid_robust", "magnetometer": "ellipsoid_robust"}


def publish_fleet(root: Path, faults: dict[str, str], n_flights: int = 24, seed: int = 5) -> None:
    """Publish a history for every vehicle of `faults` (vehicle → stable, step, drifting, outlier or insufficient)."""
    rng = np.random.default_rng(seed)
    for number, (vehicle, fault) in enumerate(faults.items()):
        n = 2 if fault == "insufficient" else n_flights
        _publish_vehicle(root, vehicle, fault, number, n, rng)


def _publish_vehicle(root: Path, vehicle: str, fault: str, number: int, n: int, rng: np.random.Generator) -> None:
    day = 7.0 * np.arange(n)
    degc = rng.uniform(-10.0, 45.0, n)
    moments = [START + dt.timedelta(days=float(d)) for d in day]
    ids = [f"{number:04x}{i:012x}" for i in range(n)]
    lead = [
        {
            "flight_id": f,
            "vehicle_id": vehicle,
            "imu_id": f"imu-{number}",
            "session_id": f"week {i}",
            "started_at": moments[i],
        }
        for i, f in enumerate(ids)
    ]
    calibration, drift = [], []
    for sensor, method in METHODS.items():
        for parameter, sigma in SIGMA.items():
            for axis in "xyz":
                own = fault if (sensor, axis) == ("gyroscope", "y") else "stable"
                value, row = _history(own, parameter, sigma, day, degc, rng)
                for i in range(n):
                    spoiled = fault == "stable" and sensor == "magnetometer" and i == n // 2
                    calibration.append(
                        {
                            **lead[i],
                            "sensor": sensor,
                            "method": method,
                            "parameter": parameter,
                            "axis": axis,
                            "value": float(value[i] + (40 * sigma if spoiled else 0.0)),
                            "sd": sigma,
                            "unit": UNITS[parameter],
                            "temperature_degc": float(degc[i]),
                            "status": "refused" if spoiled else "ok",
                            "reason_code": "residual_too_large" if spoiled else None,
                        }
                    )
                named = {"vehicle_id": vehicle, "imu_id": f"imu-{number}", "sensor": sensor, "method": method}
                drift.append({**named, "parameter": parameter, "axis": axis, "unit": UNITS[parameter], **row})
    flights = [
        {
            **lead[i],
            "log_uri": f"{vehicle}/week {i}/{ids[i]}.mcap",
            "log_sha256": ids[i] * 4,
            "log_format": "mcap",
            "duration_s": 40.0,
            "imu_rate_hz": 185.0,
            "n_samples": 7400,
            "temperature_min_degc": float(degc[i]) - 1.0,
            "temperature_mean_degc": float(degc[i]),
            "temperature_max_degc": float(degc[i]) + 1.0,
            "verdict": "partial" if i == 1 else "ok",
            "reason_code": "lost_samples" if i == 1 else None,
            "reason": "12 samples were lost." if i == 1 else None,
            "findings": json.dumps([]),
            "verifiable": True,
        }
        for i in range(n)
    ]
    fits = [
        {
            **lead[i],
            "quantity": quantity,
            "method": how,
            "reference": reference,
            "signal": "smoothed",
            "sample": "all",
            "tic": base * float(rng.uniform(0.9, 1.1)),
            "rms": base * 200.0,
            "rms_unit": unit,
            "n_samples": 7400,
        }
        for i in range(n)
        for quantity, how, reference, base, unit in (
            ("attitude", "quest", "vps", 0.0015, "deg"),
            ("quaternion_rate", "equation_error", "quest", 0.1, "1/s"),
            ("attitude_propagated", "output_error", "quest", 0.01, "deg"),
        )
    ]
    clocks = [
        {
            **lead[i],
            "lag_s": 0.013,
            "lag_mid_s": 0.013 + 5e-4 * float(rng.standard_normal()),
            "lag_sd_s": 4e-4,
            "skew_ppm": 12.0,
            "skew_sd_ppm": 5.0,
            "peak": 0.99,
            "runner_up": 0.4,
            "status": "ok",
        }
        for i in range(n)
    ]
    runs = [
        {
            **lead[i],
            "stage": "magnetometer",
            "status": "refused",
            "reason_code": "residual_too_large",
            "measured": _measured(),
        }
        for i in range(n)
        if fault == "stable" and i == n // 2
    ]
    tables = {"flight": flights, "calibration": calibration, "fit": fits, "sync": clocks, "run": runs, "drift": drift}
    publish(root, vehicle, {name: rows(name, *own) for name, own in tables.items() if own}, ids)


def _measured() -> str:
    return json.dumps(
        {"reason": "Magnetometer: the residual is 4.1 % of the field: a magnet came near.", "residual": 0.041}
    )


def _history(
    fault: str, parameter: str, sigma: float, day: np.ndarray, degc: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, dict[str, Any]]:
    """Values of one parameter, and the drift row that least squares gives (after the step, where there is one)."""
    truth = CENTRE[parameter] * (1.3 if fault == "outlier" else 1.0) + 0.3 * sigma * (degc - REFERENCE_DEGC)
    n = len(day)
    step_at = n // 2 + 1 if fault == "step" else None
    if step_at is not None:
        truth = truth + np.where(np.arange(n) >= step_at, 10.0 * sigma, 0.0)
    if fault == "drifting":
        truth = truth + 0.08 * sigma * day
    value = truth + sigma * rng.standard_normal(n)
    row: dict[str, Any] = {"n_flights": n, "status": fault}
    if fault == "insufficient" or n < 5:
        return value, {**row, "status": "insufficient", "reason": f"{n} sessions: a trend needs 5."}
    used = np.arange(n) >= (step_at or 0)
    x = np.column_stack([np.ones(n), degc - REFERENCE_DEGC, day - day[-1]])[used]
    estimate = np.linalg.lstsq(x, value[used], rcond=None)[0]
    deviation = sigma * np.sqrt(np.diag(np.linalg.inv(x.T @ x)))
    last = float((value[used][-1] - x[-1] @ estimate) / sigma)
    names = ("value_at_25degc", "slope_per_degc", "slope_per_day")
    row |= {name: float(v) for name, v in zip(names, estimate, strict=True)}
    row |= {f"{n}_sd" if "slope" in n else "sd": float(v) for n, v in zip(names, deviation, strict=True)}
    row |= {
        "last_z": last,
        "as_of": START + dt.timedelta(days=float(day[-1])),
        "best_known_degc": float(degc[used].mean()),
    }
    row["reason"] = None if fault == "stable" else f"The reason of {fault}."
    row["change_at"] = None if step_at is None else START + dt.timedelta(days=float(day[step_at]))
    return value, row
