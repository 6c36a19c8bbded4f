"""Nights over simulated archives of several sizes: what grows with the flights, and by how much.

    python benchmarks/bench_night.py [--flights 100 300 1000] [--workers 2] [--duration 40] [--no-vps] [--keep FOLDER]

For each size a first night and a second one with nothing to do. Wall time of the whole command; processor time of all
its processes; the largest process; orchestration, which is all of the wall time that is neither the stages' own work
(reading, computing, writing; summed over the workers and divided by their number) nor the start of Prefect; what the
second night takes beyond the server's start; the warehouse beside the logs. Flights of 2 s are refused at once: what is
left is what a night costs beside its mathematics.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

REPOSITORY = Path(__file__).resolve().parent.parent
FLIGHTS_OF_A_VEHICLE, FLIGHTS_OF_A_SESSION = 20, 2
LOOK_EVERY_S = 0.5


@dataclass(frozen=True)
class Night:
    """What `fieldcal nightly` told, and what it took."""

    told: dict[str, Any]
    wall_s: float
    cpu_s: float
    largest_mb: float


def simulate(archive: Path, flights: int, duration_s: float, *, vps: bool, workers: int) -> None:
    """Vehicles of 20 flights in 10 sessions; those too many are removed."""
    from fieldcal.simulation.archive import write_flights
    from fieldcal.simulation.experiment import Experiment

    vehicles = -(-flights // FLIGHTS_OF_A_VEHICLE)
    flown = Experiment(seed=1, duration_s=duration_s, dip_rad=1.05, translation_rms_mps2=0.1, vps=vps)
    sessions = FLIGHTS_OF_A_VEHICLE // FLIGHTS_OF_A_SESSION
    logs = write_flights(
        archive, flown, vehicles=vehicles, sessions=sessions, flights=FLIGHTS_OF_A_SESSION, workers=workers
    )
    for log in sorted(logs)[flights:]:
        log.unlink()


def night(archive: Path, root: Path, workers: int) -> Night:
    """Run the command."""
    command = ["nightly", str(archive), "--warehouse", str(root), "--workers", str(workers), "--json"]
    before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
    with subprocess.Popen(
        [sys.executable, "-m", "fieldcal", *command], cwd=REPOSITORY, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
    ) as running:
        assert running.stdout is not None
        largest = 0.0
        while True:
            try:
                out, _ = running.communicate(timeout=LOOK_EVERY_S)
                break
            except subprocess.TimeoutExpired:
                largest = max(largest, _largest_mb(running.pid))
    wall, after = time.monotonic() - began, resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return Night(json.loads(out), wall, cpu, largest)


def _largest_mb(first: int) -> float:
    """Resident memory of the largest process among `first` and all that it started."""
    parents, held = {}, {}
    for place in Path("/proc").glob("[0-9]*/status"):
        try:
            fields = dict(line.split(":", 1) for line in place.read_text().splitlines() if ":" in line)
        except OSError:  # it has ended
            continue
        parents[int(fields["Pid"])] = int(fields["PPid"])
        held[int(fields["Pid"])] = int(fields.get("VmRSS", "0").split()[0]) / 1e3
    family, size = {first}, 0
    while size < len(family):
        size = len(family)
        family |= {pid for pid, parent in parents.items() if parent in family}
    return max((held.get(pid, 0.0) for pid in family), default=0.0)


def tables(root: Path) -> str:
    """One hash of every byte of the history."""
    digest = hashlib.sha256()
    for path in sorted((root / "tables").rglob("*.parquet")):
        digest.update(path.read_bytes())
    return digest.hexdigest()


def size_mb(files: Iterable[Path]) -> float:
    return sum(path.stat().st_size for path in files if path.is_file()) / 1e6


def both_nights(folder: Path, flights: int, given: argparse.Namespace) -> None:
    archive, root = folder / f"archive-{flights}", folder / f"warehouse-{flights}"
    if not archive.is_dir():
        simulate(archive, flights, given.duration, vps=not given.no_vps, workers=given.workers)
    first = night(archive, root, given.workers)
    before = tables(root)
    time.sleep(5.0)  # so that the second night starts its server itself
    second = night(archive, root, given.workers)
    work = first.told["stage_seconds"] / given.workers
    rest = first.wall_s - first.told["server_seconds"] - work
    kept, logs = size_mb(root.rglob("*")), size_mb(archive.rglob("*.mcap"))
    print(
        f"{flights:>8} {first.wall_s:>9.1f} {first.cpu_s:>8.1f} {1e3 * first.cpu_s / flights:>13.0f}"
        f" {100 * rest / first.wall_s:>13.1f} {first.largest_mb:>11.0f}"
        f" {second.wall_s - second.told['server_seconds']:>14.2f} {kept / flights:>12.3f} {100 * kept / logs:>9.0f}",
        flush=True,
    )
    if second.told["stages_run"] or tables(root) != before:
        print(f"         THE SECOND NIGHT RAN {second.told['stages_run']} STAGES, OR CHANGED TABLES")


def main() -> None:
    """A line for each size."""
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("--flights", type=int, nargs="+", default=[100, 300, 1000])
    arguments.add_argument("--workers", type=int, default=2)
    arguments.add_argument("--duration", type=float, default=40.0)
    arguments.add_argument("--no-vps", action="store_true")
    arguments.add_argument(
        "--keep", type=Path, help="folder for archives and warehouses, which stay; archives there are taken"
    )
    given = arguments.parse_args()
    print(
        f"{'flights':>8} {'night, s':>9} {'CPU, s':>8} {'ms a flight':>13} {'orchestr., %':>13} {'largest, MB':>11}"
        f" {'second night, s':>14} {'MB a flight':>12} {'% of logs':>9}"
    )
    with tempfile.TemporaryDirectory() as folder:
        for flights in given.flights:
            both_nights(given.keep or Path(folder), flights, given)


if __name__ == "__main__":
    main()
