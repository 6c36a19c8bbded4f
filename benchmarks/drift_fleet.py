"""Drift over a fleet whose truth is known: 12 units, 24 sessions a week apart, −10 to 45 °C.

One unit's gyroscope steps by ten session sds, one drifts, one is unlike its siblings, two flights of a fourth are
spoiled by a magnet. Every unit has temperature coefficients of its own.

    python benchmarks/drift_fleet.py                    many fleets as rows of the history: seconds
    python benchmarks/drift_fleet.py --sessions 8       the same of young fleets: what so few sessions tell
    python benchmarks/drift_fleet.py --pooled           rows with their information: drift is read from the smoother
    python benchmarks/drift_fleet.py --sessions 18 --tell        when a drift is named, and was said to be
    python benchmarks/drift_fleet.py --logs FOLDER      one fleet as simulated logs through `fieldcal nightly`: minutes
"""

from __future__ import annotations

import argparse
import datetime as dt
import json
import re
import subprocess
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
from scipy.linalg import block_diag

from fieldcal.names import SENSORS, Sensor
from fieldcal.schemas.frames import empty_frame
from fieldcal.simulation.archive import write_flight
from fieldcal.simulation.experiment import BIAS, MID_SCALE, SCALE, Experiment, simulate
from fieldcal.trends.drift_table import table_of, update_drift
from fieldcal.trends.pooled.table import table_of as pooled_of
from fieldcal.warehouse import Warehouse

UNITS, SESSIONS = 12, 24
START = dt.datetime(2026, 1, 12, 8, 0, tzinfo=dt.UTC)
COLDEST_DEGC, WARMEST_DEGC = -10.0, 45.0
WARMING_DEGC = 1.0
"""over a flight"""
STEP_UNIT, DRIFTING_UNIT, OUTLIER_UNIT, MAGNET_UNIT = 0, 1, 2, 3
STEP_SESSION = 14
MAGNET_SESSIONS: tuple[int, ...] = (8, 17)
STEP_SDS = 10.0
DRIFT_SDS_A_SESSION = 0.5
OUTLIER_SPREADS = 12.0
METHODS = {
    "magnetometer": ("ellipsoid_robust",),
    "accelerometer": ("ellipsoid_robust",),
    "gyroscope": ("equation_error", "output_error"),
}
UNIT = {"magnetometer": "norm", "accelerometer": "m/s^2", "gyroscope": "rad/s"}
SESSION_SD = {"magnetometer": 4e-3, "accelerometer": 0.04, "gyroscope": 8e-3}
UNIT_SPREAD = {"magnetometer": 0.03, "accelerometer": 0.3, "gyroscope": 0.06}
"""of zero_bias between units"""
BIAS_PER_DEGC = {"magnetometer": 5e-4, "accelerometer": 6e-3, "gyroscope": 1e-3}
SCALE_PER_DEGC = {"magnetometer": 2e-4, "accelerometer": 2e-4, "gyroscope": 2e-4}
"""typical, relative"""
FLIGHT_SD = {"magnetometer": 2e-3, "accelerometer": 0.02, "gyroscope": 3e-3}
FLIGHT_SCALE_SD = {"magnetometer": 5e-3, "accelerometer": 6e-3, "gyroscope": 7e-3}
"""of a flight's estimates, for the fleets that are rows; scale relative"""
SIZE_BAR, SLOPE_BAR = 0.15, 0.05


@dataclass(frozen=True)
class Fleet:
    """Truth by sensor, (UNITS, 3): scale, `middle` = zero_bias at 25 °C, their slopes (the scale's relative), sessions'
    offsets (UNITS, 3, SESSIONS); and the temperature (UNITS, SESSIONS)."""

    scale: dict[str, np.ndarray]
    middle: dict[str, np.ndarray]
    bias_per_degc: dict[str, np.ndarray]
    scale_per_degc: dict[str, np.ndarray]
    offset: dict[str, np.ndarray]
    temperature: np.ndarray


def draw(seed: int) -> Fleet:
    rng = np.random.default_rng([seed, 4711])
    fleet = Fleet({}, {}, {}, {}, {}, rng.uniform(COLDEST_DEGC, WARMEST_DEGC, (UNITS, SESSIONS)))
    for name in SENSORS:
        paper = np.array(SCALE[name])
        fleet.scale[name] = paper * (1.0 + rng.uniform(-0.03, 0.03, (UNITS, 3)))
        fleet.middle[name] = paper * MID_SCALE + BIAS[name] + UNIT_SPREAD[name] * rng.normal(size=(UNITS, 3))
        fleet.bias_per_degc[name] = BIAS_PER_DEGC[name] * rng.uniform(0.5, 1.5, (UNITS, 3)) * rng.choice([-1, 1], 3)
        fleet.scale_per_degc[name] = SCALE_PER_DEGC[name] * rng.uniform(-1.0, 1.0, (UNITS, 3))
        fleet.offset[name] = SESSION_SD[name] * rng.normal(size=(UNITS, 3, SESSIONS))
    sd = SESSION_SD["gyroscope"]
    fleet.offset["gyroscope"][STEP_UNIT, 0, STEP_SESSION:] += STEP_SDS * sd
    fleet.offset["gyroscope"][DRIFTING_UNIT, 1] += DRIFT_SDS_A_SESSION * sd * np.arange(SESSIONS)
    fleet.middle["gyroscope"][OUTLIER_UNIT, 2] += OUTLIER_SPREADS * UNIT_SPREAD["gyroscope"]
    return fleet


def rows_of_history(fleet: Fleet, seed: int) -> pl.DataFrame:
    """What nights would have published: estimates with their own errors, two flights of one unit spoiled."""
    rng = np.random.default_rng([seed, 4712])
    parts = []
    for name, methods in METHODS.items():
        warm = fleet.temperature[:, None, :] - 25.0
        scale = fleet.scale[name][:, :, None] * (1.0 + fleet.scale_per_degc[name][:, :, None] * warm)
        middle = fleet.middle[name][:, :, None] + fleet.bias_per_degc[name][:, :, None] * warm + fleet.offset[name]
        for method in methods:
            spread = rng.uniform(0.6, 1.6, scale.shape)
            sd, scale_sd = FLIGHT_SD[name] * spread, FLIGHT_SCALE_SD[name] * np.abs(scale) * spread
            found = middle + sd * rng.normal(size=scale.shape)
            slope = scale + scale_sd * rng.normal(size=scale.shape)
            if name != "accelerometer":
                for session in MAGNET_SESSIONS:
                    found[MAGNET_UNIT, :, session] += rng.choice([-1, 1], 3) * rng.uniform(20, 60, 3) * FLIGHT_SD[name]
                    slope[MAGNET_UNIT, :, session] *= 1.0 + rng.choice([-1, 1], 3) * rng.uniform(0.1, 0.3, 3)
            # Of the fit, in which zero_bias and scale are nearly independent: errors of bias and zero follow.
            zero = MID_SCALE - found / slope
            for parameter, value, own_sd, unit in (
                ("zero_bias", found, sd, UNIT[name]),
                ("scale", slope, scale_sd, f"{UNIT[name]}/counts"),
                ("bias", found - slope * MID_SCALE, np.hypot(sd, scale_sd * MID_SCALE), UNIT[name]),
                ("zero", zero, np.hypot(sd, scale_sd * np.abs(found / slope)) / np.abs(slope), "counts"),
            ):
                parts.append(_frame(name, method, parameter, unit, value, own_sd, fleet.temperature))
    order = ["unit_id", "sensor", "method", "parameter", "axis", "started_at", "vehicle_id", "flight_id"]
    return pl.concat(parts).sort(order)


def with_information(flights: pl.DataFrame) -> tuple[pl.DataFrame, pl.DataFrame]:
    """(rows of each sensor's most exact method, as the joint estimate's; the same as rows of `information`)."""
    from fieldcal.estimation.normal_equations import NormalEquations
    from fieldcal.stages.joint.information import table_of as rows_of_equations

    exact = pl.col("method") != "equation_error"
    flights = flights.filter(exact).with_columns(method=pl.lit("joint"))
    units = {Sensor(name): (UNIT[name], "counts") for name in SENSORS}
    tables = []
    for _, own in flights.group_by("unit_id", "session_id", maintain_order=True):
        value = {(r["sensor"], r["parameter"], r["axis"]): (r["value"], r["sd"]) for r in own.iter_rows(named=True)}
        names, reference, blocks = [], [], []
        for sensor in SENSORS:
            for axis in "xyz":
                (slope, slope_sd), (found, sd) = (value[sensor, p, axis] for p in ("scale", "zero_bias"))
                names += [(str(sensor), "gain", axis), (str(sensor), "zero", axis)]
                reference += [1.0 / slope, MID_SCALE - found / slope]
                jacobian = np.array([[-1.0 / slope**2, 0.0], [found / slope**2, -1.0 / slope]])
                inverse = np.linalg.inv(jacobian)
                blocks.append(inverse.T @ np.diag([slope_sd**-2, sd**-2]) @ inverse)
        information = block_diag(*blocks)
        equations = NormalEquations(tuple(names), np.array(reference), np.zeros(len(names)), information)
        rows = rows_of_equations(equations, [None] * len(names), units)
        first = own.row(0, named=True)
        lead = {
            **{name: first[name] for name in ("flight_id", "vehicle_id", "imu_id", "session_id", "started_at")},
            "dated_by": "log", "sequence": None, "unit_id": first["unit_id"], "is_primary": True,
            "sensor_unit_id": first["unit_id"], "run_key": None, "temperature_degc": first["temperature_degc"],
        }  # fmt: skip
        empty = empty_frame("information")
        rows = rows.with_columns(**{name: pl.lit(v) for name, v in lead.items() if name in empty.columns})
        tables.append(rows.select(empty.columns).cast(dict(empty.schema)))
    return flights, pl.concat(tables)


def _frame(
    sensor: str, method: str, parameter: str, unit: str, value: np.ndarray, sd: np.ndarray, warm: np.ndarray
) -> pl.DataFrame:
    u, a, k = (index.ravel() for index in np.indices(value.shape))
    vehicle = pl.Series([f"unit-{i:02d}" for i in u])
    return pl.DataFrame(
        {
            "vehicle_id": vehicle,
            "imu_id": vehicle,
            "unit_id": vehicle,
            "session_id": [f"s{i:02d}" for i in k],
            "flight_id": [f"{i:02d}-{j:02d}" for i, j in zip(u, k, strict=True)],
            "started_at": pl.Series([START + dt.timedelta(days=7 * int(i)) for i in k], dtype=pl.Datetime("us", "UTC")),
            "sequence": [0] * value.size,
            "axis": ["xyz"[i] for i in a],
            "value": value.ravel(),
            "sd": sd.ravel(),
            "temperature_degc": warm[u, k],
        }
    ).with_columns(sensor=pl.lit(sensor), method=pl.lit(method), parameter=pl.lit(parameter), unit=pl.lit(unit))


def write_logs(fleet: Fleet, archive: Path, seed: int, duration_s: float) -> int:
    """The fleet as an archive of MCAP logs."""
    described, count = [], 0
    for u in range(UNITS):
        vehicle = f"unit-{u:02d}"
        described.append(_vehicle_table(vehicle))
        for k in range(SESSIONS):
            day = START + dt.timedelta(days=7 * k)
            folder = archive / vehicle / f"{day:%Y-%m-%d}"
            folder.mkdir(parents=True, exist_ok=True)
            experiment = _experiment(fleet, u, k, seed, duration_s)
            write_flight(folder, "flight", simulate(experiment), day)
            count += 1
    (archive / "fieldcal.toml").write_text("\n\n".join(described) + "\n", encoding="utf-8")
    return count


def _experiment(fleet: Fleet, u: int, k: int, seed: int, duration_s: float) -> Experiment:
    scale, bias, bias_slope, scale_slope = {}, {}, {}, {}
    for name in SENSORS:
        scale[name] = _triple(fleet.scale[name][u])
        middle = fleet.middle[name][u] + fleet.offset[name][u, :, k]
        bias[name] = _triple(middle - fleet.scale[name][u] * MID_SCALE)
        bias_slope[name] = _triple(fleet.bias_per_degc[name][u])
        scale_slope[name] = _triple(fleet.scale_per_degc[name][u])
    warm = float(fleet.temperature[u, k])
    base = Experiment(
        seed=int(np.random.SeedSequence([seed, u, k]).generate_state(1)[0]),
        duration_s=duration_s,
        sets=2,
        scale=scale,
        bias=bias,
        bias_per_degc=bias_slope,
        scale_per_degc=scale_slope,
        temperature_degc=(warm - 0.5 * WARMING_DEGC, warm + 0.5 * WARMING_DEGC),
        vps_rate_hz=100.0,
    )
    spoiled = u == MAGNET_UNIT and k in MAGNET_SESSIONS
    return replace(base, magnetic_bursts=4, burst_norm=0.5) if spoiled else base


def _triple(values: np.ndarray) -> tuple[float, float, float]:
    return float(values[0]), float(values[1]), float(values[2])


def _vehicle_table(vehicle: str) -> str:
    polarity = ", ".join(f"{name} = {[int(np.sign(v)) for v in SCALE[name]]}" for name in SENSORS)
    return "\n".join(
        [
            f'[vehicles."{vehicle}"]',
            "gravity_mps2 = 9.81",
            'field = { north_east_down = [1.0, 0.0, 0.0], unit = "norm" }',
            f"polarity = {{ {polarity} }}",
        ]
    )


def judged(table: pl.DataFrame, fleet: Fleet) -> dict[str, Any]:
    """What the issue's bars ask, from a table `drift`."""
    unit = pl.col("unit_id").str.slice(5).cast(pl.Int64)
    calibrated = table.filter(pl.col("sensor").is_in(SENSORS)).with_columns(unit=unit)
    gyro = calibrated.filter(sensor="gyroscope", parameter="zero_bias")
    coefficient = fleet.bias_per_degc["gyroscope"]
    truth = np.array([coefficient[u, "xyz".index(axis)] for u, axis in gyro.select("unit", "axis").rows()])
    error = gyro["slope_per_degc"].to_numpy() - truth
    sd = gyro["slope_per_degc_sd"].to_numpy()
    within = np.abs(error) <= np.maximum(SLOPE_BAR * np.abs(truth), 3.0 * sd)
    best = gyro.filter(pl.col("method").is_in(["output_error", "joint"]))

    def row(u: int, axis: str) -> dict[str, Any]:
        return best.row(by_predicate=(pl.col("unit") == u) & (pl.col("axis") == axis), named=True)

    step = row(STEP_UNIT, "x")
    others = calibrated.filter(~pl.col("unit").is_in([STEP_UNIT, DRIFTING_UNIT, OUTLIER_UNIT]))
    late = None if step["change_at"] is None else (step["change_at"] - START).days / 7 - STEP_SESSION
    last_word = gyro["method"].is_in(["output_error", "joint"]).to_numpy()
    return {
        "slopes within 5 % or 3 sd": float(within.mean()),
        "of output error": float(within[last_word].mean()),
        **{
            f"rms of {method}": float(np.sqrt(np.nanmean((error / sd)[(gyro["method"] == method).to_numpy()] ** 2)))
            for method in METHODS["gyroscope"]
        },
        "error / sd of slopes, rms": float(np.sqrt(np.nanmean((error / sd) ** 2))),
        "median error of slopes": float(np.median(np.abs(error / truth))),
        "step named": step["status"] == "step",
        "step named or moved": step["status"] in ("step", "drifting"),
        "step late by sessions": late,
        "step size off by": None if late is None else step["change_size"] / (STEP_SDS * SESSION_SD["gyroscope"]) - 1.0,
        "drifting named": row(DRIFTING_UNIT, "y")["status"] == "drifting",
        "outlier named": row(OUTLIER_UNIT, "z")["status"] == "outlier",
        "other rows": others.height,
        "of them not stable": float((others["status"] != "stable").mean()),
    }


def as_rows(seeds: int, first: int, understated: float, *, pooled: bool = False) -> None:
    found, seconds = [], 0.0
    equation = pl.col("method") == "equation_error"
    for seed in range(first, first + seeds):
        fleet = draw(seed)
        flights = rows_of_history(fleet, seed)
        flights = flights.with_columns(sd=pl.when(equation).then(pl.col("sd") / understated).otherwise("sd"))
        information = empty_frame("information")
        if pooled:
            flights, information = with_information(flights)
        begun = time.process_time()
        table = table_of([flights], pooled=pooled_of(information))
        seconds += time.process_time() - begun
        found.append(judged(table, fleet))
    error = np.array([f["error / sd of slopes, rms"] for f in found])
    size = np.array([f["step size off by"] for f in found if f["step size off by"] is not None])
    late = np.array([f["step late by sessions"] for f in found if f["step late by sessions"] is not None])
    print(f"{seeds} fleets (seeds from {first}) of {UNITS} units x {SESSIONS} sessions, 48 rows a unit, as rows")
    for name in (
        "slopes within 5 % or 3 sd",
        "of output error",
        "step named",
        "step named or moved",
        "drifting named",
        "outlier named",
    ):
        print(f"  {name:32s} {np.mean([f[name] for f in found]):.4f}")
    if not len(late):
        return
    print(f"  {'step within one session':32s} {np.mean(np.abs(late) <= 1):.4f}")
    sized, rms = np.mean(np.abs(size) <= SIZE_BAR), np.sqrt(np.mean(size**2))
    print(f"  {'step size within 15 %':32s} {sized:.4f}   (rms {rms:.3f})")
    unstable = np.array([f["of them not stable"] for f in found])
    print(f"  {'other rows not stable':32s} {unstable.mean():.4f}   (worst fleet {unstable.max():.4f})")
    for name in () if pooled else [f"rms of {method}" for method in METHODS["gyroscope"]]:
        print(f"  {name:32s} {np.sqrt(np.mean([f[name] ** 2 for f in found])):.3f}")
    rms = np.sqrt(np.mean(error**2))
    print(f"  {'error / sd of slopes, rms':32s} {rms:.3f}   (fleets {error.min():.2f} to {error.max():.2f})")
    print(f"  {'CPU per IMU':32s} {1e3 * seconds / seeds / UNITS:.1f} ms")


def late_by(seed: int, first: int, last: int) -> list[int]:
    """How many sessions later than a stable row's `reason` said the drifting unit was named, each time that it said
    something, from its first sessions on."""
    flights = rows_of_history(draw(seed), seed)
    said: dict[int, int] = {}
    for n in range(first, last + 1):
        table = table_of([flights.filter(pl.col("session_id") < f"s{n:02d}")])
        unit = f"unit-{DRIFTING_UNIT:02d}"
        place = {"sensor": "gyroscope", "parameter": "zero_bias", "method": "output_error", "axis": "y"}
        row = table.row(by_predicate=pl.all_horizontal(pl.col("unit_id") == unit, *_same(place)), named=True)
        if row["status"] == "drifting":
            return [n - at - more for at, more in said.items()]
        if (told := re.search(r"May drift.* about (\d+) more", row["reason"] or "")) is not None:
            said[n] = int(told[1])
    return []


def _same(place: dict[str, str]) -> list[pl.Expr]:
    return [pl.col(name) == value for name, value in place.items()]


def as_told(seeds: int, first_seed: int) -> None:
    late = np.array([by for seed in range(first_seed, first_seed + seeds) for by in late_by(seed, 7, SESSIONS)])
    print(f"{len(late)} sentences on how many more sessions would tell, {seeds} fleets: the drift was named later by")
    print(f"  median {np.median(late):.0f}, 10 to 90 % {np.percentile(late, 10):.0f} to {np.percentile(late, 90):.0f}")


def as_logs(folder: Path, seed: int, duration_s: float, workers: int) -> None:
    archive, root = folder / "archive", folder / "warehouse"
    fleet = draw(seed)
    if not archive.is_dir():
        begun = time.monotonic()
        print(f"{write_logs(fleet, archive, seed, duration_s)} logs in {time.monotonic() - begun:.0f} s", flush=True)
    begun = time.monotonic()
    command = [sys.executable, "-m", "fieldcal", "nightly", str(archive), "--warehouse", str(root), "--json"]
    done = subprocess.run([*command, "--workers", str(workers)], stdout=subprocess.PIPE, check=False)
    if done.returncode not in (0, 3):
        raise SystemExit(f"fieldcal nightly ended with {done.returncode}")
    night = json.loads(done.stdout)
    print(f"night: {night['ok']} of {len(night['logs'])} logs ok, {time.monotonic() - begun:.0f} s", flush=True)
    update_drift(root)
    for name, value in judged(Warehouse(root).scan("drift").collect(), fleet).items():
        print(f"  {name:32s} {value}")


def of_sessions(sessions: int) -> None:
    """Fleets of so many sessions instead, with one step and one drifting unit alone."""
    global SESSIONS, STEP_SESSION, MAGNET_SESSIONS
    SESSIONS, STEP_SESSION, MAGNET_SESSIONS = sessions, round(sessions * STEP_SESSION / SESSIONS), ()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=100, help="fleets that are rows")
    parser.add_argument("--first-seed", type=int, default=0, help="of the fleets that are rows")
    parser.add_argument("--sessions", type=int, help="of a unit, without spoiled flights; else 24 with them")
    parser.add_argument("--pooled", action="store_true", help="rows with their information")
    parser.add_argument("--tell", action="store_true", help="how many more sessions would tell, and did")
    parser.add_argument("--understated", type=float, default=1.0, help="equation error states its sd so much too small")
    parser.add_argument("--logs", type=Path, help="one fleet as logs, in this folder")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--duration", type=float, default=30.0, help="seconds a simulated flight lasts")
    parser.add_argument("--workers", type=int, default=1)
    options = parser.parse_args()
    if options.sessions is not None:
        of_sessions(options.sessions)
    if options.tell:
        as_told(options.seeds, options.first_seed)
    elif options.logs is None:
        as_rows(options.seeds, options.first_seed, options.understated, pooled=options.pooled)
    else:
        as_logs(options.logs, options.seed, options.duration, options.workers)


if __name__ == "__main__":
    main()
