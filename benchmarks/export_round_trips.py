"""Round trips: raw readings → an autopilot with random parameters → log → calibration → export → the autopilot again.

    python benchmarks/export_round_trips.py --flights 100        # about 10 minutes

Every flight has random true constants and, in its log, random parameters that its autopilot flies with: a ULog of PX4
or a DataFlash log of ArduPilot. What was exported is read by the target's rules and applied to the raw readings by its
own formula (tests/autopilot_formulas.py). Printed, by autopilot: the error of offsets and scales over their sd (rms,
and the share beyond 3), in how many sensors the aircraft reads better than before, and what the target cannot hold.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import numpy as np

import fieldcal
from fieldcal.flight.threads import one_thread
from fieldcal.logs.dataflash import write as dataflash
from fieldcal.logs.ulog.write import Rows, write_ulog
from fieldcal.names import SENSORS
from fieldcal.simulation.experiment import simulate

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
import autopilot_formulas as formulas

AUTOPILOTS = ("px4", "ardupilot")
DIP_RAD = 1.1
SPREAD = {"gyroscope": 0.05, "accelerometer": 0.3, "magnetometer": 0.1}
IDS = {"gyroscope": 2621704, "accelerometer": 2490378, "magnetometer": 590114}
WARM_DEGC = 33.0
CONFIGURATION = f"""
[defaults]
field = {{ north_east_down = [{np.cos(DIP_RAD)}, 0.0, {np.sin(DIP_RAD)}], unit = "G" }}
gravity_mps2 = 9.81
"""


@dataclass(frozen=True)
class Outcome:
    """One flight. `ratios`: errors over sd; `before`, `after`: rms error of each sensor's readings on the aircraft."""

    ratios: list[float]
    before: list[float]
    after: list[float]
    rates_wrong: float


def round_trip(autopilot: str, seed: int) -> Outcome:
    """A flight and what comes back of it."""
    rng = np.random.default_rng(seed)
    scale = {s: rng.uniform(0.97, 1.03, 3) for s in SENSORS}
    zero = {s: rng.uniform(-SPREAD[s], SPREAD[s], 3) for s in SENSORS}
    slot = int(rng.integers(3))
    p = (px4 if autopilot == "px4" else ardupilot)(rng, slot)
    board = formulas.px4_board(p) if autopilot == "px4" else formulas.dcm(*turned(p["AHRS_ORIENTATION"]))
    flight = simulate(seed=seed, dip_rad=DIP_RAD, temperature_degc=(25.0, 25.0))
    e = flight.experiment
    body = {s: flight.counts[s] * np.array(e.scale[s]) + np.array(e.bias[s]) for s in SENSORS}
    body["accelerometer"] = -body["accelerometer"]
    raw = {s: body[s] @ board / scale[s] + zero[s] for s in SENSORS}
    warm = np.full(len(flight.t), WARM_DEGC)
    apply = formulas.px4 if autopilot == "px4" else formulas.ardupilot
    place = {s: IDS[s] if autopilot == "px4" else slot for s in SENSORS}
    logged = {s: apply(s, place[s], raw[s], p, warm) for s in SENSORS}
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "v" / "s" / ("log.ulg" if autopilot == "px4" else "log.bin")
        log.parent.mkdir(parents=True)
        write = write_px4 if autopilot == "px4" else write_ardupilot
        write(log, flight, logged, p, slot)
        config = Path(folder) / "fieldcal.toml"
        config.write_text(CONFIGURATION)
        with one_thread():
            constants = fieldcal.calibrate(log, config=config).constants()
        text = fieldcal.export(constants, autopilot).text
        read = (
            formulas.read_qgroundcontrol(text)
            if autopilot == "px4"
            else formulas.read_mission_planner(text, Path(folder))
        )
    held = {**p, **read}
    ratios, before, after = [], [], []
    for s, triad in constants.triads.items():
        in_body = (autopilot, s) == ("ardupilot", "magnetometer")
        # A compass of ArduPilot is calibrated in body axes: its constants and its truth are turned.
        turn = board if in_body else np.eye(3)
        own = triad if in_body else triad.turned(board.T)
        probe = np.vstack([np.zeros(3), np.eye(3)]) @ turn
        z = apply(s, place[s], probe, held, warm[:4]) @ (np.eye(3) if in_body else board)
        matrix = (z[1:] - z[0]).T
        found_zero = -np.linalg.solve(matrix, z[0])
        ratios += ((found_zero - turn @ zero[s]) / own.zero_sd).tolist()
        if s != "gyroscope":
            truth = np.diagonal(turn @ np.diag(scale[s]) @ turn.T)
            ratios += ((np.diagonal(matrix) - truth) / own.scale_sd).tolist()
        some = raw[s][::50] if s != "gyroscope" else zero[s][None, :]
        right = (some - zero[s]) * scale[s] @ board.T
        for parameters, into in ((p, before), (held, after)):
            found = apply(s, place[s], some, parameters, warm[: len(some)])
            into.append(float(np.sqrt(np.mean((found - right) ** 2))))
    wrong = float(np.max(np.abs(scale["gyroscope"] - 1.0)))
    return Outcome([float(r) for r in ratios], before, after, wrong)


def turned(number: float) -> tuple[int, int, int]:
    return formulas.YAW_ROLL_PITCH_DEG[int(number)]


def px4(rng: np.random.Generator, slot: int) -> dict[str, float]:
    p = {"SENS_BOARD_ROT": float(rng.choice(list(formulas.YAW_ROLL_PITCH_DEG)))}
    for s, (short, letter) in formulas.PX4_SHORT.items():
        p |= {f"CAL_{short}{n}_ID": float(IDS[s] if n == slot else 100 + n) for n in range(3)}
        p[f"TC_{letter}_ENABLE"] = 0.0
        for axis in "XYZ":
            p[f"CAL_{short}{slot}_{axis}OFF"] = rng.uniform(-SPREAD[s], SPREAD[s])
            if s != "gyroscope":
                p[f"CAL_{short}{slot}_{axis}SCALE"] = rng.uniform(0.96, 1.04)
    return _kept(p)


def ardupilot(rng: np.random.Generator, slot: int) -> dict[str, float]:
    n, block = str(slot + 1) if slot else "", f"INS_TCAL{slot + 1}_"
    p = {"AHRS_ORIENTATION": float(rng.choice(list(formulas.YAW_ROLL_PITCH_DEG)))}
    p |= {f"{block}ENABLE": float(rng.integers(2)), f"{block}TMIN": 0.0, f"{block}TMAX": 60.0}
    for kind, s in (("GYR", "gyroscope"), ("ACC", "accelerometer")):
        p |= {f"INS_{kind}{n}_ID": float(IDS[s]), f"INS_{kind}{slot + 1}_CALTEMP": rng.uniform(20.0, 50.0)}
        for axis in "XYZ":
            p[f"INS_{kind}{n}OFFS_{axis}"] = rng.uniform(-SPREAD[s], SPREAD[s])
            for order, size in ((1, 3e3), (2, 1e2), (3, 1.0)):
                p[f"{block}{kind}{order}_{axis}"] = size * SPREAD[s] * rng.uniform(-1.0, 1.0)
            if kind == "ACC":
                p[f"INS_ACC{n}SCAL_{axis}"] = rng.uniform(0.96, 1.04)
    p |= {f"COMPASS_DEV_ID{n}": float(IDS["magnetometer"]), f"COMPASS_SCALE{n}": rng.uniform(0.95, 1.05)}
    for axis in "XYZ":
        p[f"COMPASS_OFS{n}_{axis}"] = rng.uniform(-100.0, 100.0)
        p[f"COMPASS_DIA{n}_{axis}"] = rng.uniform(0.96, 1.04)
        p[f"COMPASS_ODI{n}_{axis}"] = rng.uniform(-0.02, 0.02)
    return _kept(p)


def _kept(p: dict[str, float]) -> dict[str, float]:
    """As an autopilot keeps them, in 32 bits."""
    return {name: float(np.float32(value)) for name, value in p.items()}


def write_px4(
    path: Path, flight: fieldcal.SimulatedFlight, logged: dict[str, np.ndarray], p: dict[str, float], slot: int
) -> None:
    t_us = np.rint(flight.t * 1e6).astype(np.uint64) + np.uint64(5_000_000)
    vps_us = np.rint(flight.vps_t * 1e6).astype(np.uint64) + np.uint64(5_000_000)
    one = np.array([t_us[0]])
    topics = [
        Rows(
            "sensor_combined",
            {
                "timestamp": t_us,
                "gyro_rad": logged["gyroscope"].astype(np.float32),
                "gyro_integral_dt": np.full(len(t_us), 5000, np.uint32),
                "accelerometer_timestamp_relative": np.zeros(len(t_us), np.int32),
                "accelerometer_m_s2": logged["accelerometer"].astype(np.float32),
                "accelerometer_clipping": np.zeros(len(t_us), np.uint8),
            },
        ),
        Rows(
            "vehicle_magnetometer",
            {
                "timestamp": t_us,
                "timestamp_sample": t_us,
                "device_id": np.full(len(t_us), IDS["magnetometer"], np.uint32),
                "magnetometer_ga": logged["magnetometer"].astype(np.float32),
            },
        ),
        Rows(
            "vehicle_mocap_odometry",
            {
                "timestamp": vps_us,
                "timestamp_sample": vps_us,
                "position": flight.vps_position.astype(np.float32),
                "q": flight.vps_q[:, [3, 0, 1, 2]].astype(np.float32),
                "pose_frame": np.ones(len(vps_us), np.uint8),
            },
        ),
        Rows(
            "sensor_selection",
            {
                "timestamp": one,
                "gyro_device_id": np.array([IDS["gyroscope"]], np.uint32),
                "accel_device_id": np.array([IDS["accelerometer"]], np.uint32),
            },
        ),
    ]
    whole = {name: int(value) if name.endswith(("_ID", "_ROT", "_ENABLE")) else value for name, value in p.items()}
    write_ulog(path, topics, parameters=whole, infos={"sys_name": "PX4", "ver_hw": "BOARD"})


def write_ardupilot(
    path: Path, flight: fieldcal.SimulatedFlight, logged: dict[str, np.ndarray], p: dict[str, float], slot: int
) -> None:
    t_us = np.rint(flight.t * 1e6).astype(np.int64) + 5_000_000
    n = str(slot + 1) if slot else ""
    offsets = [p[f"COMPASS_OFS{n}_{axis}"] for axis in "XYZ"]
    messages = [
        dataflash.imu_messages(t_us, logged["gyroscope"], logged["accelerometer"], WARM_DEGC, instance=slot),
        dataflash.mag_messages(t_us + 3, logged["magnetometer"], offsets_mg=offsets, instance=slot),
    ]
    dataflash.write_dataflash(path, messages, parameters=p, texts=("ArduCopter V4.5.0",))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--flights", type=int, default=100)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--workers", type=int, default=2)
    arguments = parser.parse_args()
    seeds = range(arguments.first, arguments.first + arguments.flights)
    with ProcessPoolExecutor(arguments.workers, mp_context=get_context("spawn")) as pool:
        for autopilot in AUTOPILOTS:
            found = list(pool.map(partial(round_trip, autopilot), seeds))
            ratios = np.array([ratio for one in found for ratio in one.ratios])
            before = np.array([rms for one in found for rms in one.before])
            after = np.array([rms for one in found for rms in one.after])
            print(
                f"{autopilot}: {len(found)} flights, {len(ratios)} parameters: error/sd rms"
                f" {np.sqrt(np.mean(ratios**2)):.3f}, {100.0 * np.mean(np.abs(ratios) > 3.0):.2f} % beyond 3, largest"
                f" {np.max(np.abs(ratios)):.1f}; {100.0 * np.mean(after < before):.1f} % of {len(after)} sensors better"
                f" (error {np.median(after / before):.3f} of before in the median)"
            )
            wrong = 100.0 * np.array([one.rates_wrong for one in found])
            print(
                f"  not held: gyroscope scale, up to {wrong.max():.1f} %, median {np.median(wrong):.1f} %", flush=True
            )


if __name__ == "__main__":
    main()
