"""One calibrated flight on the terminal: the verdict, parameters ± sd, what was refused and why, the comparisons."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from rich.console import Console

from flows.show import cell, number, table, with_sd

AXES = ("x", "y", "z")
PARAMETERS = ("scale", "zero", "bias")
QUANTITIES = {
    "attitude": "attitude",
    "quaternion_rate": "quaternion rate",
    "attitude_propagated": "integrated attitude",
    "body_rate": "body rate",
}
Rows = Sequence[Mapping[str, Any]]


def print_flight(console: Console, document: Mapping[str, Any]) -> None:
    """Print what `flows.calibrate.calibrate_log` found."""
    flight = document["flight"]
    console.print(verdict_sentence(flight), markup=False)
    for finding in flight["findings"]:
        if finding["sentence"] != flight["reason"]:
            console.print(f"  {finding['sentence']}", markup=False)
    if document["calibration"]:
        console.print(parameter_table(document["calibration"]))
    print_refusals(console, document["run"])
    for sentence in advised(document["run"]):
        console.print(sentence, markup=False)
    if document["fit"]:
        console.print(fit_table(document["fit"]))
    if document["sync"] is not None:
        console.print(sync_sentence(document["sync"]), markup=False)


def verdict_sentence(flight: Mapping[str, Any]) -> str:
    """What became of the log, in a line."""
    head = f"{flight['log_uri']} ({flight['vehicle_id']}, flight {flight['flight_id']}): {flight['verdict']}"
    if flight["verdict"] in ("ok", "partial"):
        rates = f"{flight['duration_s']:.1f} s, IMU at {flight['imu_rate_hz']:.0f} Hz"
        if flight["vps_rate_hz"]:
            rates += f", VPS at {flight['vps_rate_hz']:.0f} Hz"
        if flight["temperature_mean_degc"] is not None:
            rates += f", {flight['temperature_mean_degc']:.1f} °C"
        head += f"; {rates}"
    return head + (f"\n  {flight['reason']}" if flight["reason"] else "")


def parameter_table(rows: Rows) -> Any:
    """scale, zero and bias of every sensor and method, an axis a line. A refused axis says so."""
    by_place = {(r["sensor"], r["method"], r["axis"], r["parameter"]): r for r in rows}
    lines = []
    shown: tuple[str, str] | None = None
    for sensor, method in dict.fromkeys((r["sensor"], r["method"]) for r in rows):
        for axis in AXES:
            own = [by_place.get((sensor, method, axis, parameter)) for parameter in PARAMETERS]
            first = next((row for row in own if row is not None), None)
            if first is None:
                continue
            name = (sensor, method) if shown != (sensor, method) else ("", "")
            shown = (sensor, method)
            status = first["status"] if first["status"] == "ok" else f"{first['status']}: {first['reason_code']}"
            lines.append([*name, axis, *(_value(row) for row in own), status])
    return table(["sensor", "method", "axis", *PARAMETERS, "status"], lines)


def _value(row: Mapping[str, Any] | None) -> str:
    return "–" if row is None else f"{with_sd(row['value'], row['sd'])} {row['unit']}"


def print_refusals(console: Console, runs: Rows) -> None:
    """Stages that refused or failed: their sentence, and the numbers behind it. What follows from them is one line."""
    stopped = [run for run in runs if run["status"] in ("refused", "failed") and run["stage"] != "ingest"]
    follow = [run["stage"] for run in stopped if is_consequence(run)]
    told: set[str] = set()
    for run in stopped:
        reason = run["measured"].get("reason") or run["reason_code"]
        if run["stage"] in follow or reason in told:
            continue
        told.add(reason)
        numbers = {k: v for k, v in run["measured"].items() if k != "reason" and isinstance(v, int | float)}
        console.print(f"{run['status']} {run['stage']} ({run['reason_code']}): {reason}", markup=False)
        if numbers:
            console.print("    " + ", ".join(f"{k} = {cell(v)}" for k, v in numbers.items()), markup=False)
    if follow:
        console.print(f"not run for want of their input: {', '.join(follow)}", markup=False)


def advised(runs: Rows) -> list[str]:
    """What would make weak constants better, by the stages that found them (a refused stage says it in its reason)."""
    return [run["measured"]["advice"] for run in runs if run["status"] == "ok" and run["measured"].get("advice")]


def is_consequence(run: Mapping[str, Any]) -> bool:
    """Whether a stage stopped only because another stage gave it nothing: `no_` and one of the tables that it needs.

    The same code is a cause where a stage finds it in the log itself: equation error's `no_gyroscope`."""
    from fieldcal.pipeline import PIPELINE

    code, stage = str(run["reason_code"]), next((s for s in PIPELINE if s.name == run["stage"]), None)
    needs = () if stage is None else (need for need in stage.needs if not stage.reads[need].startswith("ingest."))
    wanting = code in ("no_samples", "no_manoeuvre") or code in [f"no_{need}" for need in needs]
    return bool(run["status"] == "refused" and wanting)


def fit_table(rows: Rows) -> Any:
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


def _fit(row: Mapping[str, Any] | None) -> tuple[str, str]:
    return ("–", "–") if row is None else (number(row["tic"], 4), f"{number(row['rms'], 3)} {row['rms_unit']}")


def sync_sentence(sync: Mapping[str, Any]) -> str:
    """The clocks in a line."""
    if sync["status"] != "ok":
        return f"VPS clock: {sync['status']}; peak {number(sync['peak'], 3)}, next best {number(sync['runner_up'], 3)}"
    return (
        f"VPS clock: lag {sync['lag_s']:+.5f} s at the first IMU sample (VPS clock + lag = IMU clock), "
        f"{with_sd(sync['lag_mid_s'], sync['lag_sd_s'])} s at mid-flight, drift "
        f"{with_sd(sync['skew_ppm'], sync['skew_sd_ppm'])} ppm, correlation peak {number(sync['peak'], 4)}"
    )
