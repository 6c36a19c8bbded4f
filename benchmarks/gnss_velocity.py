"""What a receiver's velocity tells of an ordinary flight, and whether its sd are honest; the same flights without it.

    python benchmarks/gnss_velocity.py [--flights 40] [--first-seed 1000] [--case lively …] [--without]

One Markdown table: for every case and constant how many of its rows were published (three axes a flight), their error
÷ sd, rms and beyond 3 sd, and their median sd in mg, °/s, % and 1/1000 of the field; then the lag, s, and the
antenna arm, m. Flights last 120 s; lag, arm and constants are drawn by the seed (`fieldcal.ordinary_flight`).
`--without` runs the same flights without the velocity too, which takes several times as long.
"""

from __future__ import annotations

import argparse
import os
from collections import defaultdict
from concurrent.futures import ProcessPoolExecutor
from functools import partial

import numpy as np
import polars as pl

from fieldcal.names import Status
from fieldcal.simulation.archive import settings, signals, truth
from fieldcal.simulation.experiment import simulate
from fieldcal.simulation.ordinary import ordinary_flight
from fieldcal.stages.pipeline import run_flight
from fieldcal.stages.tables import AXES

PAPERS = {"magnetometer": 34.043e-6, "accelerometer": 2.4594e-3, "gyroscope": 0.0183}
CASES: dict[str, tuple[str, dict[str, object]]] = {
    "lively": ("lively", {}),
    "mission": ("mission", {}),
    "hover": ("hover", {}),
    "fixed wing": ("fixed_wing", {}),
    "mission, errors coloured over 2 s": ("mission", {"gnss_colour": 0.7}),
    "lively, errors coloured over 2 s": ("lively", {"gnss_colour": 0.7}),
    "lively, 3 % outliers": ("lively", {"gnss_outlier_share": 0.03}),
    "mission, the paper's gyroscope": ("mission", {"noise_variance": PAPERS}),
}
SHOWN = {  # unit of the median sd
    ("accelerometer", "zero"): ("mg", 1e3 / 9.80665),
    ("accelerometer", "scale"): ("%", 100.0),
    ("gyroscope", "zero"): ("°/s", 180.0 / np.pi),
    ("gyroscope", "scale"): ("%", 100.0),
    ("magnetometer", "zero"): ("‰", 1000.0),
    ("magnetometer", "scale"): ("%", 100.0),
    ("accelerometer", "gnss_lag"): ("s", 1.0),
    ("accelerometer", "gnss_lever_arm"): ("m", 1.0),
}
Found = dict[tuple[str, str, str], tuple[float, float] | None]
"""Sensor, parameter, axis → error and sd; None where it is refused."""


def flight(seed: int, case: str, use_velocity: bool) -> Found:
    """Every constant of one flight, by the method that counts."""
    motion, changes = CASES[case]
    recording = simulate(ordinary_flight(motion, seed, **changes))
    own = settings(recording.experiment, method="auto", use_velocity=use_velocity)
    table = run_flight(signals(recording), own)["composition"].tables.get("calibration")
    true = truth(recording)
    out: Found = {}
    rows = [] if table is None else table.filter(status=str(Status.OK)).iter_rows(named=True)
    published = {(row["sensor"], row["parameter"], row["axis"]): (row["value"], row["sd"]) for row in rows}
    for sensor, parameter in SHOWN:
        for i, axis in enumerate([""] if parameter == "gnss_lag" else AXES):
            found = published.get((sensor, parameter, axis))
            if parameter == "gnss_lag":
                expected = true["gnss_lag_s"]
            elif parameter == "gnss_lever_arm":
                expected = (true["gnss_lever_arm_m"] or [0.0] * 3)[i]
            else:
                expected = true["constants"][sensor][parameter][i]  # type: ignore[literal-required]
            out[sensor, parameter, axis] = None if found is None else (found[0] - (expected or 0.0), found[1])
    return out


def told(found: list[Found], sensor: str, parameter: str) -> list[str]:
    """Cells: published of all, error ÷ sd rms, beyond 3 sd, median sd; axes apart where they differ."""
    names = [name for name in found[0] if name[:2] == (sensor, parameter)]
    each = {name[2]: [row[name] for row in found] for name in names}
    known = {axis: np.array([v for v in values if v is not None]) for axis, values in each.items()}
    share = " ".join(f"{len(known[axis])}" for axis in each)
    whole = np.concatenate([v for v in known.values() if len(v)]) if any(len(v) for v in known.values()) else None
    if whole is None:
        return [f"{share} of {len(found)}", "–", "–", "–"]
    ratio = whole[:, 0] / whole[:, 1]
    unit, factor = SHOWN[sensor, parameter]
    sd = " ".join(f"{factor * np.median(v[:, 1]):.2g}" if len(v) else "–" for v in known.values())
    return [
        f"{share} of {len(found)}",
        f"{np.sqrt(np.mean(ratio**2)):.2f}",
        f"{100 * np.mean(np.abs(ratio) > 3):.1f} %",
        f"{sd} {unit}",
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--flights", type=int, default=40)
    parser.add_argument("--first-seed", type=int, default=1000)
    parser.add_argument("--case", action="append", choices=list(CASES))
    parser.add_argument("--without", action="store_true")
    parser.add_argument("--workers", type=int, default=max(1, (os.cpu_count() or 2) // 2))
    given = parser.parse_args()
    pl.Config.set_tbl_rows(-1)
    seeds = range(given.first_seed, given.first_seed + given.flights)
    print("| case | velocity | constant | published x y z | error ÷ sd | beyond 3 sd | median sd x y z |")
    print("|---|---|---|---|---|---|---|")
    with ProcessPoolExecutor(given.workers) as pool:
        for case in given.case or list(CASES):
            for use_velocity in (True, False) if given.without else (True,):
                found = list(pool.map(partial(flight, case=case, use_velocity=use_velocity), seeds))
                by_parameter: dict[tuple[str, str], list[str]] = defaultdict(list)
                for sensor, parameter in SHOWN:
                    if use_velocity or not parameter.startswith("gnss"):
                        by_parameter[sensor, parameter] = told(found, sensor, parameter)
                for (sensor, parameter), cells in by_parameter.items():
                    name = parameter if parameter.startswith("gnss") else f"{sensor} {parameter}"
                    shown = "yes" if use_velocity else "no"
                    print(f"| {case} | {shown} | {name} | " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
