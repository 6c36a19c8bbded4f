"""What orchestration costs: a night over simulated flights, and a second one with nothing to do.

    python benchmarks/bench_night.py [--workers 2] [--flights 200] [--archive FOLDER]

Orchestration is all of the wall time that is neither the stages' own work (reading input, computing, writing output;
summed over the workers and divided by their number) nor the start of Prefect (its import and its server).
"""

from __future__ import annotations

import argparse
import hashlib
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

REPOSITORY = Path(__file__).resolve().parent.parent
VEHICLES, SESSIONS = 3, 10


def simulate(archive: Path, flights: int) -> None:
    """Three vehicles, ten sessions, as many flights each as needed; those too many are removed."""
    from fieldcal.simulation.archive import write_flights
    from fieldcal.simulation.experiment import Experiment

    each = -(-flights // (VEHICLES * SESSIONS))
    logs = write_flights(archive, Experiment(seed=1), vehicles=VEHICLES, sessions=SESSIONS, flights=each)
    for log in sorted(logs)[flights:]:
        log.unlink()


def night(archive: Path, root: Path, workers: int) -> dict[str, Any]:
    """Run `fieldcal nightly`; its JSON, with the wall time of the whole command."""
    began = time.monotonic()
    command = ["nightly", str(archive), "--warehouse", str(root), "--workers", str(workers), "--json"]
    told = subprocess.run(
        [sys.executable, "-m", "fieldcal", *command], cwd=REPOSITORY, capture_output=True, text=True, check=True
    )
    return {**json.loads(told.stdout), "wall": time.monotonic() - began}


def tables(root: Path) -> str:
    """One hash of every byte of the history."""
    digest = hashlib.sha256()
    for path in sorted((root / "tables").rglob("*.parquet")):
        digest.update(path.read_bytes())
    return digest.hexdigest()


def main() -> None:
    """Both nights."""
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--workers", type=int, default=2)
    arguments.add_argument("--flights", type=int, default=200)
    arguments.add_argument("--archive", type=Path)
    given = arguments.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        archive = given.archive or Path(folder) / "archive"
        if not archive.is_dir():
            simulate(archive, given.flights)
        root = Path(folder) / "warehouse"
        first = night(archive, root, given.workers)
        before = tables(root)
        time.sleep(5.0)  # so that the second night starts its server itself
        second = night(archive, root, given.workers)

        work = first["stage_seconds"] / given.workers
        rest = first["wall"] - first["server_seconds"] - work
        print(f"first night: {len(first['logs'])} logs, {first['stages_run']} stages, {first['wall']:.1f} s")
        print(f"  stages' own work {work:.1f} s on each of {given.workers}, server {first['server_seconds']:.1f} s")
        print(f"  orchestration {rest:.1f} s: {100 * rest / first['wall']:.1f} % of the wall time")
        beyond = second["wall"] - second["server_seconds"]
        print(f"second night: {second['stages_run']} stages, {second['wall']:.1f} s")
        print(f"  beyond the server's start {beyond:.1f} s: {100 * beyond / first['wall']:.1f} % of the first")
        print(f"  tables/ {'unchanged' if tables(root) == before else 'CHANGED'}")


if __name__ == "__main__":
    main()
