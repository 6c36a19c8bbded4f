"""The VPS clock against the IMU's in the joint method, over simulated flights: errors, and whether the sd are honest.

    python benchmarks/joint_sync.py [--flights 32] [--first-seed 1000] [--case translation …]

Prints one Markdown table: for each case the absolute error of the lag at mid-flight, ms, and of the skew, ppm (median /
95th percentile / rms over flights), and the rms of error ÷ stated sd of that lag and of the skew.
The lever arm is unknown to the estimate, translation is 0.3 m/s² rms.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import polars as pl
from joint_accuracy import CASES as ALL
from joint_accuracy import flights_of

from fieldcal.simulation.archive import settings, signals
from fieldcal.simulation.experiment import SimulatedFlight, simulate
from fieldcal.stages.pipeline import run_flight

CASES = {
    "no translation": ALL["clean"],
    "translation": ALL["translation"],
    "translation; dropouts, outliers, 200 ppm, misaligned": ALL["vps"],
    "the same, VPS at 100 Hz": replace(ALL["vps"], vps_rate_hz=100.0),
}


def errors(r: SimulatedFlight) -> tuple[float, float, float, float] | None:
    """Lag at mid-flight, s; skew, ppm; both ÷ sd. None where it was refused."""
    results = run_flight(signals(r), settings(r.experiment, method="joint", lever_arm_m=None))
    sync: pl.DataFrame | None = results["vps_sync"].tables.get("sync")
    if sync is None or sync["status"][0] != "ok":
        return None
    row = sync.row(0, named=True)
    middle = row["lag_mid_s"] - r.lag_at(0.5 * float(r.t[0] + r.t[-1]))
    skew = row["skew_ppm"] - r.experiment.vps_skew_ppm
    return middle, skew, middle / row["lag_sd_s"], skew / row["skew_sd_ppm"]


def cell(x: np.ndarray) -> str:
    """Median / 95th percentile / rms of the absolute values."""
    size = np.abs(x)
    return f"{np.median(size):.3g} / {np.percentile(size, 95):.3g} / {np.sqrt(np.mean(size**2)):.3g}"


def main() -> None:
    given = flights_of(__doc__, CASES).parse_args()
    print(f"{given.flights} flights, seeds from {given.first_seed}; median / 95th percentile / rms\n")
    print("| case | refused | lag at mid-flight, ms | skew, ppm | lag error ÷ sd, rms | skew error ÷ sd, rms |")
    print("|---|---|---|---|---|---|")
    for case in given.case or list(CASES):
        seeds = range(given.first_seed, given.first_seed + given.flights)
        found = [errors(simulate(CASES[case], seed=seed)) for seed in seeds]
        lag, skew, lag_z, skew_z = np.array([f for f in found if f is not None]).T
        honest = (float(np.sqrt(np.mean(z**2))) for z in (lag_z, skew_z))
        print(
            f"| {case} | {found.count(None)} | {cell(1e3 * lag)} | {cell(skew)} | "
            + " | ".join(f"{h:.2f}" for h in honest)
            + " |",
            flush=True,
        )


if __name__ == "__main__":
    main()
