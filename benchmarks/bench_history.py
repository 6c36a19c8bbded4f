"""Asking a history of 100,000 flights: one vehicle's drift, the whole fleet's latest calibration, in SQL and polars.

    python benchmarks/bench_history.py [--flights 100000] [--vehicles 500] [--root FOLDER] [--check]

The history is generated (36 calibration rows a flight, seeded) and written through the warehouse's own code. Best of
five, a new connection for every SQL query. `--check` measures instead what it costs that every byte is held against its
recorded sha256 first: the whole fleet's calibration with and without, from the disk and from the page cache, in a new
process and in one that has read before.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import polars as pl

from fieldcal import schemas
from fieldcal.warehouse import Warehouse
from fieldcal.warehouse.publish import publish

SEED = 20260511
START = datetime(2025, 1, 1, tzinfo=UTC)
SENSORS = {
    "magnetometer": ("ellipsoid_robust", "norm"),
    "accelerometer": ("ellipsoid_robust", "m/s^2"),
    "gyroscope": ("output_error", "rad/s"),
}
PARAMETERS = ("scale", "bias", "zero", "zero_bias")
SLOPE_PER_DEGC = 2e-5
SCATTER = 3e-4

DRIFT_SQL = """
    SELECT axis, count(*) AS n, regr_slope(value, temperature_degc) AS slope_per_degc, avg(value) AS mean
    FROM calibration
    WHERE vehicle_id = 'uav-0042' AND sensor = 'gyroscope' AND parameter = 'zero_bias' AND status = 'ok'
    GROUP BY axis ORDER BY axis
"""
LATEST_SQL = "SELECT vehicle_id, sensor, parameter, axis, value_at_25degc, sd FROM latest_calibration"


def drift_polars(warehouse: Warehouse) -> pl.DataFrame:
    """Slope against temperature of one vehicle's gyroscope."""
    t, v = pl.col("temperature_degc"), pl.col("value")
    return (
        warehouse.scan("calibration", vehicle_id="uav-0042")
        .filter(sensor="gyroscope", parameter="zero_bias", status="ok")
        .group_by("axis")
        .agg(pl.len().alias("n"), (pl.cov(v, t) / t.var()).alias("slope_per_degc"), v.mean().alias("mean"))
        .sort("axis")
        .collect()
    )


def latest_polars(warehouse: Warehouse) -> pl.DataFrame:
    """The latest good value of every parameter of every IMU."""
    key = ["unit_id", "sensor", "method", "parameter", "axis"]
    return (
        warehouse.scan("calibration")
        .filter(status="ok")
        .group_by(key)
        .agg(pl.col("vehicle_id", "value", "sd", "temperature_degc", "started_at").sort_by("started_at").last())
        .collect()
    )


def generate(root: Path, flights: int, vehicles: int) -> None:
    """Histories of a fleet whose zero biases go linearly with temperature."""
    rng = np.random.default_rng(SEED)
    each = flights // vehicles
    for number in range(vehicles):
        vehicle = f"uav-{number:04d}"
        ids = [f"{number:08x}{i:08x}" for i in range(each)]
        lead = pl.DataFrame(
            {
                "flight_id": ids,
                "vehicle_id": vehicle,
                "imu_id": f"imu-{number:04d}",
                "unit_id": f"imu-{number:04d}",
                "is_primary": True,
                "session_id": [f"session-{i // 5:03d}" for i in range(each)],
                "started_at": [START.timestamp() + 86_400.0 * (i // 5) + 3_600.0 * (i % 5) for i in range(each)],
                "temperature_degc": rng.uniform(-10.0, 45.0, each),
            }
        ).with_columns(pl.from_epoch((pl.col("started_at") * 1e6).cast(pl.Int64), "us").dt.replace_time_zone("UTC"))
        publish(root, vehicle, {"flight": _flights(lead), "calibration": _calibration(lead, rng)}, ids)


def _flights(lead: pl.DataFrame) -> pl.DataFrame:
    return _as_table(
        lead.with_columns(
            log_uri=pl.format("{}/{}/{}.mcap", "vehicle_id", "session_id", "flight_id"),
            verdict=pl.lit("ok"),
            duration_s=pl.lit(40.0),
            verifiable=pl.lit(True),
        ),
        "flight",
    )


def _calibration(lead: pl.DataFrame, rng: np.random.Generator) -> pl.DataFrame:
    parts = []
    for sensor, (method, unit) in SENSORS.items():
        for parameter in PARAMETERS:
            for axis in "xyz":
                value = SLOPE_PER_DEGC * (lead["temperature_degc"] - 25.0) + rng.normal(0.0, SCATTER, len(lead))
                parts.append(
                    lead.with_columns(
                        pl.lit(sensor).alias("sensor"),
                        pl.lit(method).alias("method"),
                        pl.lit(parameter).alias("parameter"),
                        pl.lit(axis).alias("axis"),
                        pl.lit(unit).alias("unit"),
                        pl.lit("ok").alias("status"),
                        pl.lit("0" * 32).alias("run_key"),
                        pl.Series("value", value),
                        pl.Series("sd", np.full(len(lead), SCATTER)),
                    )
                )
    return _as_table(pl.concat(parts), "calibration")


def _as_table(rows: pl.DataFrame, table: str) -> pl.DataFrame:
    empty = pl.from_arrow(schemas.arrow_schema(table).empty_table())
    assert isinstance(empty, pl.DataFrame)
    lacking = [pl.lit(None, dtype).alias(name) for name, dtype in empty.schema.items() if name not in rows.columns]
    return rows.with_columns(lacking).select(pl.col(name).cast(dtype) for name, dtype in empty.schema.items())


def best(question: Callable[[], pl.DataFrame], rounds: int = 5) -> tuple[float, pl.DataFrame]:
    """Shortest time of several, and the answer."""
    times = []
    for _ in range(rounds):
        began = time.perf_counter()
        answer = question()
        times.append(time.perf_counter() - began)
    return min(times), answer


WHOLE_SCAN = """
import sys, time
from fieldcal.warehouse import Warehouse, query
if sys.argv[2] == "unchecked":
    query.assure = lambda root, files: None
for _ in range(2):
    began = time.perf_counter()
    Warehouse(sys.argv[1]).scan("calibration").collect()
    print(time.perf_counter() - began)
"""
"""Seconds of the first scan of a process, and of the second."""


def cost_of_check(root: Path, rounds: int = 15) -> None:
    """Shortest times, the two forms taking turns."""
    files = [path for part in ("tables", "checksums") for path in (root / part).rglob("*") if path.is_file()]
    os.sync()
    for cold in (True, False):
        times: dict[str, list[list[float]]] = {"checked": [], "unchecked": []}
        for _ in range(rounds):
            for form, found in times.items():
                if cold:
                    _forget(files)
                program = [sys.executable, "-c", WHOLE_SCAN, str(root), form]
                told = subprocess.run(program, check=True, capture_output=True, text=True).stdout
                found.append([float(line) for line in told.split()])
        for number, which in enumerate(("first", "second")):
            checked, unchecked = (min(each[number] for each in times[form]) for form in times)
            where = "files on disk" if cold and not number else "files in the page cache"
            share = 100.0 * (checked - unchecked) / unchecked
            scan = f"{which} scan of a process, {where}"
            print(f"{scan}: {checked * 1e3:.0f} ms, unchecked {unchecked * 1e3:.0f} ms, {share:+.0f} %")


def _forget(files: list[Path]) -> None:
    """Take files out of the page cache."""
    for path in files:
        with path.open("rb") as file:
            os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)


def main() -> None:
    """Generate and ask."""
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--flights", type=int, default=100_000)
    arguments.add_argument("--vehicles", type=int, default=500)
    arguments.add_argument("--root", type=Path)
    arguments.add_argument("--check", action="store_true")
    given = arguments.parse_args()
    root = given.root or Path(tempfile.mkdtemp(prefix="fieldcal-history-"))
    if not (root / "tables").is_dir():
        generate(root, given.flights, given.vehicles)
    size = sum(path.stat().st_size for path in (root / "tables").rglob("*.parquet"))
    rows = Warehouse(root).scan("calibration").select(pl.len()).collect().item()
    print(f"{given.flights} flights, {given.vehicles} vehicles, {rows / 1e6:.1f} million rows, {size / 1e6:.0f} MB")
    if given.check:
        cost_of_check(root)
    else:
        ask(Warehouse(root))
    if given.root is None:
        shutil.rmtree(root)


def ask(warehouse: Warehouse) -> None:
    """Time the questions."""
    questions: dict[str, Callable[[], pl.DataFrame]] = {
        "drift of one vehicle, polars": lambda: drift_polars(warehouse),
        "drift of one vehicle, SQL": lambda: warehouse.sql(DRIFT_SQL),
        "latest calibration of the fleet, polars": lambda: latest_polars(warehouse),
        "latest calibration of the fleet, SQL view": lambda: warehouse.sql(LATEST_SQL),
    }
    answers = {}
    for name, question in questions.items():
        seconds, answers[name] = best(question)
        print(f"{name}: {seconds * 1e3:.0f} ms, {answers[name].height} rows")
    polars, sql = (answers[f"drift of one vehicle, {engine}"] for engine in ("polars", "SQL"))
    assert np.allclose(polars["slope_per_degc"], sql["slope_per_degc"]), "both engines must say the same"


if __name__ == "__main__":
    main()
