"""What the site costs: 1,000 flights of 50 vehicles, nothing new, one new flight; and flights with readings.

    python benchmarks/bench_site.py [--vehicles 50] [--flights 20] [--flown 20] [--root FOLDER]

The history is made of rows (`tests/report_rows.py`), so that its pages have no readings to draw. What readings add is
measured on `--flown` flights of three vehicles that are simulated and calibrated first, 40 s at 185 Hz each; the same
run tells what a night takes for a flight. Times are of the processor, of this process and its children.
"""

from __future__ import annotations

import argparse
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

sys.path.append(str(Path(__file__).parents[1] / "tests"))

from report_rows import publish_fleet

from fieldcal.batch.closing import close_night
from fieldcal.batch.flights import one_flight
from fieldcal.batch.night import plan_night, publishings
from fieldcal.config.configuration import Alerts
from fieldcal.report.fitness import Criteria
from fieldcal.simulation.archive import write_flights
from fieldcal.simulation.experiment import Experiment
from fieldcal.site import write_site
from fieldcal.warehouse import Warehouse
from fieldcal.warehouse.publish import publish

KINDS = ("step", "drifting", "outlier")
FOREVER = Criteria(Alerts(expires_days=1e5, idle_days=1e5))


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--vehicles", type=int, default=50)
    parser.add_argument("--flights", type=int, default=20)
    parser.add_argument("--flown", type=int, default=20)
    parser.add_argument("--root", type=Path)
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        root = asked.root or Path(folder) / "rows"
        kinds = {f"uav-{i:03d}": KINDS[i] if i < len(KINDS) else "stable" for i in range(asked.vehicles)}
        publish_fleet(root, kinds, n_flights=asked.flights)
        n = asked.vehicles * asked.flights
        print(f"{n} flights of {asked.vehicles} vehicles, made of rows")
        _written(root, "all of it", n)
        _written(root, "nothing new", n)
        _one_more(root)
        _written(root, "one new flight", n + 1)
        if asked.flown:
            print(f"{asked.flown} flights with readings")
            _flown(Path(folder), asked.flown)
    return 0


def _written(root: Path, what: str, flights: int) -> float:
    before = _stamps(root / "site")
    spent = _cpu_s(lambda: write_site(root, FOREVER))
    after = _stamps(root / "site")
    new = [name for name in after if before.get(name) != after[name]]
    size = sum((root / "site" / name).stat().st_size for name in new)
    whole = sum((root / "site" / name).stat().st_size for name in after)
    print(
        f"  {what:<15} {spent:6.2f} s ({1e3 * spent / flights:5.1f} ms a flight), {len(new):5d} files written of"
        f" {size / 1e6:6.2f} MB; the site has {len(after)} files, {whole / 1e6:.1f} MB"
    )
    return spent


def _one_more(root: Path) -> None:
    """The latest flight of the last vehicle once more, a day later, under another id."""
    warehouse = Warehouse(root)
    vehicle = warehouse.scan("flight").collect()["vehicle_id"].max()
    last = warehouse.scan("flight", vehicle_id=vehicle).sort("started_at").collect()["flight_id"][-1]
    parts = {}
    for table in ("flight", "calibration", "fit", "sync"):
        rows = warehouse.scan(table, vehicle_id=vehicle, flight_id=last).collect()
        moved = rows.with_columns(started_at=rows["started_at"].dt.offset_by("1d"))
        parts[table] = moved.with_columns(flight_id=moved["flight_id"].str.replace(".", "f", n=1))
    publish(root, vehicle, parts, [parts["flight"]["flight_id"][0]])


def _flown(folder: Path, flights: int) -> None:
    archive, root = folder / "archive", folder / "flown"
    vehicles = 3
    flown = Experiment(seed=1, dip_rad=np.radians(60.0), translation_rms_mps2=0.03)
    write_flights(archive, flown, vehicles=vehicles, sessions=1, flights=-(-flights // vehicles))
    night = plan_night(archive, root)
    jobs = night.missing()
    outcomes = []

    def calibrate() -> None:
        outcomes.extend(one_flight(root, job, night.configuration) for job in jobs)
        for publishing in publishings(night, outcomes):
            publishing.publish()

    calibrate_s = _cpu_s(calibrate)
    close_night(root, FOREVER)
    shutil.rmtree(root / "site")
    site_s = _written(root, "all of it", len(jobs))
    _written(root, "nothing new", len(jobs))
    held = sum(path.stat().st_size for part in ("tables", "signals", "stages") for path in (root / part).rglob("*"))
    print(
        f"  calibrating took {calibrate_s / len(jobs):.2f} s a flight, so the site {100 * site_s / calibrate_s:.1f} %"
    )
    print(f"  the warehouse itself has {held / 1e6:.1f} MB")


def _cpu_s(work: Callable[[], object]) -> float:
    before = sum(os.times()[:4])
    work()
    return sum(os.times()[:4]) - before


def _stamps(site: Path) -> dict[str, tuple[int, int]]:
    return {
        path.relative_to(site).as_posix(): (path.stat().st_ino, path.stat().st_mtime_ns)
        for path in site.rglob("*")
        if path.is_file()
    }


if __name__ == "__main__":
    began = time.perf_counter()
    status = main()
    print(f"{time.perf_counter() - began:.0f} s")
    raise SystemExit(status)
