"""Simulated flights as an archive of logs: `<vehicle>/<session>/<flight>` with a fieldcal.toml, and the truth beside
each log."""

from __future__ import annotations

import json
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from multiprocessing import get_context
from pathlib import Path
from typing import TypedDict

import numpy as np
import polars as pl

from fieldcal.config.configuration import parse
from fieldcal.config.flight_settings import FlightSettings, flight_settings
from fieldcal.errors import FieldcalError
from fieldcal.logs.interface import SIGNAL_COLUMNS
from fieldcal.logs.mcap.write import pose_channel, raw_imu_channel, velocity_channel, write_mcap
from fieldcal.logs.ulog.write import Rows, write_ulog
from fieldcal.names import SENSORS, Sensor
from fieldcal.reason_codes import ReasonCode
from fieldcal.simulation.experiment import Experiment, SimulatedFlight, constants_at, simulate
from fieldcal.simulation.ordinary import ordinary_flight
from fieldcal.stages.tables import AXES, QUATERNION, columns_of, triad

DAYS_BETWEEN = 7
"""Sessions of a vehicle."""
FIRST_FLIGHT = datetime(2026, 1, 12, 8, 0, tzinfo=UTC)
LATENCY_NS = {"imu": 400_000, "vps": 4_800_000, "gnss": 9_000_000}


def write_flights(
    folder: Path | str,
    experiment: Experiment | None = None,
    *,
    vehicles: int = 1,
    sessions: int = 1,
    flights: int = 1,
    log_format: str = "mcap",
    first: datetime = FIRST_FLIGHT,
    workers: int = 1,
) -> list[Path]:
    """Write an archive of simulated flights and return the logs, sorted.

    Vehicle 1 carries Tables 2–4's constants, the others are varied by a few per cent and a few hundred counts. Every
    flight has its own seed (from `experiment.seed`), sessions are a week apart. Beside each log stand
    `<flight>.truth.json` (constants at the flight's mean temperature, lag, rotations) and `<flight>.truth.parquet`
    (attitude and rates as the sensors saw them).

    Parameters
    ----------
    folder : Path or str
        The archive's folder; it is made.
    experiment : Experiment, optional
        What is flown; default: the paper's.
    vehicles, sessions, flights : int
        How many vehicles, sessions of each, flights in each.
    log_format : {"mcap", "csv", "ulog"}
        One MCAP file, a folder with imu.csv and vps.csv, or one ULog file with PX4's raw topics.
    first : datetime
        When the first flight starts, with a time zone; default: 2026-01-12, 08:00 UTC.
    workers : int
        Processes that fly; logs do not depend on it. More than one needs a script that may be imported
        (`if __name__ == "__main__"`).

    Raises
    ------
    FieldcalError
        `wrong_option`: the folder has another configuration, which is never overwritten.

    Examples
    --------
    >>> import tempfile
    >>> import fieldcal
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     logs = fieldcal.write_flights(folder, fieldcal.Experiment(duration_s=10.0), flights=2)
    >>> [log.name for log in logs]
    ['flight-01.mcap', 'flight-02.mcap']
    """
    if log_format not in ("mcap", "csv", "ulog"):
        raise ValueError(f'log_format is "mcap", "csv" or "ulog", not {log_format!r}')
    base, folder = experiment or Experiment(), Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    flown = {f"sim-{v + 1}": base if v == 0 else _varied(base, v) for v in range(vehicles)}
    configuration = folder / "fieldcal.toml"
    text = "\n\n".join(_vehicle_table(vehicle_id, own) for vehicle_id, own in flown.items()) + "\n"
    if configuration.exists() and configuration.read_text(encoding="utf-8") != text:
        told = f"{configuration} is another configuration than these flights need, and stays: give another folder."
        raise FieldcalError(ReasonCode.WRONG_OPTION, told)
    planned = []
    for v, (vehicle_id, own) in enumerate(flown.items()):
        for k in range(sessions):
            day = first + timedelta(days=DAYS_BETWEEN * k)
            session = folder / vehicle_id / f"{day:%Y-%m-%d}"
            session.mkdir(parents=True, exist_ok=True)
            for i in range(flights):
                seed = int(np.random.SeedSequence([base.seed, v, k, i]).generate_state(1)[0])
                seed = base.seed if v == k == i == 0 else seed
                start = day + timedelta(minutes=20 * i)
                planned.append((session, f"flight-{i + 1:02d}", replace(own, seed=seed), start, log_format))
    if workers > 1 and len(planned) > 1:
        with ProcessPoolExecutor(min(workers, len(planned)), mp_context=get_context("spawn")) as pool:
            logs = list(pool.map(_flown, planned, chunksize=max(1, min(8, len(planned) // (2 * workers)))))
    else:
        logs = [_flown(one) for one in planned]
    if not configuration.exists():
        configuration.write_text(text, encoding="utf-8")
    return sorted(logs)


def _flown(planned: tuple[Path, str, Experiment, datetime, str]) -> Path:
    """Fly and write one flight; the log."""
    session, name, experiment, start, log_format = planned
    return write_flight(session, name, simulate(experiment), start, log_format=log_format)


def _varied(e: Experiment, vehicle: int) -> Experiment:
    """Another unit of the same type: scales ±3 %, zeros ±300 counts; of one that logs units, as `ordinary` draws it."""
    if e.logged == "si":
        other = ordinary_flight(e.motion, int(np.random.SeedSequence([e.seed, 77, vehicle]).generate_state(1)[0]))
        own = {"scale": other.scale, "bias": other.bias, "gnss_lag_s": other.gnss_lag_s, "gnss_arm_m": other.gnss_arm_m}
        return replace(e, **own)  # type: ignore[arg-type]
    rng = np.random.default_rng([e.seed, 77, vehicle])
    scale: dict[str, tuple[float, float, float]] = {}
    bias: dict[str, tuple[float, float, float]] = {}
    for name in SENSORS:
        old_scale, old_bias = np.array(e.scale[name]), np.array(e.bias[name])
        zero = -old_bias / old_scale + rng.uniform(-300, 300, 3)
        new = old_scale * (1 + rng.uniform(-0.03, 0.03, 3))
        scale[name] = (float(new[0]), float(new[1]), float(new[2]))
        offset = -new * zero
        bias[name] = (float(offset[0]), float(offset[1]), float(offset[2]))
    return replace(e, scale=scale, bias=bias)


def _units(e: Experiment) -> dict[str, str]:
    """Of the logged readings."""
    si = ("norm", "m/s^2", "rad/s")
    return dict(zip(map(str, SENSORS), si if e.logged == "si" else ("counts",) * 3, strict=True))


def _vehicle_table(vehicle_id: str, e: Experiment) -> str:
    """What the night must be told of a simulated vehicle: everything that no log can say."""
    polarity = {name: [int(np.sign(v)) for v in e.scale[name]] for name in SENSORS}
    field = [float(np.cos(e.dip_rad)), 0.0, float(np.sin(e.dip_rad))]
    lines = [
        f'[vehicles."{vehicle_id}"]',
        'world = "ned"',
        'body = "frd"',
        'gravity_sign = "gravity"',
        f"gravity_mps2 = {e.gravity_mps2!r}",
        f'field = {{ north_east_down = {field!r}, unit = "norm" }}',
        "polarity = { " + ", ".join(f"{k} = {v!r}" for k, v in polarity.items()) + " }",
        "units = { " + ", ".join(f'{name} = "{unit}"' for name, unit in _units(e).items()) + " }",
    ]
    if any(e.lever_arm_m):
        lines.append(f"lever_arm_m = {list(e.lever_arm_m)!r}")
    return "\n".join(lines)


def write_flight(folder: Path, name: str, r: SimulatedFlight, start: datetime, *, log_format: str = "mcap") -> Path:
    """Write one recording and its truth; returns the log (a file, or a folder of CSVs)."""
    start_ns = int(start.timestamp()) * 1_000_000_000
    t_ns = start_ns + np.rint(r.t * 1e9).astype(np.int64)
    vps_ns = start_ns + np.rint(r.vps_t * 1e9).astype(np.int64)
    if log_format == "mcap":
        log = folder / f"{name}.mcap"
        _write_mcap(log, r, t_ns, vps_ns, start_ns)
    elif log_format == "ulog":
        log = folder / f"{name}.ulg"
        _write_ulog(log, r, start_ns)
    else:
        log = folder / name
        log.mkdir(exist_ok=True)
        _write_csv(log, r)
    (folder / f"{name}.truth.json").write_text(json.dumps(truth(r), indent=1) + "\n", encoding="utf-8")
    pl.DataFrame(
        {
            "t_ns": np.rint(r.t * 1e9).astype(np.int64) if log_format == "csv" else t_ns,
            **columns_of(r.q, QUATERNION),
            **columns_of(r.rate, [f"rate_{a}_radps" for a in AXES]),
        }
    ).write_parquet(folder / f"{name}.truth.parquet")
    return log


def signals(r: SimulatedFlight) -> dict[str, pl.DataFrame]:
    """The recording as signal tables, as if its log had been read; stamps from 0."""
    t_ns = np.rint(r.t * 1e9).astype(np.int64)
    imu = np.hstack([r.counts[Sensor.GYROSCOPE], r.counts[Sensor.ACCELEROMETER]])
    out = {
        "imu": pl.DataFrame({"t_ns": t_ns, **columns_of(imu, triad("gyroscope") + triad("accelerometer"))}),
        "magnetometer": pl.DataFrame(
            {"t_ns": t_ns, **columns_of(r.counts[Sensor.MAGNETOMETER], triad("magnetometer"))}
        ),
        "temperature": pl.DataFrame({"t_ns": t_ns, "temperature_degc": r.temperature}),
    }
    if r.current_a is not None:
        nothing = pl.lit(None, pl.Float64).alias("throttle")
        out["power"] = pl.DataFrame({"t_ns": t_ns, "current_a": r.current_a}).with_columns(nothing)
    if len(r.gnss_t):
        velocity = np.column_stack([r.gnss_velocity, r.gnss_sd])
        gnss_ns = np.rint(r.gnss_t * 1e9).astype(np.int64)
        names = SIGNAL_COLUMNS["gnss_velocity"][1:]
        out["gnss_velocity"] = pl.DataFrame({"t_ns": gnss_ns, **columns_of(velocity, names)})
    if len(r.vps_t):
        pose = np.hstack([r.vps_q, r.vps_position])
        vps_ns = np.rint(r.vps_t * 1e9).astype(np.int64)
        out["vps"] = pl.DataFrame({"t_ns": vps_ns, **columns_of(pose, (*QUATERNION, "px_m", "py_m", "pz_m"))})
    return out


def settings(e: Experiment, vehicle_id: str = "sim-1", **changes: object) -> FlightSettings:
    """Flight settings of a simulated vehicle, as its fieldcal.toml gives them, but for method serial, whose stages are
    what most look at; `changes` replace parameters."""
    vehicle = parse(_vehicle_table(vehicle_id, e), None).vehicle(vehicle_id)
    own = flight_settings(vehicle, units=_units(e))
    return own.changed(**{"method": "serial", **changes})


def _write_mcap(path: Path, r: SimulatedFlight, t_ns: np.ndarray, vps_ns: np.ndarray, start_ns: int) -> None:
    """Raw counts and VPS poses as ROS 2 messages; log times are the recorder's, stamps each device's own."""
    whole = r.experiment.quantisation and r.experiment.logged == "counts"
    counts = {k: v.astype(np.uint16) if whole else v for k, v in r.counts.items()}
    channels = [
        raw_imu_channel(
            t_ns,
            t_ns + LATENCY_NS["imu"],
            counts[Sensor.GYROSCOPE],
            counts[Sensor.ACCELEROMETER],
            counts[Sensor.MAGNETOMETER],
            r.temperature,
        )
    ]
    if len(r.vps_t):
        e = r.experiment
        seen = (r.vps_t - e.vps_offset_s) / (1 + 1e-6 * e.vps_skew_ppm)
        seen_ns = start_ns + np.rint(seen * 1e9).astype(np.int64) + LATENCY_NS["vps"]
        channels.append(pose_channel(vps_ns, seen_ns, r.vps_q, r.vps_position))
    if len(r.gnss_t):
        gnss_ns = start_ns + np.rint(r.gnss_t * 1e9).astype(np.int64)
        channels.append(velocity_channel(gnss_ns, gnss_ns + LATENCY_NS["gnss"], r.gnss_velocity, r.gnss_sd))
    units = {f"unit_{name}": unit for name, unit in _units(r.experiment).items()}
    write_mcap(path, channels, metadata={**units, "world": "ned", "body": "frd", "gravity_sign": "gravity"})


def _write_ulog(path: Path, r: SimulatedFlight, start_ns: int) -> None:
    """Raw counts in the topics of PX4's drivers, and VPS poses as motion capture; the clock starts at the boot."""
    t_us = np.rint(r.t * 1e6).astype(np.uint64)
    ids = {"sensor_gyro": Sensor.GYROSCOPE, "sensor_accel": Sensor.ACCELEROMETER, "sensor_mag": Sensor.MAGNETOMETER}
    topics = []
    for number, (topic, sensor) in enumerate(ids.items()):
        axes = {axis: r.counts[sensor][:, i].astype(np.float32) for i, axis in enumerate(AXES)}
        own = {"device_id": np.full(len(t_us), 1000 + number, np.uint32)}
        warmth = {"temperature": r.temperature.astype(np.float32)}
        topics.append(Rows(topic, {"timestamp": t_us, "timestamp_sample": t_us, **own, **axes, **warmth}))
    if len(r.vps_t):
        vps_us = np.rint(r.vps_t * 1e6).astype(np.uint64)
        scalar_first = r.vps_q[:, [3, 0, 1, 2]].astype(np.float32)
        pose = {"position": r.vps_position.astype(np.float32), "q": scalar_first}
        frame = {"pose_frame": np.ones(len(vps_us), np.uint8)}
        topics.append(
            Rows("vehicle_mocap_odometry", {"timestamp": vps_us, "timestamp_sample": vps_us, **pose, **frame})
        )
    if len(r.gnss_t):
        gnss_us = np.rint(r.gnss_t * 1e6).astype(np.uint64)
        ways = {f"vel_{way}_m_s": r.gnss_velocity[:, i].astype(np.float32) for i, way in enumerate("ned")}
        fix, sd = np.full(len(gnss_us), 3, np.uint8), r.gnss_sd.astype(np.float32)
        row = {"timestamp": gnss_us, **ways, "s_variance_m_s": sd, "fix_type": fix}
        topics.append(Rows("vehicle_gps_position", row))
    write_ulog(path, topics, infos={"sys_name": "PX4", "boot_time_utc_us": start_ns // 1000})


def _write_csv(folder: Path, r: SimulatedFlight) -> None:
    """imu.csv and vps.csv under the default column names, time in seconds from the start, every digit that counts."""
    kind = pl.UInt16 if r.experiment.quantisation and r.experiment.logged == "counts" else pl.Float64
    names = {Sensor.GYROSCOPE: "g", Sensor.ACCELEROMETER: "a", Sensor.MAGNETOMETER: "m"}
    imu = {f"{short}{axis}": r.counts[name][:, i] for name, short in names.items() for i, axis in enumerate(AXES)}
    frame = pl.DataFrame({k: pl.Series(v).cast(kind) for k, v in imu.items()})
    frame.insert_column(0, _seconds("t_s", r.t))
    frame = frame.with_columns(temp=pl.Series(np.round(r.temperature, 4)))
    if len(r.gnss_t):
        # Rows of their own: the receiver has its own stamps.
        columns = columns_of(np.column_stack([r.gnss_velocity, r.gnss_sd]), SIGNAL_COLUMNS["gnss_velocity"][1:])
        velocity = pl.DataFrame(columns).insert_column(0, _seconds("t_s", r.gnss_t))
        frame = pl.concat([frame, velocity], how="diagonal").sort("t_s")
    frame.write_csv(folder / "imu.csv")
    if len(r.vps_t):
        vps = pl.DataFrame({**columns_of(r.vps_q, QUATERNION), **columns_of(r.vps_position, ("px", "py", "pz"))})
        vps.insert_column(0, _seconds("t_s", r.vps_t)).write_csv(folder / "vps.csv")


def _seconds(name: str, t: np.ndarray) -> pl.Series:
    """Seconds as text with nine digits: whole nanoseconds, as a recorder writes them."""
    return pl.Series(name, np.rint(t * 1e9).astype(np.int64)).cast(pl.Decimal(18, 0)).cast(pl.Decimal(38, 9)) / 10**9


class TriadTruth(TypedDict):
    """True constants of a triad at the mean temperature of the recording: x, y, z."""

    scale: list[float]
    bias: list[float]
    zero: list[float]


class Truth(TypedDict):
    """What a calibration of a recording should find; `constants` by sensor, quaternions scalar last."""

    temperature_degc: float
    constants: dict[str, TriadTruth]
    lag_s: float
    skew_ppm: float
    sensor_delay_s: float
    vps_world_rotation_xyzw: list[float]
    vps_body_rotation_xyzw: list[float]
    lever_arm_m: list[float]
    gnss_lag_s: float | None
    gnss_lever_arm_m: list[float] | None
    dip_rad: float
    translation_rms_mps2: float
    seed: int


def truth(r: SimulatedFlight) -> Truth:
    """What a calibration of this recording should find, plain JSON."""
    temperature = float(np.mean(r.temperature))
    constants: dict[str, TriadTruth] = {}
    for name in SENSORS:
        scale, bias = constants_at(r.experiment, name, temperature)
        constants[name] = {"scale": scale.tolist(), "bias": bias.tolist(), "zero": (-bias / scale).tolist()}
    e = r.experiment
    return {
        "temperature_degc": temperature,
        "constants": constants,
        "lag_s": r.lag_s,
        "skew_ppm": e.vps_skew_ppm,
        "sensor_delay_s": r.delay_s,
        "vps_world_rotation_xyzw": r.vps_world_rotation.tolist(),
        "vps_body_rotation_xyzw": r.vps_body_rotation.tolist(),
        "lever_arm_m": list(e.lever_arm_m),
        "gnss_lag_s": r.gnss_lag_s if len(r.gnss_t) else None,
        "gnss_lever_arm_m": list(e.gnss_arm_m) if len(r.gnss_t) else None,
        "dip_rad": e.dip_rad,
        "translation_rms_mps2": e.translation_rms_mps2,
        "seed": e.seed,
    }
