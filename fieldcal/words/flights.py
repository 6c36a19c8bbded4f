"""What became of a flight, in sentences."""

from __future__ import annotations

from collections.abc import Sequence

from fieldcal.estimation.motion_selection import TURNED_WITHIN_S
from fieldcal.names import Decision, Status, Verdict
from fieldcal.reason_codes import ReasonCode
from fieldcal.schemas.rows import DecisionRow, Refusable, SyncRow, UnfoldedFlight, UnfoldedRun
from fieldcal.stages.tables import AXES
from fieldcal.words.numbers import number, with_sd

MOST_REASONS = 2
WANTED_DEG = 90.0
"""Of rotation about an axis, to and fro: ±45° of tilt determine a scale to half a per cent."""
QUANTITIES = {
    "attitude": "attitude",
    "quaternion_rate": "quaternion rate",
    "attitude_propagated": "integrated attitude",
    "body_rate": "body rate",
}


def verdict_sentence(flight: UnfoldedFlight) -> str:
    """What became of the log, in a line; why is told beside it."""
    head = f"{flight['log_uri']} ({flight['vehicle_id']}, flight {flight['flight_id']}): {flight['verdict']}"
    if Verdict(flight["verdict"]).usable:
        rates = f"{flight['duration_s']:.1f} s, IMU at {flight['imu_rate_hz']:.0f} Hz"
        if flight["vps_rate_hz"]:
            rates += f", VPS at {flight['vps_rate_hz']:.0f} Hz"
        if flight["temperature_mean_degc"] is not None:
            rates += f", {flight['temperature_mean_degc']:.1f} °C"
        head += f"; {rates}"
    return head


def advised(runs: Sequence[UnfoldedRun]) -> list[str]:
    """What would make weak constants better, by the stages that found them (a refused stage says it in its reason)."""
    told = (run["measured"].get("advice") for run in runs if run["status"] == Status.OK)
    return [str(advice) for advice in told if advice]


def no_result(reasons: Sequence[str], turned_deg: Sequence[float] | None) -> str:
    """Why a log gave no constant: what the stages that refused it said, each once, and the motion that was wanting."""
    own = list(dict.fromkeys(reasons)) or ["No sensor could be calibrated."]
    told = [*own[:MOST_REASONS], *(["Further reasons: view refusals."] if len(own) > MOST_REASONS else [])]
    if turned_deg is not None and min(turned_deg) < WANTED_DEG:
        short = [axis for axis, turned in zip(AXES, turned_deg, strict=True) if turned < WANTED_DEG]
        by = ", ".join(f"{turned:.0f}° about {axis}" for axis, turned in zip(AXES, turned_deg, strict=True))
        told.append(
            f"Within {TURNED_WITHIN_S:.0f} s it turned by at most {by}: turn it by {WANTED_DEG:.0f}° or more, to and"
            f" fro, about {', '.join(short)}."
        )
    return " ".join(told)


def decision_sentence(row: DecisionRow) -> str:
    """What somebody decided about a flight, and why."""
    part = " ".join(filter(None, (row["unit_id"], row["sensor"], row["parameter"], row["axis"])))
    done = {Decision.WITHDRAW: "Withdrawn", Decision.ACCEPT: "Accepted"}[Decision(row["decision"])]
    return f"{done}{f', {part}' if part else ''}: {row['reason']} ({row['author']}, {row['decided_at']:%Y-%m-%d})"


def is_consequence(run: Refusable) -> bool:
    """Whether a stage stopped only because another stage gave it nothing: `no_` and one of the tables that it needs.

    The same code is a cause where a stage finds it in the log itself: equation error's `no_gyroscope`."""
    from fieldcal.stages.pipeline import PIPELINE
    from fieldcal.stages.stage import stage_and_unit

    name, _ = stage_and_unit(run["stage"])
    code, stage = str(run["reason_code"]), next((s for s in PIPELINE if s.name == name), None)
    needs = () if stage is None else (need for need in stage.needs if not stage.reads[need].startswith("ingest."))
    wanting = code in (ReasonCode.NO_SAMPLES, ReasonCode.NO_MANOEUVRE) or code in [f"no_{need}" for need in needs]
    return bool(run["status"] == Status.REFUSED and wanting)


def sync_sentence(sync: SyncRow) -> str:
    """The clocks in a line."""
    if sync["status"] != Status.OK:
        return f"VPS clock: {sync['status']}; peak {number(sync['peak'], 3)}, next best {number(sync['runner_up'], 3)}"
    return (
        f"VPS clock: lag {sync['lag_s']:+.5f} s at the first IMU sample (VPS clock + lag = IMU clock), "
        f"{with_sd(sync['lag_mid_s'], sync['lag_sd_s'])} s at mid-flight, drift "
        f"{with_sd(sync['skew_ppm'], sync['skew_sd_ppm'])} ppm, correlation peak {number(sync['peak'], 4)}"
    )
