"""One calibrated flight on the terminal: the verdict, parameters ± sd, what was refused and why, the comparisons."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from rich.console import Console

from fieldcal.cli.show import table
from fieldcal.names import RESIDUAL, Status, exactness
from fieldcal.schemas.rows import CalibrationRow, FitRow, FlightDocument, UnfoldedRun
from fieldcal.stages.tables import AXES
from fieldcal.words.flights import QUANTITIES, advised, is_consequence, sync_sentence, verdict_sentence
from fieldcal.words.numbers import cell, number, with_sd
from fieldcal.words.rows import BESIDE, standing

if TYPE_CHECKING:
    from rich.table import Table

PARAMETERS = ("scale", "zero", "bias")


def print_flight(console: Console, document: FlightDocument) -> None:
    """Print what `fieldcal.calibrate` found."""
    flight = document["flight"]
    console.print(verdict_sentence(flight), markup=False)
    if flight["reason"]:
        console.print(f"  {flight['reason']}", markup=False)
    for finding in flight["findings"] or []:
        if finding["sentence"] != flight["reason"]:
            console.print(f"  {finding['sentence']}", markup=False)
    if document["calibration"]:
        console.print(parameter_table(document["calibration"]))
        if (logged := residual_table(document["calibration"])) is not None:
            console.print("The autopilot had corrected its readings; of those, as they are logged:", markup=False)
            console.print(logged)
        if (beside := beside_table(document["calibration"])) is not None:
            console.print(beside)
    print_refusals(console, document["run"])
    for sentence in advised(document["run"]):
        console.print(sentence, markup=False)
    if document["fit"]:
        console.print(fit_table(document["fit"]))
    if document["sync"] is not None:
        console.print(sync_sentence(document["sync"]), markup=False)


def parameter_table(rows: Sequence[CalibrationRow]) -> Table:
    """scale, zero and bias of every sensor and method, the most exact first, an axis a line. A refused axis says so."""
    by_place = {(r["sensor"], r["method"], r["axis"], r["parameter"]): r for r in rows}
    lines = []
    shown: tuple[str, str] | None = None
    order = list(dict.fromkeys(r["sensor"] for r in rows))
    places = dict.fromkeys((r["sensor"], r["method"]) for r in rows)
    for sensor, method in sorted(places, key=lambda place: (order.index(place[0]), exactness(place[1]))):
        for axis in AXES:
            own = [by_place.get((sensor, method, axis, parameter)) for parameter in PARAMETERS]
            first = next((row for row in own if row is not None), None)
            if first is None:
                continue
            name = (sensor, method) if shown != (sensor, method) else ("", "")
            shown = (sensor, method)
            status = standing(first["status"], first["reason_code"])
            lines.append([*name, axis, *(_value(row) for row in own), status])
    return table(["sensor", "method", "axis", *PARAMETERS, "status"], lines)


def residual_table(rows: Sequence[CalibrationRow]) -> Table | None:
    """Constants of the readings as logged, where the published ones are the raw sensor's."""
    own = [row for row in rows if row["parameter"].startswith(RESIDUAL)]
    return (
        parameter_table([{**row, "parameter": row["parameter"].removeprefix(RESIDUAL)} for row in own]) if own else None
    )


def beside_table(rows: Sequence[CalibrationRow]) -> Table | None:
    """What was found beside scale and zero, a number a line."""
    found = [row for row in rows if row["parameter"] in BESIDE]
    if not found:
        return None
    lines = [[row["sensor"], BESIDE[row["parameter"]], row["axis"], _value(row)] for row in found]
    return table(["sensor", "beside scale and zero", "axis", "value"], lines)


def _value(row: CalibrationRow | None) -> str:
    return "–" if row is None else f"{with_sd(row['value'], row['sd'])} {row['unit']}"


def print_refusals(console: Console, runs: Sequence[UnfoldedRun]) -> None:
    """Stages that refused or failed: their sentence, and the numbers behind it. What follows from them is one line."""
    stopped = [run for run in runs if run["status"] in (Status.REFUSED, Status.FAILED) and run["stage"] != "ingest"]
    follow = [run["stage"] for run in stopped if is_consequence(run)]
    told: set[str] = set()
    for run in stopped:
        reason = str(run["measured"].get("reason") or run["reason_code"])
        if run["stage"] in follow or reason in told:
            continue
        told.add(reason)
        numbers = {k: v for k, v in run["measured"].items() if k != "reason" and isinstance(v, int | float)}
        console.print(f"{run['status']} {run['stage']} ({run['reason_code']}): {reason}", markup=False)
        if numbers:
            console.print("    " + ", ".join(f"{k} = {cell(v)}" for k, v in numbers.items()), markup=False)
    if follow:
        console.print(f"not run for want of their input: {', '.join(follow)}", markup=False)


def fit_table(rows: Sequence[FitRow]) -> Table:
    """The Theil inequality coefficients, raw and smoothed side by side, with degrees and rad/s."""
    by_place = {(r["quantity"], r["method"], r["reference"], r["sample"], r["signal"]): r for r in rows}
    order = {name: i for i, name in enumerate(QUANTITIES)}
    keys = sorted(dict.fromkeys(key[:4] for key in by_place), key=lambda key: (order.get(key[0], 9), key))
    lines = []
    for key in keys:
        raw, smoothed = (by_place.get((*key, signal)) for signal in ("raw", "smoothed"))
        quantity = str(QUANTITIES.get(key[0], key[0])) + ("" if key[3] == "all" else ", held out")
        lines.append([quantity, key[1], key[2], *_fit(raw), *_fit(smoothed)])
    return table(["quantity", "method", "against", "TIC raw", "rms raw", "TIC smoothed", "rms smoothed"], lines)


def _fit(row: FitRow | None) -> tuple[str, str]:
    return ("–", "–") if row is None else (number(row["tic"], 4), f"{number(row['rms'], 3)} {row['rms_unit']}")
