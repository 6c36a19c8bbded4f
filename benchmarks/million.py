"""A million flights on paper: histories of 10,000, 100,000 and 1,000,000 flights, 200 a vehicle, and questions to them.

    python benchmarks/million.py grow ROOT [--vehicles 5000] [--workers 2]
    python benchmarks/million.py part ROOT SMALLER --vehicles 500      # the first vehicles of it, by hard links
    python benchmarks/million.py measure ROOT [--only NAME …]          # a table; each line in its own process

Rows alone are grown, no logs: one simulated flight is calibrated, and each flight of the fleet has that flight's rows
in every table, with numbers of its own. Constants differ from unit to unit, scatter from session to session and follow
the temperature; digits in texts (`measured`, sums of moments) and keys are random, so that they compress as those of
real flights do. A vehicle flies 40 sessions of five flights.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import re
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from datetime import UTC, datetime
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import polars as pl

from fieldcal.schemas import FLIGHT_TABLES
from fieldcal.warehouse import Warehouse
from fieldcal.warehouse.layout import checksum_path, history_path, prepare
from fieldcal.warehouse.publish import _sorted, publish
from fieldcal.warehouse.sealed import seal
from fieldcal.warehouse.store import read_table, table_bytes

SEED = 20260511
START = datetime(2025, 1, 6, 8, tzinfo=UTC)
FLIGHTS, OF_A_SESSION = 200, 5
"""Of a vehicle."""
DIGITS = re.compile(rb"\d{3}(\d+)")
"""Digits of a number in a text that a flight has of its own: those after the first three."""
UNIT_SD, SESSION_SD, PER_DEGC = 8.0, 0.5, 0.05
"""How far constants of units are apart, scatter between sessions, and move per °C, in sd of a flight."""
Template = dict[str, pl.DataFrame]


def template(folder: Path) -> Template:
    """Rows of one simulated flight, in every table."""
    from fieldcal.flows.run import run_night
    from fieldcal.simulation.archive import write_flights
    from fieldcal.simulation.experiment import Experiment

    write_flights(folder / "archive", Experiment(seed=6, duration_s=120.0), vehicles=1)
    run_night(folder / "archive", folder / "warehouse")
    return like(folder / "warehouse")


def like(root: Path) -> Template:
    """Rows of the first flight that a warehouse has, in every table."""
    warehouse = Warehouse(root)
    flight_id = warehouse.scan("flight").sort("flight_id").first().collect()["flight_id"].item()
    return {name: warehouse.scan(name, flight_id=flight_id).collect() for name in FLIGHT_TABLES}


def grow_vehicle(root: Path, rows: Template, number: int) -> None:
    """The history of one vehicle, as if it had been published a night at a time."""
    rng = np.random.default_rng([SEED, number])
    vehicle = f"uav-{number:04d}"
    flight, session = np.arange(FLIGHTS), np.arange(FLIGHTS) // OF_A_SESSION
    warm = np.repeat(rng.uniform(-5.0, 40.0, FLIGHTS // OF_A_SESSION), OF_A_SESSION) + rng.normal(0.0, 1.0, FLIGHTS)
    day = [f"2025-s{one:03d}" for one in session]
    lead = pl.DataFrame(
        {
            "flight_id": [f"{number:06x}{one:010x}" for one in flight],
            "vehicle_id": vehicle,
            "imu_id": f"imu-{number:04d}",
            "session_id": day,
            "started_at": [
                START.timestamp() + 9 * 86400.0 * s + 1200.0 * (i % OF_A_SESSION) for i, s in enumerate(session)
            ],
            "sequence": [f"{s}/flight-011.{i % OF_A_SESSION}" for i, s in enumerate(day)],
            "warm": warm,
            "log_uri": [f"{vehicle}/{s}/flight-{i % OF_A_SESSION}.mcap" for i, s in enumerate(day)],
            "log_sha256": [rng.bytes(32).hex() for _ in flight],
        }
    ).with_columns(pl.from_epoch((pl.col("started_at") * 1e6).cast(pl.Int64), "us").dt.replace_time_zone("UTC"))
    keys = {key: [rng.bytes(16).hex() for _ in flight] for key in rows["run"]["run_key"].drop_nulls().unique().sort()}
    for place, (name, of_one) in enumerate(rows.items()):
        if not of_one.is_empty():
            own = np.random.default_rng([SEED, number, place])
            write(root, name, vehicle, _of_vehicle(name, of_one, lead, keys, own))


def _of_vehicle(
    name: str, of_one: pl.DataFrame, lead: pl.DataFrame, keys: dict[str, list[str]], rng: np.random.Generator
) -> pl.DataFrame:
    n, k = of_one.height, lead.height
    every = pl.concat([of_one] * k)
    index = np.repeat(np.arange(k), n)
    own = lead[index]
    columns = {c: own[c] for c in lead.columns if c in every.columns}
    if "unit_id" in every.columns:
        columns["unit_id"] = own["imu_id"].alias("unit_id")
    if "sensor_unit_id" in every.columns:
        columns["sensor_unit_id"] = own["imu_id"].alias("sensor_unit_id")
    if "run_key" in every.columns:
        texts = np.array([keys.get(key, [""] * k) for key in of_one["run_key"].fill_null("").to_list()])
        columns["run_key"] = pl.Series("run_key", texts.T.ravel()).replace("", None)
    warm = own["warm"].to_numpy()
    for column in ("temperature_degc", "temperature_min_degc", "temperature_mean_degc", "temperature_max_degc"):
        if column in every.columns:
            columns[column] = pl.Series(column, warm)
    unit = np.tile(rng.normal(0.0, UNIT_SD, n), k)
    by_session = np.repeat(rng.normal(0.0, SESSION_SD, (k // OF_A_SESSION, n)), OF_A_SESSION, axis=0).ravel()
    off, error = unit + by_session + PER_DEGC * (warm - 25.0), rng.normal(0.0, 1.0, n * k)
    if name == "calibration":
        sd = every["sd"].to_numpy()
        columns["value"] = pl.Series("value", every["value"].to_numpy() + sd * (off + error), nan_to_null=True)
        columns["sd"] = pl.Series("sd", sd * rng.uniform(0.8, 1.25, n * k), nan_to_null=True)
    elif name == "information":
        columns["right_side"], columns["information"] = _equations(of_one, off.reshape(k, n), error.reshape(k, n), rng)
    else:
        for column, dtype in every.schema.items():
            if dtype == pl.Float64 and column not in columns:
                noise = 1.0 + 0.02 * rng.normal(0.0, 1.0, n * k)
                columns[column] = pl.Series(column, every[column].to_numpy() * noise, nan_to_null=True)
    for column in ("measured", "sums"):
        if column in every.columns:
            columns[column] = pl.Series(column, _texts(of_one[column].to_list(), k, rng))
    return every.with_columns(**columns).select(of_one.columns)


def _equations(
    of_one: pl.DataFrame, off: np.ndarray, error: np.ndarray, rng: np.random.Generator
) -> tuple[pl.Series, pl.Series]:
    """(right sides, rows of information) of k flights, which agree as far as they claim to, as those of real units
    mostly do. `off` (k, n): of the constants, in their sd; `error` (k, n): white, of what each flight says of
    them."""
    triangle, n = np.concatenate(of_one["information"].to_list()), of_one.height
    lower = np.zeros((n, n))
    lower[np.tril_indices(n)] = triangle
    information = lower + np.tril(lower, -1).T
    value, vector = np.linalg.eigh(information)
    sd = np.sqrt(np.diagonal(np.linalg.pinv(information, rcond=1e-12, hermitian=True)))
    right = off * sd @ information + error * np.sqrt(np.maximum(value, 0.0)) @ vector.T
    size = 1.0 + 1e-6 * rng.normal(0.0, 1.0, off.shape)
    row, column = np.tril_indices(n)
    several = triangle * size[:, row] * size[:, column]
    lists = pl.DataFrame({"row": np.add.outer(n * np.arange(len(off)), row).ravel(), "information": several.ravel()})
    rows = lists.group_by("row", maintain_order=True).agg("information")
    return pl.Series("right_side", right.ravel()), rows["information"]


def _texts(of_one: list[str | None], k: int, rng: np.random.Generator) -> list[str | None]:
    """Texts of k flights, each with decimals of its own."""
    whole = "\0".join("" if text is None else text for text in of_one).encode()
    places = np.array([i for found in DIGITS.finditer(whole) for i in range(*found.span(1))], dtype=np.int64)
    many = np.tile(np.frombuffer(whole, dtype=np.uint8), (k, 1))
    many[:, places] = rng.integers(ord("1"), ord("9") + 1, (k, len(places)), dtype=np.uint8)
    told = [text for row in many for text in row.tobytes().decode().split("\0")]
    return [None if of_one[i % len(of_one)] is None else text for i, text in enumerate(told)]


def write(root: Path, table: str, vehicle: str, rows: pl.DataFrame) -> None:
    """A table of a vehicle with its record, as publishing leaves them, without waiting for the disk."""
    path = history_path(root, table, vehicle)
    data = table_bytes(_sorted(table, rows), table)
    for place, content in (
        (path, data),
        (checksum_path(root, path), seal({"sha256": [hashlib.sha256(data).hexdigest()]})),
    ):
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_bytes(content)


def grow(root: Path, vehicles: int, workers: int, model: Path | None) -> None:
    """All vehicles that are not there yet."""
    prepare(root)
    with tempfile.TemporaryDirectory() as folder:
        rows = template(Path(folder)) if model is None else like(model)
    lacking = [n for n in range(vehicles) if not history_path(root, "calibration", f"uav-{n:04d}").exists()]
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        for done, _ in enumerate(pool.map(partial(grow_vehicle, root, rows), lacking, chunksize=10), 1):
            if done % 500 == 0:
                print(f"{done} vehicles", file=sys.stderr, flush=True)


def part(root: Path, smaller: Path, vehicles: int) -> None:
    """A root with the first vehicles of another."""
    prepare(smaller)
    for name in FLIGHT_TABLES:
        for number in range(vehicles):
            path = history_path(root, name, f"uav-{number:04d}")
            for one in (path, checksum_path(root, path)):
                if one.exists():
                    target = smaller / one.relative_to(root)
                    target.parent.mkdir(parents=True, exist_ok=True)
                    target.unlink(missing_ok=True)
                    os.link(one, target)


# --- what is asked


def new_session(root: Path) -> None:
    """A session of one vehicle more: its last one once more, later, with other numbers; not published yet is timed."""
    vehicle = sorted((root / "tables" / "flight").iterdir())[-1].name.partition("=")[2]
    later: dict[str, pl.DataFrame] = {}
    new = f"{time.time_ns() % 16**7:07x}"
    for name in FLIGHT_TABLES:
        path = history_path(root, name, vehicle)
        if not path.exists():
            continue
        rows = read_table(path, name)
        last = rows.filter(pl.col("session_id") == rows["session_id"].max())
        last = last.with_columns(
            flight_id=pl.col("flight_id").str.head(6) + new + pl.col("flight_id").str.tail(3),
            session_id=pl.col("session_id") + "x",
            started_at=pl.col("started_at") + pl.duration(days=9),
        )
        if name == "calibration":
            last = last.with_columns(value=pl.col("value") + 0.3 * pl.col("sd").fill_null(0.0))
        later[name] = last
    with timed("publish a session of one vehicle"):
        publish(root, vehicle, later, set(later["flight"]["flight_id"]))


def questions(root: Path) -> None:
    """The documentation's five, in SQL."""
    page = (Path(__file__).parents[1] / "docs/how-to/ask-the-history.md").read_text(encoding="utf-8")
    found = re.findall(r"<!-- question -->\n\*\*(.+?)\*\*\n\n```sql\n(.+?)```", page, re.DOTALL)
    warehouse = Warehouse(root)
    for question, sql in found:
        with timed(f"question: {question}"):
            warehouse.sql(sql.replace("sim-1", "uav-0042"), timeout_s=600, memory_mb=8000)


def latest(root: Path) -> None:
    with timed("latest_calibration of the fleet"):
        Warehouse(root).sql("SELECT count(*) FROM latest_calibration", timeout_s=600, memory_mb=8000)


def latest_of_one(root: Path) -> None:
    with timed("latest_calibration of one vehicle"):
        Warehouse(root).sql("FROM latest_calibration WHERE vehicle_id = 'uav-0042'", timeout_s=600, memory_mb=8000)


def drift(root: Path) -> None:
    from fieldcal.trends.drift_table import publish_drift

    publish_drift(root)


def pooled(root: Path) -> None:
    from fieldcal.trends.pooled.table import update_pooled

    update_pooled(root)


def site(root: Path) -> None:
    from fieldcal.report.fitness import Criteria
    from fieldcal.site import write_site

    write_site(root, Criteria())


def first(make: Callable[[Path], None], root: Path) -> None:
    with timed(f"{make.__name__}, nothing remembered"):
        make(root)


def again(make: Callable[[Path], None], root: Path) -> None:
    new_session(root)
    with timed(f"{make.__name__} after one session"):
        make(root)


def check(root: Path) -> None:
    from fieldcal.schemas import HISTORY_TABLES
    from fieldcal.warehouse.checksums import assure
    from fieldcal.warehouse.layout import history_files

    with timed("every byte held against its record"):
        assure(root, [path for table in HISTORY_TABLES for path in history_files(root, table)], strict=True)


def standing(root: Path) -> None:
    from fieldcal.report.fitness import Criteria, fleet_fitness
    from fieldcal.site.snapshot import Snapshot

    with timed("who is fine to fly"):
        fleet_fitness(Snapshot(root), Criteria(), datetime.now(UTC))


def plan(root: Path) -> None:
    """A night's look at an archive in which nothing is new: what it remembers of logs and flights, against both."""
    from fieldcal.batch.ledgers.flights import Ledger
    from fieldcal.batch.ledgers.logs import read_ledger
    from fieldcal.batch.plan import _known
    from fieldcal.config.configuration import parse

    configuration = parse("", None)
    subprocess.run([sys.executable, __file__, "line", str(root), "remembered"], check=True)
    with timed("a night's plan: what it remembers of logs"):
        read_ledger(root)
    with timed("a night's plan: which logs the history knows"):
        known, _ = _known(root, root / "no-archive")
    with timed("a night's plan: what it remembers of flights"):
        ledger = Ledger(root, configuration)
        for vehicle in sorted({str(uri).partition("/")[0] for uri in known.values()}):
            ledger._of_flights(vehicle)


def remembered(root: Path) -> None:
    """What a night would have left behind of all these flights."""
    places, flights = {}, {}
    for vehicle, flight_id, uri in (
        Warehouse(root).scan("flight").select("vehicle_id", "flight_id", "log_uri").collect().iter_rows()
    ):
        stamp = [6_000_000, 1_700_000_000_000_000_000, 1_700_000_000_000_000_000, 1234567]
        places[f"/data/logs/{uri}"] = [stamp, hashlib.sha256(flight_id.encode()).hexdigest()]
        entry = {"log_uri": uri, "flight_id": flight_id, "vehicle_id": vehicle, "session_id": uri.split("/")[1]}
        entry |= {"verdict": "ok", "reason_code": None, "reason": None, "findings": [], "refusals": []}
        entry |= {"stages_run": 0, "stages_cached": 20, "ran": {}}
        steps = [
            f"stages/step-{i:02d}/{flight_id}/{hashlib.md5(f'{flight_id}{i}'.encode()).hexdigest()}/run.json"
            for i in range(21)
        ]
        signals = [f"signals/{s}/vehicle_id={vehicle}/{flight_id}.parquet" for s in ("imu", "magnetometer", "vps")]
        digest = hashlib.sha256(uri.encode()).hexdigest()
        flights.setdefault(vehicle, {})[flight_id] = {
            "of": digest,
            "files": steps + signals,
            "as_they_were": digest,
            "entry": entry,
        }
    (root / "night").mkdir(exist_ok=True)
    (root / "night" / "logs.json").write_bytes(seal({"logs": places}))
    (root / "night" / "seen").mkdir(exist_ok=True)
    for vehicle, own in flights.items():
        (root / "night" / "seen" / f"{vehicle}.json").write_bytes(seal({"flights": own, "history": ""}))


LINES: dict[str, Callable[[Path], None]] = {
    **{one.__name__: one for one in (questions, latest, latest_of_one, check)},
    **{f"{make.__name__}_{how.__name__}": partial(how, make) for make in (drift, pooled) for how in (first, again)},
    **{one.__name__: one for one in (standing, plan)},
    **{f"{site.__name__}_{how.__name__}": partial(how, site) for how in (first, again)},
}


@contextmanager
def timed(what: str) -> Iterator[None]:
    """Say how long it took, elapsed and of the processor (of children that ended too), and the largest size of this
    process so far; SQL runs in another, whose size is limited."""
    began, cpu = time.perf_counter(), _cpu()
    yield
    told = {"what": what, "s": time.perf_counter() - began, "cpu_s": _cpu() - cpu, "gb": _peak_gb()}
    print(json.dumps(told), flush=True)


def _cpu() -> float:
    return sum(
        one.ru_utime + one.ru_stime for one in map(resource.getrusage, (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    )


def _peak_gb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9


def measure(root: Path, only: list[str]) -> None:
    """Every line in a process of its own."""
    print(f"{sizes(root)}\n")
    print(f"{'':60} {'s':>8} {'cpu s':>8} {'GB':>6}")
    for name in only or LINES:
        done = subprocess.run([sys.executable, __file__, "line", str(root), name], stdout=subprocess.PIPE, text=True)
        for line in done.stdout.splitlines():
            if line.startswith("{"):
                told = json.loads(line)
                print(f"{told['what'][:60]:60} {told['s']:8.1f} {told['cpu_s']:8.1f} {told['gb']:6.2f}", flush=True)
        if done.returncode:
            print(f"{name}: ended with {done.returncode}", flush=True)


def sizes(root: Path) -> str:
    """Bytes of the tables."""
    parts = []
    for folder in sorted((root / "tables").iterdir()):
        held = sum(path.stat().st_size for path in folder.rglob("*.parquet"))
        parts.append(f"{folder.name} {held / 1e6:.0f}")
    return "MB: " + ", ".join(parts)


def main() -> None:
    """One of the commands."""
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("command", choices=("grow", "part", "measure", "line"))
    arguments.add_argument("root", type=Path)
    arguments.add_argument("other", nargs="?")
    arguments.add_argument("--vehicles", type=int, default=5000)
    arguments.add_argument("--like", type=Path, help="a warehouse whose first flight is the model")
    arguments.add_argument("--workers", type=int, default=2)
    arguments.add_argument("--only", nargs="*", default=[])
    given = arguments.parse_args()
    root = given.root.absolute()
    if given.command == "grow":
        grow(root, given.vehicles, given.workers, given.like)
    elif given.command == "part":
        part(root, Path(given.other).absolute(), given.vehicles)
    elif given.command == "measure":
        measure(root, given.only)
    else:
        {**LINES, "remembered": remembered}[given.other](root)


if __name__ == "__main__":
    main()
