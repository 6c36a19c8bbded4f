"""`fieldcal simulate`: the paper's experiment with known truth, as an archive of logs."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

import fieldcal
from fieldcal.cli.options import AsJson, UnusedConfig, UnusedRoot, Whole
from fieldcal.reason_codes import ReasonCode

if TYPE_CHECKING:
    from fieldcal.errors import FieldcalError

OFF = Parameter(negative="")


def simulate(
    folder: Path,
    /,
    *,
    seed: Whole = 0,
    motion: Literal["manoeuvre", "mission", "lively", "hover", "fixed_wing"] = "manoeuvre",
    log_format: Annotated[Literal["mcap", "csv", "ulog"], Parameter(name="--format")] = "mcap",
    vehicles: Whole = 1,
    sessions: Whole = 1,
    flights: Whole = 1,
    first: str | None = None,
    workers: Whole = 1,
    duration: float | None = None,
    translation_rms: float = 0.0,
    lever_arm: str = "0,0,0",
    dip_deg: float | None = None,
    temperature: str = "25,25",
    bias_per_degc: list[str] | None = None,
    scale_per_degc: list[str] | None = None,
    gyro_random_walk: float = 0.0,
    lost_share: float = 0.0,
    jitter: float = 0.0,
    magnetic_bursts: Whole = 0,
    vps_dropouts: float = 0.0,
    vps_outliers: float = 0.0,
    vps_misalignment_deg: float = 0.0,
    no_noise: Annotated[bool, OFF] = False,
    no_quantisation: Annotated[bool, OFF] = False,
    no_band_limit: Annotated[bool, OFF] = False,
    no_vps: Annotated[bool, OFF] = False,
    as_json: AsJson = False,
    warehouse: UnusedRoot = None,
    config: UnusedConfig = None,
) -> int:
    """Write simulated logs and, beside each, the truth.

    Parameters
    ----------
    folder
        Archive to write: FOLDER/<vehicle>/<session>/<flight>, with its fieldcal.toml.
    seed
        Equal seeds give equal logs.
    motion
        What is flown: the paper's manoeuvre near one place, or an ordinary flight of a multirotor or fixed wing with an
        autopilot's sensors in SI units, the velocity of a satellite receiver, and no VPS.
    log_format
        One MCAP file a flight, a folder of CSVs, or one ULog file.
    vehicles, sessions, flights
        How many vehicles, sessions of each, flights in each.
    first
        When the first flight starts, 2026-05-04 or 2026-05-04T12:00 (UTC); else 2026-01-12T08:00.
    workers
        Processes that fly; logs do not depend on it.
    duration
        Seconds; of the manoeuvre 40, of an ordinary flight 120.
    translation_rms
        Translation, rms of the acceleration vector, m/s².
    lever_arm
        x,y,z from the centre of mass to the sensor, body axes, m.
    dip_deg
        Magnetic dip, degrees; of the manoeuvre 0, the paper's horizontal field.
    temperature
        from,to in °C over a flight.
    bias_per_degc, scale_per_degc
        Temperature coefficients: gyroscope=x,y,z in rad/s (or m/s², norm) and relative to the scale.
    gyro_random_walk
        rad/s per √s.
    lost_share
        Share of samples lost.
    jitter
        Seconds, rms, of the stamps.
    magnetic_bursts
        How many times a magnet comes near.
    vps_dropouts, vps_outliers
        Share of VPS poses lost, and wrong.
    vps_misalignment_deg
        Rotation between the frames of VPS and IMU.
    no_noise, no_quantisation, no_band_limit, no_vps
        Leave it out.
    """
    from fieldcal.cli.show import print_json
    from fieldcal.words.talk import say

    own = fieldcal.Experiment() if motion == "manoeuvre" else fieldcal.ordinary_flight(motion, seed)
    duration = own.duration_s if duration is None else duration
    experiment = replace(
        own,
        seed=seed,
        duration_s=duration,
        translation_rms_mps2=translation_rms,
        lever_arm_m=_triple("--lever-arm", lever_arm),
        dip_rad=own.dip_rad if dip_deg is None else math.radians(dip_deg),
        temperature_degc=_pair("--temperature", temperature),
        bias_per_degc=_by_sensor("--bias-per-degc", bias_per_degc),
        scale_per_degc=_by_sensor("--scale-per-degc", scale_per_degc),
        gyro_random_walk=gyro_random_walk,
        lost_share=lost_share,
        jitter_s=jitter,
        magnetic_bursts=magnetic_bursts,
        vps_dropout_share=vps_dropouts,
        vps_outlier_share=vps_outliers,
        vps_misalignment_rad=math.radians(vps_misalignment_deg),
        noise=not no_noise,
        quantisation=not no_quantisation,
        band_limit=not no_band_limit,
        vps=own.vps and not no_vps,
    )
    for name, value, lowest in (
        ("--duration", duration, 5.0),
        ("--vehicles", vehicles, 1),
        ("--sessions", sessions, 1),
        ("--flights", flights, 1),
        ("--workers", workers, 1),
    ):
        if value < lowest:
            raise _wrong(f"{name} must be {lowest:g} or more.")
    for name, share in (
        ("--lost-share", lost_share),
        ("--vps-dropouts", vps_dropouts),
        ("--vps-outliers", vps_outliers),
    ):
        if not 0 <= share < 1:
            raise _wrong(f"{name} is a share: from 0 to below 1.")
    from fieldcal.warehouse.questions import moment_of

    dated = {} if first is None else {"first": moment_of("--first", first)}
    logs = fieldcal.write_flights(
        folder,
        experiment,
        vehicles=vehicles,
        sessions=sessions,
        flights=flights,
        log_format=log_format,
        workers=workers,
        **dated,
    )
    if as_json:
        print_json({"folder": str(folder), "logs": [str(log) for log in logs]})
    else:
        for log in logs:
            print(log)
        say(f"{len(logs)} logs with their truth in {folder}; next: fieldcal nightly {folder}")
    return 0


def _by_sensor(name: str, texts: list[str] | None) -> dict[str, tuple[float, float, float]]:
    from fieldcal.names import SENSORS

    result = {}
    for text in texts or []:
        sensor, _, values = text.partition("=")
        if sensor not in SENSORS:
            raise _wrong(f'{name} needs <sensor>=x,y,z with one of {", ".join(SENSORS)}, not "{text}".')
        result[sensor] = _triple(name, values)
    return result


def _triple(name: str, text: str) -> tuple[float, float, float]:
    values = _numbers(name, text, 3)
    return values[0], values[1], values[2]


def _pair(name: str, text: str) -> tuple[float, float]:
    values = _numbers(name, text, 2)
    return values[0], values[1]


def _numbers(name: str, text: str, count: int) -> list[float]:
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) != count or not all(math.isfinite(value) for value in values):
        raise _wrong(f'{name} needs {count} numbers separated by commas, not "{text}".')
    return values


def _wrong(sentence: str) -> FieldcalError:
    from fieldcal.errors import FieldcalError

    return FieldcalError(ReasonCode.WRONG_OPTION, sentence)
