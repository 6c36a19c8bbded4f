"""Weak flights pooled, where the truth is known: what all know together, and whether its sd are honest.

    python benchmarks/pooled.py flights [--vehicles 6] [--flights 40] [--jobs 2]    simulated flights through the stages
    python benchmarks/pooled.py flights --motion mission [--without] [--seconds 60]   ordinary ones, by velocity or not
    python benchmarks/pooled.py together [--rounds 5]       pooled parts of a recording against one fit of all of it
    python benchmarks/pooled.py claims [--fleets 4]         error ÷ sd of units drawn without signals
    python benchmarks/pooled.py alarms [--fleets 100]       units without a fault: how many are told of one
    python benchmarks/pooled.py cost [--units 500] [--flights 200]                  cold, and after one new flight
    python benchmarks/pooled.py real ARCHIVE … [--piece 20]  recordings cut into pieces against their reference

Every flight turns about one or two axes and hardly about the others: alone it shows a few directions of the constants,
and its other rows are refused. Constants differ from vehicle to vehicle, walk, scatter from session to session and
follow the temperature (`TRUTH`).
"""

from __future__ import annotations

import argparse
import datetime as dt
import json
import tempfile
import time
from collections import defaultdict
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
from threadpoolctl import threadpool_limits

from fieldcal.estimation.normal_equations import Name, NormalEquations
from fieldcal.estimation.pooled.changes import pool
from fieldcal.estimation.pooled.movement import strengths
from fieldcal.estimation.pooled.unit import Flight, Unit
from fieldcal.geometry.rotation import Array
from fieldcal.names import SENSORS, Sensor
from fieldcal.schemas.frames import empty_frame
from fieldcal.simulation.archive import settings, signals
from fieldcal.simulation.experiment import Experiment, simulate
from fieldcal.simulation.ordinary import ordinary_flight
from fieldcal.stages.joint.information import equations_of
from fieldcal.stages.joint.information import table_of as rows_of_equations
from fieldcal.stages.pipeline import run_flight
from fieldcal.trends.pooled.memory import Memory
from fieldcal.trends.pooled.table import table_of

START = dt.datetime(2026, 1, 12, 8, 0, tzinfo=dt.UTC)
UNITS = {"gyroscope": "rad/s", "accelerometer": "m/s^2", "magnetometer": "norm"}
KNOWN: dict[str, Any] = {
    "units": UNITS,
    "nominal_scale": dict.fromkeys(SENSORS, (1.0, 1.0, 1.0)),
    "polarity": dict.fromkeys(SENSORS, (1, 1, 1)),
    "method": "joint",
    "lever_arm_m": None,
    "use_vps": False,
}
DIP_RAD = 1.0
NAMES: tuple[Name, ...] = tuple(
    (str(s), p, a) for s in ("accelerometer", "gyroscope", "magnetometer") for p in ("gain", "zero") for a in "xyz"
)
SPREAD = {"gain": 0.01, "gyroscope": 0.01, "accelerometer": 0.1, "magnetometer": 0.05}
"""Of gains between vehicles; of zeros by sensor, SI."""
SCATTER = {
    ("gyroscope", "gain"): 3e-4, ("gyroscope", "zero"): 5e-4, ("accelerometer", "gain"): 5e-4,
    ("accelerometer", "zero"): 5e-3, ("magnetometer", "gain"): 3e-3, ("magnetometer", "zero"): 3e-3,
}  # fmt: skip
"""Of sessions."""
WALK_SHARE = 0.05
"""Of the scatter, a √day."""
PER_DEGC = {
    ("gyroscope", "gain"): 2e-5, ("gyroscope", "zero"): 1e-4, ("accelerometer", "gain"): 2e-5,
    ("accelerometer", "zero"): 2e-3, ("magnetometer", "gain"): 1e-4, ("magnetometer", "zero"): 1e-4,
}  # fmt: skip
"""Scatter of slopes between vehicles."""


def of_names(by_kind: dict[tuple[str, str], float]) -> Array:
    return np.array([by_kind[name[:2]] for name in NAMES])


class Truth:
    """Constants (18,) of a vehicle in the order of NAMES, at each session and temperature."""

    def __init__(self, rng: np.random.Generator, sessions: int) -> None:
        nominal = np.array([1.0 if name[1] == "gain" else 0.0 for name in NAMES])
        spread = np.array([SPREAD["gain" if name[1] == "gain" else name[0]] for name in NAMES])
        self.day = np.cumsum(rng.uniform(1.0, 10.0, size=sessions))
        steps = rng.normal(size=(sessions, 18)) * of_names(SCATTER) * WALK_SHARE
        steps[1:] *= np.sqrt(np.diff(self.day))[:, None]
        self.walked = nominal + spread * rng.normal(size=18) + np.cumsum(steps, axis=0)
        self.scatter = of_names(SCATTER) * rng.normal(size=(sessions, 18))
        self.slope = of_names(PER_DEGC) * rng.normal(size=18)

    def of_flight(self, session: int, degc: float) -> Array:
        return np.asarray(self.walked[session] + self.scatter[session] + self.slope * (degc - 25.0))


def experiment(rng: np.random.Generator, constants: Array, degc: float, seed: int, seconds: float = 30.0) -> Experiment:
    """A weak flight: the turn is about one axis or two."""
    turned = rng.uniform(0.05, 0.3, size=3)
    turned[rng.choice(3, size=int(rng.integers(1, 3)), replace=False)] = rng.uniform(0.6, 1.0)
    value = dict(zip(NAMES, constants, strict=True))
    gain = {s: np.array([value[s, "gain", a] for a in "xyz"]) for s in UNITS}
    zero = {s: np.array([value[s, "zero", a] for a in "xyz"]) for s in UNITS}
    return Experiment(
        seed=seed, duration_s=seconds, sets=2, dip_rad=DIP_RAD, translation_rms_mps2=float(rng.uniform(0.05, 0.4)),
        turned=tuple(turned), temperature_degc=(degc, degc), quantisation=False, vps=False,
        scale={s: tuple(1.0 / gain[s]) for s in UNITS}, bias={s: tuple(-zero[s] / gain[s]) for s in UNITS},
    )  # fmt: skip


def ordinary(motion: str, constants: Array, degc: float, seed: int, seconds: float) -> Experiment:
    """A flight that nobody flew for a calibration, with a receiver's velocity."""
    value = dict(zip(NAMES, constants, strict=True))
    gain = {s: np.array([value[s, "gain", a] for a in "xyz"]) for s in UNITS}
    zero = {s: np.array([value[s, "zero", a] for a in "xyz"]) for s in UNITS}
    return ordinary_flight(
        motion, seed, duration_s=seconds, temperature_degc=(degc, degc),
        scale={s: tuple(1.0 / gain[s]) for s in UNITS}, bias={s: tuple(-zero[s] / gain[s]) for s in UNITS},
    )  # fmt: skip


def flown(e: Experiment, known: dict[str, Any]) -> dict[str, pl.DataFrame]:
    """`calibration` and `information` of one flight, as stages write them; fewer where they could not run."""
    r = simulate(e)
    with threadpool_limits(1):
        results = run_flight(signals(r), settings(e, **known))
    return {name: t for name, t in results["composition"].tables.items() if name in ("calibration", "information")}


def led(rows: pl.DataFrame, vehicle: int, flight: int, session: int, day: float) -> pl.DataFrame:
    """Rows of `information` or `calibration` as a night publishes them."""
    at = START + dt.timedelta(days=float(day), minutes=flight)
    table = "information" if "information" in rows.columns else "calibration"
    lead = {
        "flight_id": f"{vehicle:03d}-{flight:04d}", "vehicle_id": f"v{vehicle}", "imu_id": f"v{vehicle}",
        "session_id": f"s{session}", "started_at": at, "dated_by": "log", "sequence": None, "unit_id": f"v{vehicle}",
        "is_primary": True, "sensor_unit_id": f"v{vehicle}", "run_key": None,
    }  # fmt: skip
    empty = empty_frame(table)
    own = rows.with_columns(**{name: pl.lit(v) for name, v in lead.items() if name in empty.columns})
    return own.select(empty.columns).cast(dict(empty.schema))


def one_flight(task: tuple[int, int, int, float, Experiment, dict[str, Any]]) -> tuple[pl.DataFrame, pl.DataFrame]:
    vehicle, flight, session, day, e, known = task
    tables = flown(e, known)

    def of(name: str) -> pl.DataFrame:
        return led(tables[name], vehicle, flight, session, day) if name in tables else empty_frame(name)

    return of("information"), of("calibration")


def fleet(
    vehicles: int,
    flights: int,
    per_session: int = 2,
    jobs: int = 1,
    seed: int = 0,
    motion: str | None = None,
    use_velocity: bool = True,
    seconds: float = 60.0,
) -> tuple[Any, ...]:
    """(information, calibration, truths) of simulated flights; by hand where there is no `motion`."""
    truths, tasks = [], []
    known = KNOWN if motion is None else {"method": "auto", "use_velocity": use_velocity}
    for vehicle in range(vehicles):
        rng = np.random.default_rng([seed, vehicle])
        truth = Truth(rng, -(-flights // per_session))
        truths.append(truth)
        for flight in range(flights):
            session, degc = flight // per_session, float(rng.uniform(5.0, 35.0))
            at, number = truth.of_flight(session, degc), 10_000 * seed + 100 * vehicle + flight
            if motion is None:
                e = experiment(rng, at, degc, seed=number)
            else:
                e = ordinary(motion, at, degc, number, seconds)
            tasks.append((vehicle, flight, session, float(truth.day[session]), e, known))
    if jobs == 1:
        made = list(map(one_flight, tasks))
    else:
        with ProcessPoolExecutor(jobs) as workers:
            made = list(workers.map(one_flight, tasks, chunksize=4))
    return pl.concat([a for a, _ in made]), pl.concat([b for _, b in made]), truths


def flights(vehicles: int, count: int, jobs: int, motion: str | None, *, velocity: bool, seconds: float) -> None:
    """Rows alone against pooled, error ÷ sd."""
    began = time.perf_counter()
    made = fleet(vehicles, count, jobs=jobs, motion=motion, use_velocity=velocity, seconds=seconds)
    print(f"{vehicles} vehicles, {count} flights each: {time.perf_counter() - began:.0f} s of stages")
    against_truth(*made)


def against_truth(information: pl.DataFrame, calibration: pl.DataFrame, truths: Sequence[Truth]) -> None:
    """The table of rows alone and pooled, axes apart; error ÷ sd."""
    vehicles = len(truths)
    table = table_of(information)
    print(
        "| constant | rows ok of flights | error ÷ sd | pooled ok of vehicles | error ÷ sd | median sd alone, pooled |"
    )
    print("|---|---|---|---|---|---|")
    for kind in SCATTER:
        sensor, parameter = kind[0], "scale" if kind[1] == "gain" else "zero"
        alone = calibration.filter(sensor=sensor, parameter=parameter).filter(
            pl.col("axis").str.len_chars() == 1, pl.col("method").is_in(["joint", "velocity"])
        )
        ok = alone.filter(status="ok")
        z = [_z(row, truths, last=False) for row in ok.iter_rows(named=True)]
        pooled = table.filter(sensor=sensor, parameter=parameter)
        told = pooled.filter(pl.col("status").is_in(["ok", "step", "drifting"]))
        pooled_z = [_z(row, truths, last=True) for row in told.iter_rows(named=True)]
        print(
            f"| {sensor} {parameter} | {_by_axis(ok)} of {alone.height // 3} | {_rms(z):.2f} "
            f"| {_by_axis(told)} of {vehicles} | {_rms(pooled_z):.2f} "
            f"| {ok['sd'].median() or np.nan:.2g}, {told['sd'].median() or np.nan:.2g} |"
        )
    print(
        "left out:",
        table.select(pl.col("left_out").list.len().max().over("pooled_with")).to_series().unique().to_list(),
    )
    print("steps:", table.filter(status="step").height, "refused:", table.filter(status="refused").height)


def _by_axis(rows: pl.DataFrame) -> str:
    return " ".join(str(rows.filter(axis=axis).height) for axis in "xyz")


def _z(row: dict[str, Any], truths: Sequence[Truth], *, last: bool) -> float:
    truth = truths[int(row["vehicle_id"][1:])]
    session = int(row["session_id"][1:])
    place = NAMES.index((row["sensor"], "gain" if row["parameter"] == "scale" else row["parameter"], row["axis"]))
    own = truth.walked[session][place] if last else truth.of_flight(session, row["temperature_degc"])[place]
    value = row["value_at_25degc"] if last else row["value"]
    return float((value - (1.0 / own if row["parameter"] == "scale" else own)) / row["sd"])


def _rms(z: Sequence[float]) -> float:
    return float(np.sqrt(np.mean(np.square(z)))) if len(z) else np.nan


def together(rounds: int) -> None:
    """Parts of one recording pooled against one fit of the whole."""
    from fieldcal.simulation.experiment import SimulatedFlight

    def of(r: SimulatedFlight, span_s: tuple[float, float]) -> NormalEquations:
        bounds = (int(1e9 * s) for s in span_s)
        frames = signals(r)
        a, b = bounds
        frames = {name: frame.filter(pl.col("t_ns").is_between(a, b)) for name, frame in frames.items()}
        own = equations_of(run_flight(frames, settings(r.experiment, **KNOWN))["composition"].tables["information"])
        return own.of([name for name in own.names if name[1] in ("gain", "zero")])

    differences = []
    for seed in range(rounds):
        rng = np.random.default_rng(seed)
        e = experiment(rng, Truth(rng, 1).walked[0], 25.0, seed, seconds=120.0)
        r = simulate(e, sets=9, turned=(1.0, 1.0, 1.0))
        whole = of(r, (0.0, 1e3))
        parts = [of(r, (at, at + 40.0)).moved(whole.reference) for at in (0.0, 40.0, 80.0)]
        information, right = sum(p.information for p in parts), sum(p.right for p in parts)
        sd = np.sqrt(np.diagonal(np.linalg.inv(whole.information)))
        alone = np.linalg.solve(whole.information, whole.right)
        differences.append((np.linalg.solve(information, right) - alone) / sd)
        print(
            f"recording {seed}: pooled less fitted together, over its sd, rms {_rms(differences[-1]):.2f}", flush=True
        )
    print(f"rms of all {_rms(np.ravel(differences)):.2f}")


def drawn(
    rng: np.random.Generator,
    sessions: int,
    *,
    seen: int = 9,
    step: tuple[int, int, float] | None = None,
    scatters: float = 3.0,
    truth: Truth | None = None,
) -> Unit:
    """A unit as flights' information, without signals: each shows `seen` random directions of the 18, to so many
    `scatters` of sessions. `step`: session, constant, and by how many scatters."""
    truth = truth or Truth(rng, sessions)
    sd = of_names(SCATTER) * scatters
    made = []
    for session in range(sessions):
        degc = float(rng.uniform(5.0, 35.0))
        at = truth.of_flight(session, degc)
        if step is not None and session >= step[0]:
            at = at + step[2] * of_names(SCATTER) * (np.arange(18) == step[1])
        look = rng.normal(size=(seen, 18)) / sd
        reading = look @ at + rng.normal(size=seen)
        nominal = np.array([1.0 if name[1] == "gain" else 0.0 for name in NAMES])
        equations = NormalEquations(NAMES, nominal, look.T @ (reading - look @ nominal), look.T @ look)
        made.append(Flight(equations, session, degc - 25.0))
    return Unit(tuple(made), truth.day)


def claims(fleets: int, units: int = 6) -> None:
    """Error ÷ sd, rms, by kind, sessions and how well a flight knows the constants."""
    print("| sessions | directions | sd of one, in scatters | " + " | ".join(" ".join(kind) for kind in SCATTER) + " |")
    for sessions in (2, 4, 8, 20):
        for seen, scatters in ((12, 3.0), (30, 3.0), (30, 0.1)):
            z: dict[tuple[str, str], list[float]] = {kind: [] for kind in SCATTER}
            for number in range(fleets):
                rngs = [np.random.default_rng([number, unit, sessions]) for unit in range(units)]
                truths = [Truth(rng, sessions) for rng in rngs]
                drawn_units = [
                    drawn(rng, sessions, seen=seen, scatters=scatters, truth=truth)
                    for rng, truth in zip(rngs, truths, strict=True)
                ]
                kinds = strengths(drawn_units)
                for unit, truth in zip(drawn_units, truths, strict=True):
                    found = pool(unit, kinds)
                    now, sd = found.at(), np.sqrt(np.diagonal(found.at().covariance))
                    for place, name in enumerate(found.names):
                        if np.isfinite(sd[place]):
                            off = now.state[place] - truth.walked[-1][NAMES.index(name)]
                            z[name[:2]].append(float(off / sd[place]))
            cells = " | ".join(f"{_rms(values):.2f}" for values in z.values())
            print(f"| {sessions} | {seen} | {scatters:g} | {cells} |", flush=True)


def alarms(fleets: int, units: int = 12, counts: Sequence[int] = (4, 8, 12, 24)) -> dict[int, tuple[int, int, int]]:
    """By sessions: units with an alarm, of how many, and steps of ten scatters found (one a fleet) in their session."""
    out = {}
    with threadpool_limits(1):
        for sessions in counts:
            wrong = hits = 0
            for number in range(fleets):
                rng = np.random.default_rng([sessions, number])
                drawn_units = [drawn(rng, sessions, seen=12) for _ in range(units)]
                kinds = strengths(drawn_units)
                wrong += sum(
                    bool(p.steps or p.left_out or p.bent or p.drifting)
                    for p in (pool(unit, kinds) for unit in drawn_units)
                )
                place = int(rng.integers(18))
                stepped = pool(drawn(rng, sessions, seen=12, step=(sessions // 2, place, 10.0)), kinds)
                hits += any(s.name == NAMES[place] and s.after == sessions // 2 for s in stepped.steps)
            out[sessions] = wrong, fleets * units, hits
            print(
                f"{sessions} sessions: {wrong} of {fleets * units} units with an alarm, {hits} of {fleets} steps",
                flush=True,
            )
    return out


def cost(units: int, count: int) -> None:
    """Of the table `pooled` from rows of `information` in memory."""
    rows = []
    for vehicle in range(units):
        rng = np.random.default_rng([7, vehicle])
        unit = drawn(rng, count // 4)
        of_unit = {Sensor(sensor): (unit_, unit_) for sensor, unit_ in UNITS.items()}
        flights_ = [f for f in unit.flights for _ in range(4)]
        for k, flight in enumerate(flights_):
            own = rows_of_equations(flight.equations, [None] * 18, of_unit)
            own = own.with_columns(temperature_degc=pl.lit(25.0 + float(flight.warmth_degc or 0.0)))
            rows.append(led(own, vehicle, k, flight.session, unit.day[flight.session]))
    information = pl.concat(rows)
    print(f"{units} units, {count} flights each: {information.estimated_size() / 1e6:.0f} MB of rows")
    with tempfile.TemporaryDirectory() as folder:
        pooled_again("cold", information, Path(folder))
        pooled_again("nothing new", information, Path(folder))
        # The same flight once more, in the session after: of the unit that flew last, which is of those that tell.
        last = information.filter(pl.col("flight_id") == information["flight_id"][-1])
        new = last.with_columns(
            flight_id=pl.lit("new"), session_id=pl.lit("new"), started_at=pl.col("started_at") + dt.timedelta(days=7)
        )
        pooled_again("one new flight", pl.concat([information, new]), Path(folder))


def pooled_again(what: str, information: pl.DataFrame, folder: Path) -> None:
    began = time.perf_counter()
    memory = Memory(folder, "")
    table = table_of(information, memory)
    memory.save()
    print(f"{what}: {time.perf_counter() - began:.1f} s, {memory.pooled} units pooled, {table.height} rows")


def real(archives: Sequence[Path], piece_s: float) -> None:
    """Recordings cut into pieces, each a flight and session of its own: pooled against the recording's reference."""
    from real_recordings import truth_of

    from fieldcal.config.configuration import load
    from fieldcal.logs import ingest
    from fieldcal.names import Sensor

    ratios: dict[str, list[float]] = defaultdict(list)
    for archive in archives:
        expected = json.loads((archive / "expected.json").read_text())
        configuration = load(archive / "fieldcal.toml")
        for name, entry in expected.items():
            if truth_of(entry, Sensor.GYROSCOPE) is None:
                continue
            path = archive / name
            vehicle = configuration.vehicle(path.parent.parent.name)
            frames, facts = ingest.read_flight(path, vehicle)
            own = ingest.settings_of(facts, vehicle).changed(method="joint", use_vps=False)
            first, last = (int(frames["imu"]["t_ns"][i]) for i in (0, -1))
            rows, alone, pieces = [], 0, 0
            for k, at in enumerate(range(first, last, int(piece_s * 1e9))):
                cut = {n: f.filter(pl.col("t_ns").is_between(at, at + int(piece_s * 1e9))) for n, f in frames.items()}
                with threadpool_limits(1):
                    results = run_flight({n: f for n, f in cut.items() if f.height}, own)
                pieces += 1
                tables = results["composition"].tables
                if "information" in tables and tables["information"].height:
                    rows.append(led(tables["information"], 0, k, k, k * 1e-3))
                if "calibration" in tables:
                    ok = tables["calibration"].filter(parameter="scale", status="ok", method="joint")
                    alone += ok.filter(pl.col("axis").str.len_chars() == 1).height
            table = table_of(pl.concat(rows)) if len(rows) > 1 else empty_frame("pooled")
            cells = [f"{name}: {pieces} pieces, {alone} scales alone"]
            for sensor in (Sensor.GYROSCOPE, Sensor.ACCELEROMETER):
                if (reference := truth_of(entry, sensor)) is None:
                    continue
                for j, parameter in enumerate(("scale", "zero")):
                    told = table.filter(sensor=str(sensor), parameter=parameter).filter(
                        pl.col("status").is_in(["ok", "step", "drifting"])
                    )
                    for row in told.iter_rows(named=True):
                        i = "xyz".index(row["axis"])
                        error = row["value_at_25degc"] - reference[2 * j][i]
                        z = error / np.hypot(row["sd"], reference[2 * j + 1][i])
                        ratios[f"{sensor} {parameter}"].append(z)
                        size = 100.0 * error / abs(reference[0][i]) if parameter == "scale" else error
                        cells.append(f"{sensor[0]}{parameter[0]}{row['axis']} {size:.2g} ({z:.1f})")
            print(" ".join(cells), flush=True)
    for quantity, values in ratios.items():
        print(
            f"{quantity}: {len(values)} pooled, error ÷ sd rms {_rms(values):.2f}, largest {np.abs(values).max():.1f}"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("flights", "together", "claims", "alarms", "cost", "real"))
    parser.add_argument("archive", nargs="*", type=Path)
    parser.add_argument("--vehicles", type=int, default=6)
    parser.add_argument("--flights", type=int, default=40)
    parser.add_argument("--motion", choices=("mission", "lively", "hover", "fixed_wing"))
    parser.add_argument("--without", action="store_true", help="the receiver's velocity is not used")
    parser.add_argument("--seconds", type=float, default=60.0, help="that an ordinary flight lasts")
    parser.add_argument("--units", type=int, default=500)
    parser.add_argument("--fleets", type=int)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--piece", type=float, default=20.0)
    given = parser.parse_args()
    if given.what == "flights":
        flights(
            given.vehicles,
            given.flights,
            given.jobs,
            given.motion,
            velocity=not given.without,
            seconds=given.seconds,
        )
    elif given.what == "together":
        together(given.rounds)
    elif given.what == "claims":
        claims(given.fleets or 4)
    elif given.what == "alarms":
        alarms(given.fleets or 100)
    elif given.what == "cost":
        cost(given.units, given.flights)
    else:
        real(given.archive, given.piece)


if __name__ == "__main__":
    main()
