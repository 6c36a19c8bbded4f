"""What calibrates on board: errors and honesty beside other flight software's, size and instructions, C against Python.

    python benchmarks/onboard.py seeds [--seeds 400]        # errors at ±75°, ±45°, ±20° of tilt
    python benchmarks/onboard.py size                       # code, state, stack, instructions on a Cortex-M4F
    python benchmarks/onboard.py logs [FOLDER ...]          # C against Python on simulated flights and recordings
    python benchmarks/onboard.py refit [--flights 200]      # many flights at once, from their moments

Prints Markdown tables. `size` needs arm-none-eabi-gcc and qemu-system-arm, `logs` a C compiler.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from onboard_peers import PEERS

import fieldcal
from fieldcal.api.onboard import settings_of_board
from fieldcal.geometry.rotation import Array
from fieldcal.logs import find_logs
from fieldcal.onboard import Board, BoardSettings, Limits, Moments, write_sources
from fieldcal.onboard.moments import translate
from fieldcal.onboard.noise import readings_in_mean

sys.path.append(str(Path(__file__).parents[1] / "tests"))
from onboard_support import CORTEX_M4F, MACHINES, SAMPLE, WARNINGS, fly, readings, run, tilting

SCALE, BIAS, NOISE = np.diag([1.05, 0.93, 1.02]), np.array([0.2, -0.1, 0.15]), 0.005
SAMPLES = 6000
"""A minute at 100 Hz, noise of half a per cent of the field."""
TILTS_DEG = (75.0, 45.0, 20.0)
ANY = {"max_condition": 1e9, "max_scale_sd": 1e9, "max_residual": 1e9}


def seeds(n: int) -> None:
    """Scale errors over seeds, accepted fits alone, and mean square of error over claimed sd."""
    print("| | tilt | scale error, rms of an axis, % | the worst axis | refused | NEES |\n|---|---|---|---|---|---|")
    for tilt in TILTS_DEG:
        errors: dict[str, list[Array]] = {}
        over_sd: dict[str, list[float]] = {}
        for seed in range(n):
            rng = np.random.default_rng(seed)
            z = readings(tilting(rng, SAMPLES, tilt), SCALE, BIAS, NOISE, rng)
            moments = Moments()
            moments.feed(z)
            for name, full in (("fieldcal, axis-aligned", False), ("fieldcal, full matrix", True)):
                fit = moments.solve(Limits(magnitude=1.0, full=full))
                errors.setdefault(name, [])
                if fit.reason_code is None:
                    error = np.diagonal(fit.scale - SCALE)
                    errors[name].append(error / np.diagonal(SCALE))
                    whitened = error @ np.linalg.solve(fit.covariance[:3, :3], error)
                    over_sd.setdefault(name, []).append(float(whitened) / 3.0)
            for name, peer in PEERS.items():
                scale = peer(z, 1.0)
                errors.setdefault(name, [])
                if scale is not None:
                    errors[name].append(np.diagonal(scale) / np.diagonal(SCALE) - 1.0)
        for name, found in errors.items():
            by_axis = 100 * np.sqrt(np.mean(np.square(found), axis=0)) if found else np.full(3, np.nan)
            nees = f"{np.mean(over_sd[name]):.2f}" if name in over_sd else "–"
            spread = f"{by_axis.min():.2f}–{by_axis.max():.2f}" if found else "–"
            worst = f"{100 * np.abs(found).max():.1f} %" if found else "–"
            print(f"| {name} | ±{tilt:.0f}° | {spread} | {worst} | {n - len(found)} of {n} | {nees} |", flush=True)


def size() -> None:
    """Code, state, stack and instructions of the C on a Cortex-M4F."""
    flight = simulated(fieldcal.simulate(seed=1, rate_hz=400.0))
    machine = MACHINES[1]
    print("| build | code: all | code: a triad | state (triad, gyroscope, board) | stack | a sample of both triads |")
    print("|---|---|---|---|---|---|")
    rows = []
    for full in (False, True):
        for optimise, double in (("-Os", False), ("-O2", False), ("-Os", True)):
            settings = replace(simulated_settings(400.0), full=full)
            with tempfile.TemporaryDirectory() as name:
                folder = Path(name)
                write_sources(folder, settings)
                flight.tofile(folder / "flight.bin")
                more = ("-DFIELDCAL_DOUBLE_SUMS=1",) if double else ()
                machine.build_cortex_m4f("replay.c", folder, folder / "replay.c.cortex-m4f", *more, optimise=optimise)
                told = machine.run("replay.c", folder)
                code = ("-ffunction-sections", "-fstack-usage", *more, "-c", folder / "fieldcal_onboard.c")
                run("arm-none-eabi-gcc", *CORTEX_M4F, *WARNINGS, optimise, *code, "-o", folder / "o.o", cwd=folder)
                symbols = [
                    line.split() for line in run("arm-none-eabi-nm", "-S", folder / "o.o", cwd=folder).splitlines()
                ]
                sizes = {parts[3]: int(parts[1], 16) for parts in symbols if len(parts) == 4}
                other = ("rates", "dump", "load", "get", "put", "checksum", "attitude", "of_two", "fieldcal_feed")
                other += ("fieldcal_solve", "fieldcal_start", "fieldcal_set", "close_block", "add_equation", "POLARITY")
                triad = sum(v for k, v in sizes.items() if not any(part in k for part in other))
                used = {line.split()[0].split(":")[-1]: int(line.split()[1]) for line in stack_usage(folder)}
                stack = sum(
                    used.get(k, 0) for k in ("fieldcal_moments_solve", "covariance_of", "least_quadric", "eigen")
                )
                fed, first, second, solved = told["ticks"]
                state = ", ".join(f"{v:.0f}" for v in told["bytes"])
                label = f"{'full' if full else 'axis-aligned'}, {optimise}{', double sums' if double else ''}"
                print(
                    f"| {label} | {sum(sizes.values())} B | {triad} B | {state} B | ≤ {stack} B"
                    f" | {40 * first / fed:.0f} instructions |"
                )
                rows.append(f"| {label} | {40 * second / fed:.0f} | {40 * solved / 1e6:.1f} M |")
    print("\n| build | a sample with attitude and gyroscope | to solve for both triads |\n|---|---|---|")
    print("\n".join(rows))


def stack_usage(folder: Path) -> list[str]:
    return [line for path in folder.glob("*.su") for line in path.read_text().splitlines()]


def simulated_settings(rate_hz: float) -> BoardSettings:
    return BoardSettings(
        gravity_mps2=9.81,
        magnetometer_polarity=(1.0, 1.0, -1.0),
        accelerometer_polarity=(1.0, 1.0, -1.0),
        gyroscope_polarity=(-1.0, 1.0, 1.0),
        imu_rate_hz=rate_hz,
        magnetometer_rate_hz=rate_hz,
    )


def simulated(flight: fieldcal.SimulatedFlight) -> np.ndarray:
    out = np.zeros(len(flight.t), dtype=SAMPLE)
    out["t_us"], out["has_field"], out["field"] = np.rint(flight.t * 1e6), 1, flight.counts["magnetometer"]
    out["gyroscope"], out["accelerometer"] = flight.counts["gyroscope"], flight.counts["accelerometer"]
    return out


def logs(folders: list[Path]) -> None:
    """Largest difference between C and Python, over the claimed sd, log by log."""
    print("| log | samples | scale, bias of the triads | gyroscope | codes |\n|---|---|---|---|---|")
    for rate_hz in (185.0, 400.0):
        for seed in range(3):
            flight = simulated(fieldcal.simulate(seed=seed, rate_hz=rate_hz, translation_rms_mps2=0.1 * seed))
            print(
                compared(f"simulated, {rate_hz:.0f} Hz, seed {seed}", simulated_settings(rate_hz), flight), flush=True
            )
    for folder in folders:
        config = folder / "fieldcal.toml" if (folder / "fieldcal.toml").is_file() else None
        for log in find_logs(folder):
            recording = fieldcal.read_log(log.path, config=config, vehicle=log.vehicle_id)
            made = recorded(recording, settings_of_board(log.vehicle_id, config))
            if made is None:
                print(f"| {log.log_uri} | – | no IMU | – | – |", flush=True)
            else:
                print(compared(log.log_uri, *made), flush=True)


def recorded(recording: fieldcal.Recording, board: BoardSettings) -> tuple[BoardSettings, np.ndarray] | None:
    """The IMU's samples, the magnetometer's reading with the first one after it; None where there is no IMU."""
    imu, field = recording.tables.get("imu"), recording.tables.get("magnetometer")
    if imu is None or imu.height < 100 or imu["accelerometer_x"].null_count():
        return None
    t_ns = imu["t_ns"].to_numpy()
    out = np.zeros(imu.height, dtype=SAMPLE)
    out["t_us"] = ((t_ns - t_ns[0]) // 1000) % 2**32
    imu_hz = 1e9 / float(np.median(np.diff(t_ns)))
    for name in ("gyroscope", "accelerometer"):
        columns = [imu[f"{name}_{axis}"].to_numpy() for axis in "xyz"]
        out[name] = np.column_stack(columns)
    if field is None or field.height < 100:
        return replace(board, imu_rate_hz=imu_hz), out
    field_ns = field["t_ns"].to_numpy()
    at = np.searchsorted(t_ns, field_ns)
    at, which = np.unique(at[at < len(t_ns)], return_index=True)
    out["has_field"][at] = 1
    out["field"][at] = np.column_stack([field[f"magnetometer_{axis}"].to_numpy() for axis in "xyz"])[which]
    field_hz = 1e9 / float(np.median(np.diff(field_ns)))
    return replace(board, imu_rate_hz=imu_hz, magnetometer_rate_hz=field_hz), out


def compared(name: str, settings: BoardSettings, flight: np.ndarray) -> str:
    """A row: C on this machine against Python, whatever the fit is worth."""
    settings = replace(settings, gyroscope_max_scale_sd=1e9, **ANY)
    with tempfile.TemporaryDirectory() as folder:
        told = fly(MACHINES[0], Path(folder), settings, flight)
    board = Board(settings, single=True)
    field = np.where(flight["has_field"][:, None] > 0, flight["field"].astype(float), np.nan)
    for _ in range(2):
        board.feed(flight["t_us"], flight["gyroscope"], flight["accelerometer"], field)
        result = board.solve()
    worst, codes = 0.0, []
    for sensor in ("magnetometer", "accelerometer"):
        fit = getattr(result, sensor)
        agreed = (told[f"{sensor}.code"][0] == 0) == (fit.reason_code is None)
        codes.append(f"{fit.reason_code or 'ok'}{'' if agreed else ' (C: other)'}")
        if fit.reason_code is None:
            scale, bias = np.reshape(told[f"{sensor}.scale"], (3, 3)), np.array(told[f"{sensor}.bias"])
            off = np.abs(np.diagonal(scale - fit.scale)) / np.diagonal(fit.scale_sd)
            worst = max(worst, float(off.max()), float((np.abs(bias - fit.bias) / fit.bias_sd).max()))
    rates = result.gyroscope
    solved = [i for i in range(3) if np.isfinite(rates.scale[i])]
    gyroscope = [abs(told["gyroscope.scale"][i] - rates.scale[i]) / rates.scale_sd[i] for i in solved]
    shown = f"{max(gyroscope):.1e} sd" if gyroscope else "–"
    return f"| {name} | {len(flight)} | {worst:.1e} sd | {shown} | {', '.join(codes)} |"


def refit(n: int) -> None:
    """Time to combine and solve the moments of many short flights, and the fit over all their samples beside it."""
    together, parts = Moments(centre=np.zeros(3)), []
    for seed in range(n):
        rng = np.random.default_rng(seed)
        z = readings(tilting(rng, 400, 45.0), SCALE, BIAS, NOISE, rng)
        own = Moments(centre=z[0], in_mean=readings_in_mean(100.0))
        own.feed(z)
        parts.append(own)
        together.feed(z)
        together.gap()
    started = time.perf_counter()
    moments = np.stack([part.values for part in parts])
    centres = np.stack([part.centre for part in parts if part.centre is not None])
    merged = Moments(centre=np.zeros(3))
    merged.values = translate(moments, -centres).sum(axis=0)
    for part in parts:
        merged.noise.merge(part.noise)
    fit = merged.solve(Limits(magnitude=1.0))
    spent = time.perf_counter() - started
    alone = sum(part.solve(Limits(magnitude=1.0)).reason_code is None for part in parts)
    expected = together.solve(Limits(magnitude=1.0))
    off = np.abs(np.diagonal(fit.scale - expected.scale)) / np.diagonal(expected.scale_sd)
    print(f"{n} flights of 4 s, {alone} accepted alone: together {fit.reason_code or 'ok'} in {1e3 * spent:.1f} ms,")
    print(f"{off.max():.1e} sd from the fit over their {together.n_samples} samples.")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("study", choices=["seeds", "size", "logs", "refit"])
    parser.add_argument("folders", nargs="*", type=Path)
    parser.add_argument("--seeds", type=int, default=400)
    parser.add_argument("--flights", type=int, default=200)
    asked = parser.parse_args()
    if asked.study == "seeds":
        seeds(asked.seeds)
    elif asked.study == "size":
        size()
    elif asked.study == "logs":
        logs(asked.folders)
    else:
        refit(asked.flights)


if __name__ == "__main__":
    main()
