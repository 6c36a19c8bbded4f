"""The joint estimator beside the serial method over simulated flights: errors, honesty, lag, speed.

    python benchmarks/joint_accuracy.py [--flights 32] [--first-seed 1000] [--case clean --case translation …]
    python benchmarks/joint_accuracy.py --speed

Prints one Markdown table: for every case and quantity the median / 95th percentile over flights. Scale errors are the
rms of three axes, per cent; attitude is the rms angle, degrees, against the truth delayed by the sensor filter; "zero"
is what the calibrated triad reads at the true zero; "beyond 3 sd" is the share of the 18 scales and zero offsets of
accepted triads. The lever arm is unknown to both methods. `--speed` times the joint fit at 40 s, 10 min and 1 h,
with its memory.
"""

from __future__ import annotations

import argparse
import time
import tracemalloc
from collections import defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import polars as pl

from fieldcal.estimation.joint import initialise
from fieldcal.estimation.joint.fit import JointFit, fit_joint
from fieldcal.estimation.joint.problem import Readings
from fieldcal.geometry.rotation import angle_between
from fieldcal.names import SENSORS
from fieldcal.simulation.archive import settings, signals
from fieldcal.simulation.experiment import Experiment, SimulatedFlight, constants_at, simulate
from fieldcal.stages.pipeline import run_flight
from fieldcal.stages.results import StageResult
from fieldcal.stages.tables import AXES, QUATERNION, constants, matrix

MOVING = Experiment(translation_rms_mps2=0.3, lever_arm_m=(0.05, 0.02, -0.03))
STEEP = replace(MOVING, dip_rad=float(np.radians(65.0)))
CASES = {
    "clean": Experiment(),
    "translation": MOVING,
    "translation, 65° dip": STEEP,
    "hard": replace(STEEP, magnetic_bursts=4, gyro_random_walk=0.002, lost_share=0.01),
    "vps": replace(MOVING, vps_dropout_share=0.1, vps_outlier_share=0.01, vps_skew_ppm=200.0, vps_misalignment_rad=0.1),
}
SOURCES = {
    "serial": {"magnetometer": "magnetometer", "accelerometer": "accelerometer_pass2", "gyroscope": "gyro_output"},
    "joint": dict.fromkeys(SENSORS, "joint"),
}
ROW_METHOD = {"serial": {"gyroscope": "output_error"}, "joint": dict.fromkeys(SENSORS, "joint")}
Figures = dict[str, list[float]]


def measure(recording: SimulatedFlight, method: str, **changes: Any) -> Iterator[tuple[str, float]]:
    """(quantity, error) of one flight; "refused …" counts. `changes` replace parameters."""
    own = settings(recording.experiment, **{"method": method, "lever_arm_m": None, "use_vps": False, **changes})
    results = run_flight(signals(recording), own)
    squares, beyond = [], []
    for name in SENSORS:
        rows = _rows(results, method, name)
        if rows is None:
            yield f"refused {name}", 1.0
            continue
        scale, bias = (np.asarray(v) for v in constants_at(recording.experiment, name, 25.0))
        value = {p: rows.filter(parameter=p)["value"].to_numpy() for p in ("scale", "bias", "zero")}
        sd = {p: rows.filter(parameter=p)["sd"].to_numpy() for p in ("scale", "zero")}
        yield f"scale {name}", 100.0 * _rms(value["scale"] / scale - 1.0)
        zero = -bias / scale
        yield f"zero {name}", _rms(value["scale"] * zero + value["bias"])
        normal = (value["scale"] - scale) / sd["scale"]
        squares += list(normal**2)
        beyond += list(np.abs(normal) > 3.0) + list(np.abs(value["zero"] - zero) > 3.0 * sd["zero"])
        yield f"refused {name}", 0.0
    if len(squares) == 9:
        yield "nees", float(np.mean(squares))
    if beyond:
        yield "beyond 3 sd", float(np.mean(beyond))
    attitude = results["joint" if method == "joint" else "attitude_pass2"].tables.get("attitude")
    if attitude is not None:
        index = np.searchsorted(np.rint(recording.t * 1e9), attitude["t_ns"].to_numpy())
        yield "attitude", float(np.degrees(_rms(angle_between(matrix(attitude, QUATERNION), recording.q[index]))))
    yield from _against_vps(recording, results, method)


def _rows(results: dict[str, StageResult], method: str, name: str) -> pl.DataFrame | None:
    """Accepted rows of a sensor, or None."""
    rows = results[SOURCES[method][name]].tables.get("calibration")
    if rows is None:
        return None
    rows = rows.filter(pl.col("sensor") == name, pl.col("axis").is_in(AXES))
    if name in ROW_METHOD[method]:
        rows = rows.filter(pl.col("method") == ROW_METHOD[method][name])
    return None if rows.is_empty() or (rows["status"] != "ok").any() else rows


def _against_vps(
    recording: SimulatedFlight, results: dict[str, StageResult], method: str
) -> Iterator[tuple[str, float]]:
    sync = results["vps_sync"].tables.get("sync")
    if sync is not None and sync["status"][0] == "ok":
        middle = 0.5 * float(recording.t[0] + recording.t[-1])
        yield "lag", 1e3 * abs(float(sync["lag_mid_s"][0]) - recording.lag_at(middle))
        yield "skew error ppm", abs(float(sync["skew_ppm"][0]) - recording.experiment.vps_skew_ppm)
    fit = results["verify"].tables.get("fit")
    if fit is not None:
        own = "joint" if method == "joint" else "output_error"
        row = fit.filter(quantity="body_rate", method=own, reference="vps", signal="smoothed", sample="all")
        if len(row):
            yield "TIC body rate", float(row["tic"][0])


def _rms(x: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(x))))


def study(case: str, flights: int, first_seed: int) -> dict[str, Figures]:
    """Both methods over the same flights."""
    out: dict[str, Figures] = {method: defaultdict(list) for method in SOURCES}
    for seed in range(first_seed, first_seed + flights):
        recording = simulate(CASES[case], seed=seed)
        for method, figures in out.items():
            for quantity, value in measure(recording, method):
                figures[quantity].append(value)
    return out


def print_table(case: str, figures: dict[str, Figures]) -> None:
    quantities = [*dict.fromkeys(q for f in figures.values() for q in f)]
    for quantity in quantities:
        cells = []
        for method in SOURCES:
            values = figures[method].get(quantity, [])
            if quantity.startswith("refused"):
                cells.append(f"{int(sum(values))} of {len(values)}")
            elif quantity == "beyond 3 sd":
                cells.append(f"{100 * np.mean(values):.1f} %" if values else "–")
            else:
                cells.append(f"{np.median(values):.4g} / {np.percentile(values, 95):.4g}" if values else "–")
        print(f"| {case} | {quantity} | " + " | ".join(cells) + " |", flush=True)


def speed() -> None:
    """Process time of start and fit, and the most that its arrays take beside the recording."""
    print("| flight | joint fit, s | iterations | per minute of flight, s | memory, MB |\n|---|---|---|---|---|")
    for duration_s, sets, repeats in ((40.0, 3, 9), (600.0, 45, 2), (3600.0, 270, 1)):
        r = simulate(duration_s=duration_s, sets=sets, seed=1, vps=False)
        results = run_flight(signals(r), settings(r.experiment)) if duration_s < 100 else None
        best, iterations = np.inf, 0
        for _ in range(repeats):
            began = time.process_time()
            iterations = _fit_alone(r, results).iterations
            best = min(best, time.process_time() - began)
        tracemalloc.start()
        _fit_alone(r, results)
        memory = tracemalloc.get_traced_memory()[1] / 2**20
        tracemalloc.stop()
        cells = f"{duration_s:.0f} s | {best:.2f} | {iterations} | {best / duration_s * 60:.2f} | {memory:.0f}"
        print(f"| {cells} |", flush=True)


def _fit_alone(r: SimulatedFlight, results: dict[str, StageResult] | None) -> JointFit:
    """Start and fit of a recording, from the serial result where there is one."""
    segment = np.zeros(len(r.t), dtype=np.int64)
    readings = Readings(
        t=r.t,
        segment=segment,
        **r.counts,
        gravity_mps2=r.experiment.gravity_mps2,
        field_ned=np.array([1.0, 0.0, 0.0]),
        turning=initialise.turning(r.t, segment, r.counts["gyroscope"]),
    )
    return fit_joint(*initialise.prepare(readings, _start(r, readings, results)))


def _start(
    r: SimulatedFlight, readings: Readings, results: dict[str, StageResult] | None
) -> dict[str, initialise.Constants]:
    """The serial result where there is one, else the estimator's own start."""
    if results is not None:
        tables = {name: results[SOURCES["serial"][name]].tables["calibration"] for name in SENSORS}
        found = {name: constants(table, name, ROW_METHOD["serial"].get(name)) for name, table in tables.items()}
        return {name: (np.diagonal(own[0]).copy(), own[1]) for name, own in found.items() if own is not None}
    sign = {name: np.sign(r.experiment.scale[name]) for name in SENSORS}
    own = {
        "magnetometer": initialise.start_of_triad(r.counts["magnetometer"], 1.0, sign["magnetometer"]),
        "accelerometer": initialise.start_of_triad(
            r.counts["accelerometer"], r.experiment.gravity_mps2, sign["accelerometer"]
        ),
    }
    return {name: value for name, value in own.items() if value is not None}


def flights_of(description: str | None, cases: Iterable[str]) -> argparse.ArgumentParser:
    """Options of a study over simulated flights: how many, which seeds, which cases."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--flights", type=int, default=32)
    parser.add_argument("--first-seed", type=int, default=1000)
    parser.add_argument("--case", action="append", choices=list(cases))
    return parser


def main() -> None:
    parser = flights_of(__doc__, CASES)
    parser.add_argument("--speed", action="store_true")
    given = parser.parse_args()
    if given.speed:
        speed()
        return
    print(f"{given.flights} flights, seeds from {given.first_seed}; median / 95th percentile\n")
    print("| case | quantity | serial | joint |\n|---|---|---|---|")
    for case in given.case or list(CASES):
        print_table(case, study(case, given.flights, given.first_seed))


if __name__ == "__main__":
    main()
