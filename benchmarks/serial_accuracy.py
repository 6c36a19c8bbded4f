"""Errors and honesty of the serial method over simulated flights, the paper's own method beside it.

    python benchmarks/serial_accuracy.py [--flights 32] [--first-seed 1000] [--translation-rms 0] [--dip-deg 0]

Prints one Markdown table: scale error (rms of three axes, per cent) and attitude error (rms, degrees, against the
truth delayed by the sensor filter) as median and 95th percentile over flights, and the RMS of error ÷ claimed sd of
the scales. `--json` prints the figures.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass, field

import numpy as np
import polars as pl

from fieldcal.config.parameters import PROFILES
from fieldcal.geometry.rotation import angle_between
from fieldcal.simulation.archive import settings, signals, truth
from fieldcal.simulation.experiment import Experiment, SimulatedFlight, simulate
from fieldcal.stages.pipeline import run_flight
from fieldcal.stages.tables import AXES, QUATERNION, matrix

WHERE = {
    "magnetometer": ("magnetometer", None),
    "accelerometer": ("accelerometer_pass2", None),
    "gyroscope, equation error": ("gyro_output", "equation_error"),
    "gyroscope, output error": ("gyro_output", "output_error"),
}


@dataclass
class Study:
    """Per-flight errors of one method."""

    scale_percent: dict[str, list[float]] = field(default_factory=lambda: {name: [] for name in WHERE})
    over_sd: dict[str, list[float]] = field(default_factory=lambda: {name: [] for name in WHERE})
    attitude_deg: list[float] = field(default_factory=list)
    refused: dict[str, int] = field(default_factory=lambda: dict.fromkeys(WHERE, 0))

    def add(self, recording: SimulatedFlight, parameters: dict[str, object]) -> None:
        """Calibrate one recording and note its errors; refused estimates are counted, not averaged."""
        results = run_flight(signals(recording), settings(recording.experiment, **parameters))
        known = truth(recording)["constants"]
        for name, (stage, method) in WHERE.items():
            rows = results[stage].tables.get("calibration")
            if rows is None:
                self.refused[name] += 1
                continue
            rows = rows.filter(parameter="scale").filter(pl.col("axis").is_in(AXES))
            if method:
                rows = rows.filter(method=method)
            if rows.is_empty() or (rows["status"] != "ok").any():
                self.refused[name] += 1
                continue
            true = np.array(known[name.split(",")[0]]["scale"])
            error = rows["value"].to_numpy() - true
            self.scale_percent[name].append(float(100 * np.sqrt(np.mean((error / true) ** 2))))
            self.over_sd[name].append(float(np.mean((error / rows["sd"].to_numpy()) ** 2)))
        attitude = results["attitude_pass2"].tables.get("attitude")
        if attitude is not None:
            index = np.searchsorted(np.rint(recording.t * 1e9), attitude["t_ns"].to_numpy())
            angle = angle_between(matrix(attitude, QUATERNION), recording.q[index])
            self.attitude_deg.append(float(np.degrees(np.sqrt(np.mean(angle**2)))))

    def figures(self) -> dict[str, dict[str, float]]:
        """Median, 95th percentile, rms of error ÷ sd and refusals by quantity."""
        out = {}
        for name in WHERE:
            values = self.scale_percent[name] or [np.nan]
            squares = self.over_sd[name] or [np.nan]
            out[name] = {
                "median": float(np.median(values)),
                "p95": float(np.percentile(values, 95)),
                "error_over_sd_rms": float(np.sqrt(np.mean(squares))),
                "refused": self.refused[name],
            }
        angles = self.attitude_deg or [np.nan]
        out["attitude"] = {"median": float(np.median(angles)), "p95": float(np.percentile(angles, 95))}
        return out


def study(
    experiment: Experiment, flights: int, first_seed: int, methods: dict[str, dict[str, object]]
) -> dict[str, Study]:
    """All methods over the same flights."""
    studies = {name: Study() for name in methods}
    for seed in range(first_seed, first_seed + flights):
        recording = simulate(experiment, seed=seed)
        for name, parameters in methods.items():
            studies[name].add(recording, parameters)
    return studies


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--flights", type=int, default=32)
    parser.add_argument("--first-seed", type=int, default=1000)
    parser.add_argument("--translation-rms", type=float, default=0.0, help="m/s², rms of the vector")
    parser.add_argument("--dip-deg", type=float, default=0.0)
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args()
    arm = (0.05, 0.02, -0.03) if given.translation_rms else (0.0, 0.0, 0.0)
    experiment = Experiment(
        translation_rms_mps2=given.translation_rms, lever_arm_m=arm, dip_rad=float(np.radians(given.dip_deg))
    )
    methods: dict[str, dict[str, object]] = {"serial": {}, "paper's own": dict(PROFILES["paper"])}
    figures = {name: s.figures() for name, s in study(experiment, given.flights, given.first_seed, methods).items()}
    if given.json:
        print(json.dumps(figures, indent=1))
        return
    print(f"{given.flights} flights, seeds from {given.first_seed}, median / 95th percentile\n")
    print("| quantity | " + " | ".join(methods) + " |")
    print("|---|" + "---|" * len(methods))
    for quantity in (*WHERE, "attitude"):
        cells = []
        for name in methods:
            f = figures[name][quantity]
            unit = "°" if quantity == "attitude" else " %"
            cell = f"{f['median']:.2f} / {f['p95']:.2f}{unit}"
            if "error_over_sd_rms" in f:
                cell += f" (error ÷ sd {f['error_over_sd_rms']:.2f}; refused {f['refused']})"
            cells.append(cell)
        print(f"| {quantity} | " + " | ".join(cells) + " |")


if __name__ == "__main__":
    main()
