"""One calibrated flight on the terminal: the verdict, parameters ± sd, what was refused and why, the comparisons."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from rich.console import Console

from fieldcal.cli.present.constants import constant, counting
from fieldcal.cli.present.screen import Listing, table
from fieldcal.names import RESIDUAL, Status, exactness
from fieldcal.report.words import plain_name
from fieldcal.schemas.rows import CalibrationRow, FitRow, FlightDocument, UnfoldedRun
from fieldcal.stages.tables import AXES
from fieldcal.words.flights import QUANTITIES, advised, is_consequence, sync_sentence, verdict_sentence
from fieldcal.words.measures import measure, share, with_unit, written
from fieldcal.words.numbers import cell, number
from fieldcal.words.rows import BESIDE, standing

PARAMETERS = ("scale", "zero", "bias")
Nominal = Mapping[str, Sequence[float]]
NONE: Nominal = {}


def print_flight(console: Console, document: FlightDocument, nominal: Nominal = NONE, *, wide: bool = False) -> None:
    """Print what `fieldcal.calibrate` found. `nominal`: scales of data sheets, by sensor."""
    flight = document["flight"]
    console.print(verdict_sentence(flight), markup=False)
    if flight["reason"]:
        console.print(f"  {flight['reason']}", markup=False)
    for finding in flight["findings"] or []:
        if finding["sentence"] != flight["reason"]:
            console.print(f"  {finding['sentence']}", markup=False)
    rows = document["calibration"]
    if rows:
        if (constants := parameter_table(rows, nominal, wide=wide)).rows:
            console.print(constants)
        for code, names in _refused(rows).items():
            console.print(f"refused: {', '.join(names)} ({code})", markup=False)
        if (logged := residual_table(rows, wide=wide)) is not None:
            console.print("The autopilot had corrected its readings; of those, as they are logged:", markup=False)
            console.print(logged)
        if (beside := beside_table(rows)) is not None:
            console.print(beside)
        if not wide and (others := sorted({row["method"] for row in rows} - {row["method"] for row in counting(rows)})):
            console.print(f"Estimated besides by {', '.join(map(plain_name, others))} (--wide).", markup=False)
    print_refusals(console, document["run"], wide=wide)
    for sentence in advised(document["run"]):
        console.print(sentence, markup=False)
    if document["fit"]:
        console.print(fit_table(document["fit"], wide=wide))
    if document["sync"] is not None:
        console.print(sync_sentence(document["sync"]), markup=False)


def parameter_table(rows: Sequence[CalibrationRow], nominal: Nominal = NONE, *, wide: bool = False) -> Listing:
    """scale and zero of every sensor, an axis a line, by the method that counts. A refused axis says so. Wide: by every
    method, the most exact first, and with the bias."""
    shown = rows if wide else counting(rows)
    parameters = PARAMETERS if wide else PARAMETERS[:2]
    by_place = {(r["sensor"], r["method"], r["axis"], r["parameter"]): r for r in shown}
    lines = []
    order = list(dict.fromkeys(r["sensor"] for r in shown))
    places = dict.fromkeys((r["sensor"], r["method"]) for r in shown)
    for sensor, method in sorted(places, key=lambda place: (order.index(place[0]), exactness(place[1]))):
        for i, axis in enumerate(AXES):
            own = [by_place.get((sensor, method, axis, parameter)) for parameter in parameters]
            first = next((row for row in own if row is not None), None)
            if first is None:
                continue
            values = [_value(row) for row in own]
            values.insert(1, _off(own[0], nominal.get(sensor), i))
            if wide:
                lines.append([sensor, method, axis, *values, standing(first["status"], first["reason_code"])])
            else:
                lines.append([constant(sensor, axis, ""), *values, first["status"]])
    if wide:
        columns = ["sensor", "method", "axis", "scale", "off nominal", *parameters[1:], "status"]
        return table(columns, lines, drop_silent=True)
    columns = ["sensor", "scale", "off nominal", "zero", "status"]
    if all(line[-1] == Status.OK for line in lines):
        columns, lines = columns[:-1], [line[:-1] for line in lines]
    return table(columns, lines, drop_silent=True)


def residual_table(rows: Sequence[CalibrationRow], *, wide: bool = False) -> Listing | None:
    """Constants of the readings as logged, where the published ones are the raw sensor's."""
    own = [row for row in rows if row["parameter"].startswith(RESIDUAL)]
    bare: list[CalibrationRow] = [{**row, "parameter": row["parameter"].removeprefix(RESIDUAL)} for row in own]
    listed = parameter_table(bare, wide=wide)
    return listed if listed.rows else None


def beside_table(rows: Sequence[CalibrationRow]) -> Listing | None:
    """What was found beside scale and zero, a number a line."""
    found = [row for row in rows if row["parameter"] in BESIDE]
    if not found:
        return None
    lines = [[row["sensor"], BESIDE[row["parameter"]], row["axis"], _value(row)] for row in found]
    return table(["sensor", "beside scale and zero", "axis", "value"], lines)


def _refused(rows: Sequence[CalibrationRow]) -> dict[str, list[str]]:
    """Scales that were refused, by the code of why."""
    found: dict[str, list[str]] = {}
    for row in counting(rows):
        if row["status"] != Status.OK and row["parameter"] == "scale" and row["axis"] in AXES:
            found.setdefault(str(row["reason_code"]), []).append(constant(row["sensor"], row["axis"], ""))
    return found


def _off(scale: CalibrationRow | None, nominal: Sequence[float] | None, axis: int) -> str:
    """By how much a scale is not its data sheet's."""
    if scale is None or scale["value"] is None or nominal is None:
        return "–"
    return share(abs(scale["value"]) - nominal[axis], scale["sd"], nominal[axis])


def _value(row: CalibrationRow | None) -> str:
    return "–" if row is None else measure(row["value"], row["sd"], row["unit"])


def print_refusals(console: Console, runs: Sequence[UnfoldedRun], *, wide: bool = False) -> None:
    """Stages that refused or failed: their sentence, wide with the numbers behind it; what follows from them in a
    line."""
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
        if numbers and wide:
            console.print("    " + ", ".join(f"{k} = {cell(v)}" for k, v in numbers.items()), markup=False)
    if follow:
        console.print(f"not run for want of their input: {', '.join(follow)}", markup=False)


def fit_table(rows: Sequence[FitRow], *, wide: bool = False) -> Listing:
    """The Theil inequality coefficients, raw and smoothed side by side, with degrees and rad/s."""
    by_place = {(r["quantity"], r["method"], r["reference"], r["sample"], r["signal"]): r for r in rows}
    order = {name: i for i, name in enumerate(QUANTITIES)}
    keys = sorted(dict.fromkeys(key[:4] for key in by_place), key=lambda key: (order.get(key[0], 9), key))
    lines = []
    for key in keys:
        raw, smoothed = (by_place.get((*key, signal)) for signal in ("raw", "smoothed"))
        quantity = _quantity(key[0], key[3])
        if wide:
            lines.append([quantity, key[1], key[2], *_fit(raw), *_fit(smoothed)])
        else:
            row = smoothed or raw
            lines.append(["" if row is None else agreement(row), *_fit(row)])
    if wide:
        return table(["quantity", "method", "against", "TIC raw", "rms raw", "TIC smoothed", "rms smoothed"], lines)
    return table(["agreement of smoothed readings", "TIC", "rms"], lines)


def _fit(row: FitRow | None) -> tuple[str, str]:
    return ("–", "–") if row is None else tic_and_rms(row["tic"], row["rms"], row["rms_unit"])


def tic_and_rms(tic: float | None, rms: float | None, unit: str) -> tuple[str, str]:
    """How poor an agreement is."""
    factor, name = written(unit)
    return number(tic, 3), "–" if rms is None else with_unit(number(rms * factor, 3), name)


def agreement(row: Mapping[str, Any]) -> str:
    """What is compared with what: a row of `fit`."""
    quantity = _quantity(row["quantity"], row.get("sample", "all"))
    return f"{quantity}: {plain_name(row['method'])} against {plain_name(row['reference'])}"


def _quantity(name: str, sample: str) -> str:
    return QUANTITIES.get(name, name) + ("" if sample == "all" else ", held out")
