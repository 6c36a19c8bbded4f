"""`fieldcal demo`: a small simulated fleet, its night, and one flight beside the truth."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from datetime import UTC, date, datetime, timedelta
from pathlib import Path
from typing import Literal

from fieldcal.cli.present.constants import constant
from fieldcal.cli.present.night import print_night
from fieldcal.cli.present.progress import NightProgress
from fieldcal.cli.present.screen import Listing, console, table
from fieldcal.flows.run import run_night
from fieldcal.names import SENSORS, Status, exactness
from fieldcal.schemas.reference import ENOUGH_SESSIONS
from fieldcal.schemas.rows import CalibrationRow
from fieldcal.simulation.archive import DAYS_BETWEEN, FIRST_FLIGHT, Truth, write_flights
from fieldcal.simulation.experiment import Experiment
from fieldcal.stages.tables import AXES
from fieldcal.warehouse import Warehouse
from fieldcal.words.measures import measure
from fieldcal.words.rows import typed
from fieldcal.words.talk import say

VEHICLES, SESSIONS, FLIGHTS = 2, ENOUGH_SESSIONS, 1
WORKERS = min(2, os.cpu_count() or 1)
PARAMETERS: tuple[Literal["scale", "zero"], ...] = ("scale", "zero")
QUESTIONS = (
    "SELECT vehicle_id, sensor, axis, value_at_25degc, sd FROM latest_calibration WHERE parameter = 'scale'",
    "SELECT log_uri, quantity, method, reference, tic, rms, rms_unit FROM worst_tic LIMIT 10",
    "SELECT vehicle_id, lag_mid_s, lag_sd_s, skew_ppm FROM sync",
)


def run_demo(folder: Path, root: Path, config: Path | None) -> bool:
    """Simulate, run the night, print. Whether any log is not `ok`."""
    archive = folder / "archive"
    say(f"Simulating {VEHICLES} vehicles, {SESSIONS} sessions each, in {archive} …")
    first = first_flight(archive, datetime.now(UTC))
    logs = write_flights(archive, Experiment(), vehicles=VEHICLES, sessions=SESSIONS, flights=FLIGHTS, first=first)
    say("Running the night (its first minute goes to Prefect's server) …")
    with NightProgress() as progress:
        result = run_night(archive.absolute(), root, config, None, WORKERS, progress)
    out = console()
    print_night(out, result, root)
    uri = logs[0].relative_to(archive).as_posix()
    truth: Truth = json.loads(logs[0].with_name(logs[0].stem + ".truth.json").read_text(encoding="utf-8"))
    flight = next(log["flight_id"] for log in result["logs"] if log["log_uri"] == uri)
    stored = Warehouse(root).scan("calibration", flight_id=flight).collect()
    out.print(beside_truth(list(typed(stored.iter_rows(named=True), CalibrationRow)), truth, uri))
    out.print("Ask next:", markup=False)
    out.print(f"  fieldcal drift --warehouse {root} --vehicle sim-1", markup=False, soft_wrap=True)
    for question in QUESTIONS:
        out.print(f'  fieldcal sql --warehouse {root} "{question}"', markup=False, soft_wrap=True)
    return bool(result["ok"] != len(result["logs"]))


def first_flight(archive: Path, now: datetime) -> datetime:
    """When the fleet flies first: so that its last session was yesterday; where it flew already, as it did."""
    flown = sorted(archive.glob("*/????-??-??"))
    yesterday = now.date() - timedelta(days=1 + DAYS_BETWEEN * (SESSIONS - 1))
    day = date.fromisoformat(flown[0].name) if flown else yesterday
    return datetime.combine(day, FIRST_FLIGHT.timetz())


def beside_truth(rows: Sequence[CalibrationRow], truth: Truth, uri: str) -> Listing:
    """Scale and zero of one flight, by the method that counts, with sd, the truth, and the error in sd."""
    counting = sorted((row for row in rows if row["status"] == Status.OK), key=lambda row: -exactness(row["method"]))
    found = {(row["sensor"], row["parameter"], row["axis"]): row for row in counting}
    lines = []
    for sensor in SENSORS:
        for i, axis in enumerate(AXES):
            for parameter in PARAMETERS:
                row = found.get((sensor, parameter, axis))
                true = truth["constants"][sensor][parameter][i]
                if row is not None and row["value"] is not None:
                    value, sd, unit = row["value"], row["sd"], row["unit"]
                    name = constant(sensor, axis, parameter)
                    found_and_true = measure(value, sd, unit), measure(true, None, unit), _error(value, sd, true)
                    lines.append([name, *found_and_true])
    columns = ["constant", "found", "truth", "off by, sd"]
    return table(columns, lines, f"{uri} beside the truth of the simulation")


def _error(value: float, sd: float | None, true: float) -> str:
    return f"{(value - true) / sd:+.1f}" if sd else "–"
