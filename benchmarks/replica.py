"""The paper's experiment replayed: its five TICs beside ours, and its Figures 5–10.

    python benchmarks/replica.py [--seed 1] [--translation-rms 0] [--figures FOLDER]

Prints a Markdown table of Eq. 16 for the paper, for fieldcal's default method and for the paper's own method
(Li–Griffiths, scalar equation, one fixed initial attitude, misprints corrected) on the same simulated flight. With
--figures the six figures are drawn as PNG.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from fieldcal.config.flight_settings import FlightSettings
from fieldcal.config.parameters import PROFILES
from fieldcal.estimation import smoothing
from fieldcal.estimation.gyroscope.equation_error import predicted_quaternion_rate
from fieldcal.estimation.gyroscope.output_error import propagate_stretches, start_stretches
from fieldcal.geometry.rotation import Array, continuous, euler_angles
from fieldcal.geometry.sensor_model import calibrate
from fieldcal.simulation.archive import settings, signals
from fieldcal.simulation.experiment import Experiment, SimulatedFlight, simulate
from fieldcal.stages.pipeline import run_flight
from fieldcal.stages.results import StageResult
from fieldcal.stages.tables import QUATERNION, constants, matrix, seconds, triad
from fieldcal.stages.vps import RATE_COLUMNS

PRINTED = {
    ("attitude", "quest", "vps"): (0.0352, "QUEST attitude against VPS"),
    ("quaternion_rate", "equation_error", "quest"): (0.1617, "equation-error quaternion rates against QUEST"),
    ("attitude_propagated", "output_error", "quest"): (0.1459, "output-error attitude against QUEST"),
    ("body_rate", "equation_error", "vps"): (0.2111, "equation-error body rates against VPS"),
    ("body_rate", "output_error", "vps"): (0.2042, "output-error body rates against VPS"),
}
Results = Mapping[str, StageResult]


def tic_table(runs: Mapping[str, Results]) -> str:
    """Markdown: the paper's comparisons, raw and smoothed, one pair of columns a run."""
    heads = [f"{name}, {signal}" for name in runs for signal in ("raw", "smoothed")]
    lines = ["| comparison | paper | " + " | ".join(heads) + " |", "|---|---|" + "---|" * len(heads)]
    for (quantity, method, reference), (printed, text) in PRINTED.items():
        cells = []
        for results in runs.values():
            fit = results["verify"].tables["fit"]
            for signal in ("raw", "smoothed"):
                row = fit.filter(quantity=quantity, method=method, reference=reference, signal=signal).row(
                    0, named=True
                )
                unit = "°" if row["rms_unit"] == "deg" else f" {row['rms_unit']}"
                cells.append(f"{row['tic']:.4f} ({row['rms']:.2f}{unit})")
        lines.append(f"| {text} | {printed:.4f} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def draw(folder: Path, r: SimulatedFlight, results: Results, s: FlightSettings) -> list[Path]:
    """Figures 5–10 of the paper, PNG files in `folder`."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    folder.mkdir(parents=True, exist_ok=True)
    samples = results["smoothing"].tables["samples"]
    t = seconds(samples["t_ns"], int(samples["t_ns"][0]))
    q = continuous(matrix(results["attitude_pass2"].tables["attitude"], QUATERNION))
    vps = results["vps_sync"].tables["vps_aligned"]
    vps_t, vps_q = seconds(vps["t_ns"], int(samples["t_ns"][0])), continuous(matrix(vps, QUATERNION))
    if np.sum(vps_q[0] * q[0]) < 0:
        vps_q = -vps_q
    gyro = results["gyro_output"].tables["calibration"]
    rates = {
        m: calibrate(
            matrix(samples, triad("gyroscope", "smoothed_")), *constants(gyro, "gyroscope", m, refused_too=True)
        )
        for m in ("equation_error", "output_error")
    }
    written = []

    def save(name: str, figure: Any) -> None:
        figure.tight_layout()
        path = folder / f"{name}.png"
        figure.savefig(path, dpi=110)
        plt.close(figure)
        written.append(path)

    figure, axes = plt.subplots(2, 2, figsize=(9, 6))
    for axis, name in zip(axes.flat, ("magnetometer", "accelerometer", "gyroscope"), strict=False):
        axis.plot(r.t, r.counts[name] * 1e-4, linewidth=0.6)
        axis.set(xlabel="time (s)", ylabel=f"{name} (counts · 10⁴)")
        axis.legend(("x", "y", "z"), loc="upper right", fontsize=7)
    axes.flat[3].plot(vps_t, euler_angles(vps_q), linewidth=0.8)
    axes.flat[3].set(xlabel="time (s)", ylabel="VPS orientation (rad)")
    axes.flat[3].legend(("φ", "θ", "ψ"), loc="upper right", fontsize=7)
    save("figure-05-unprocessed", figure)

    figure = plt.figure(figsize=(9, 4.5))
    for i, (name, stage, radius, unit) in enumerate(
        (
            ("magnetometer", "magnetometer", 1.0, "norm"),
            ("accelerometer", "accelerometer_pass2", s.gravity_mps2, "m/s²"),
        )
    ):
        own = constants(results[stage].tables["calibration"], name, refused_too=True)
        if own is None:
            continue
        axis = figure.add_subplot(1, 2, i + 1, projection="3d")
        u, v = np.mgrid[0 : 2 * np.pi : 30j, 0 : np.pi : 15j]
        sphere = radius * np.stack([np.cos(u) * np.sin(v), np.sin(u) * np.sin(v), np.cos(v)])
        axis.plot_wireframe(*sphere, color="0.8", linewidth=0.4)
        points = calibrate(matrix(samples, triad(name)), *own)
        axis.scatter(*points.T, s=0.5, color="C0" if i == 0 else "C1")
        axis.set_title(f"{name} ({unit})")
        axis.set_box_aspect((1, 1, 1))
    save("figure-06-spheres", figure)

    thin = slice(None, None, 20)
    _four(
        save,
        "figure-07-attitude",
        (vps_t, vps_q, "VPS"),
        (t[thin], q[thin], "QUEST, about 9 Hz"),
        ["ε₁", "ε₂", "ε₃", "δ"],
    )
    q_dot = smoothing.differentiate_samples(t, q, window_s=s.parameters.differentiation_window_s)
    model = predicted_quaternion_rate(q, rates["equation_error"])
    names = ["ε̇₁", "ε̇₂", "ε̇₃", "δ̇"]
    _four(save, "figure-08-equation-error", (t, q_dot, "data"), (t, model, "model"), names)
    segment = samples["segment"].to_numpy()
    relative = propagate_stretches(t, rates["output_error"], segment)
    model = start_stretches(relative, q, segment, np.ones(len(t)), fixed=False)
    _four(save, "figure-09-output-error", (t, q, "data"), (t, model, "model"), ["ε₁", "ε₂", "ε₃", "δ"])

    figure, axes = plt.subplots(3, 1, figsize=(9, 7), sharex=True)
    for i, axis in enumerate(axes):
        axis.plot(vps_t, vps[RATE_COLUMNS[i]], color="0.6", linewidth=1.6, label="VPS")
        for method, rate in rates.items():
            axis.plot(t, rate[:, i], linewidth=0.7, label=method.replace("_", " "))
        axis.set_ylabel(f"ω{'xyz'[i]} (rad/s)")
    axes[0].legend(loc="upper right", fontsize=7, ncols=3)
    axes[2].set_xlabel("time (s)")
    save("figure-10-body-rates", figure)
    return written


def _four(save: Any, name: str, a: tuple[Array, Array, str], b: tuple[Array, Array, str], labels: list[str]) -> None:
    """Four quaternion components, two curves each."""
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(4, 1, figsize=(9, 8), sharex=True)
    for i, axis in enumerate(axes):
        axis.plot(a[0], a[1][:, i], color="0.6", linewidth=1.6, label=a[2])
        axis.plot(b[0], b[1][:, i], color="C3", linewidth=0.7, label=b[2])
        axis.set_ylabel(labels[i])
    axes[0].legend(loc="upper right", fontsize=7, ncols=2)
    axes[3].set_xlabel("time (s)")
    save(name, figure)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--translation-rms", type=float, default=0.0, help="m/s², rms of the vector")
    parser.add_argument("--figures", type=Path, help="folder for Figures 5–10")
    given = parser.parse_args()
    flight = simulate(Experiment(seed=given.seed, translation_rms_mps2=given.translation_rms))
    choices: dict[str, dict[str, Any]] = {"fieldcal": {}, "paper's method": dict(PROFILES["paper"])}
    runs = {
        name: run_flight(signals(flight), settings(flight.experiment, **changes)) for name, changes in choices.items()
    }
    for name, results in runs.items():
        if "fit" not in results["verify"].tables:
            raise SystemExit(f"{name}: {results['accelerometer_pass2'].reason or results['verify'].reason}")
    print(tic_table(runs))
    if given.figures:
        for path in draw(given.figures, flight, runs["fieldcal"], settings(flight.experiment)):
            print(path)


if __name__ == "__main__":
    main()
