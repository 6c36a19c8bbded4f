"""Flights as information, and the rows that they have alone, published as a night does."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import polars as pl
from pooled import NAMES, SCATTER, UNITS, Truth, led

from fieldcal.estimation.normal_equations import Name, NormalEquations
from fieldcal.geometry.rotation import Array
from fieldcal.names import Method, Sensor
from fieldcal.schemas.frames import empty_frame
from fieldcal.stages.joint.information import table_of as rows_of_equations
from fieldcal.stages.results import triad_rows
from fieldcal.stages.tables import calibration_rows
from fieldcal.warehouse.publish import publish


def flight(rng: np.random.Generator, at: Array, seen: int, unseen: Name | None = None) -> NormalEquations:
    """A flight that shows `seen` random combinations of the 18 constants `at`, none of which has `unseen` in it."""
    sd = np.array([SCATTER[name[:2]] for name in NAMES]) * 2.0
    look = rng.normal(size=(seen, 18)) / sd
    if unseen is not None:
        look[:, NAMES.index(unseen)] = 0.0
    reading = look @ at + rng.normal(size=seen)
    nominal = np.array([1.0 if name[1] == "gain" else 0.0 for name in NAMES])
    return NormalEquations(NAMES, nominal, look.T @ (reading - look @ nominal), look.T @ look)


def rows_alone(found: NormalEquations, degc: float) -> pl.DataFrame:
    """The rows of `calibration` that a flight has by itself."""
    value = found.reference + np.linalg.solve(found.information, found.right)
    covariance = np.linalg.inv(found.information)
    rows = []
    for sensor in (Sensor.ACCELEROMETER, Sensor.GYROSCOPE, Sensor.MAGNETOMETER):
        at = [k for k, name in enumerate(NAMES) if name[0] == sensor]
        gain, zero = value[at[:3]], value[at[3:]]
        jacobian = np.block(
            [[np.diag(-1.0 / gain**2), np.zeros((3, 3))], [np.diag(zero / gain**2), np.diag(-1.0 / gain)]]
        )
        own = jacobian @ covariance[np.ix_(at, at)] @ jacobian.T
        unit = UNITS[sensor]
        rows += triad_rows(
            sensor, Method.JOINT, np.diag(1.0 / gain), -zero / gain, own, unit=unit, logged_unit=unit,
            reference_reading=np.zeros(3), temperature_degc=degc,
        )  # fmt: skip
    return calibration_rows(rows)


def publish_unit(
    root: Path,
    vehicle: int,
    rng: np.random.Generator,
    truth: Truth,
    sessions: int,
    seen: Callable[[int], int],
    *,
    unseen: Name | None = None,
    alone: Callable[[int], bool] = lambda session: True,
    moved: Callable[[int, Array], Array] = lambda session, constants: constants,
) -> None:
    """Publish a vehicle's flights, one a session. By session: how many combinations each shows, whether it has rows
    `alone`, and where its constants have `moved`."""
    information, calibration, flights = [], [], []
    for session in range(sessions):
        degc = float(rng.uniform(10.0, 30.0))
        found = flight(rng, moved(session, truth.of_flight(session, degc)), seen(session), unseen)
        rows = rows_of_equations(found, [None] * 18, {Sensor(s): (u, u) for s, u in UNITS.items()})
        rows = rows.with_columns(temperature_degc=pl.lit(degc))
        information.append(led(rows, vehicle, session, session, truth.day[session]))
        if alone(session):
            calibration.append(led(rows_alone(found, degc), vehicle, session, session, truth.day[session]))
        lead = information[-1].row(0, named=True)
        facts = {"log_uri": lead["flight_id"], "log_format": "mcap", "verdict": "ok"}
        flights.append({name: {**lead, **facts}.get(name) for name in empty_frame("flight").columns})
    tables = {
        "flight": pl.DataFrame(flights, schema=empty_frame("flight").schema),
        "information": pl.concat(information),
        "calibration": pl.concat([empty_frame("calibration"), *calibration]),
    }
    publish(root, f"v{vehicle}", tables, [row["flight_id"] for row in flights])
