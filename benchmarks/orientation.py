"""Raw counts through an independent filter: the orientation error with constants found here beside the factory's.

    python benchmarks/orientation.py ARCHIVE [ARCHIVE …] [--method auto] [--without-vps]

ARCHIVE as for `real_recordings.py`; used are the logs of counts whose factory constants `expected.json` holds
(`injected`). The counts are calibrated once with each, and VQF (offline, nine axes; `pip install vqf`) estimates the
orientation; its error is the rms angle to the optical attitude, at the clock that was found, constant rotations of
world and body taken out.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
from real_recordings import INJECTED, counting
from vqf import offlineVQF

from fieldcal.config.configuration import load
from fieldcal.config.flight_settings import FlightSettings
from fieldcal.config.stage_settings import Axes, taken_from
from fieldcal.geometry import sensor_model
from fieldcal.geometry.rotation import Array, angle_between, conjugate, continuous, mean_quaternion, multiply, slerp
from fieldcal.logs import ingest
from fieldcal.names import SENSORS, Sensor
from fieldcal.stages.attitude import sensor_attitude
from fieldcal.stages.pipeline import run_flight
from fieldcal.stages.results import StageResult
from fieldcal.stages.tables import QUATERNION, constants, matrix, seconds, triad
from fieldcal.stages.vps import bridged

ALIGNMENTS = 5
SETTLED_S = 10.0  # an offline filter has no transient, but its ends are the worst known


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("archive", nargs="+", type=Path)
    parser.add_argument("--method", default="auto")
    parser.add_argument("--without-vps", action="store_true", help="the optical poses only to compare with")
    given = parser.parse_args()
    changes = {"method": given.method, "use_vps": False if given.without_vps else "auto"}
    print("| log | own constants ° | factory's ° | ratio | sensors refused |\n|---|---|---|---|---|")
    for archive in given.archive:
        expected = json.loads((archive / "expected.json").read_text())
        configuration = load(archive / "fieldcal.toml")
        for name, entry in expected.items():
            if "injected" not in entry:
                continue
            path = archive / name
            vehicle = configuration.vehicle(path.parent.parent.name)
            signals, facts = ingest.read_flight(path, vehicle)
            settings = ingest.settings_of(facts, vehicle).changed(**changes)
            results = run_flight(signals, settings)
            factory = {
                sensor: entry["injected"][key] for sensor, key in {**INJECTED, Sensor.MAGNETOMETER: "mag"}.items()
            }
            theirs = {k: (np.diag(v["lam"]), np.asarray(v["b"], dtype=float)) for k, v in factory.items()}
            own, refused = dict(theirs), []
            for sensor in SENSORS:
                found = constants(counting(results["choice"].tables["calibration"], sensor), sensor)
                if found is None:
                    refused.append(sensor)
                else:
                    own[sensor] = found
            errors = [error_deg(signals, results, settings, triads) for triads in (own, theirs)]
            ratio = errors[0] / errors[1]
            print(f"| {path.name} | {errors[0]:.2f} | {errors[1]:.2f} | {ratio:.2f} | {', '.join(refused) or '–'} |")


def error_deg(
    signals: dict[str, Any],
    results: dict[str, StageResult],
    settings: FlightSettings,
    triads: dict[Sensor, tuple[Array, Array]],
) -> float:
    """Rms angle between the filter's orientation and the optical attitude, °."""
    imu, origin = signals["imu"], int(signals["imu"]["t_ns"][0])
    t = seconds(imu["t_ns"], origin)
    values = {
        sensor: sensor_model.calibrate(matrix(imu, triad(sensor)), *triads[sensor])
        for sensor in (Sensor.GYROSCOPE, Sensor.ACCELEROMETER)
    }
    at = seconds(signals["magnetometer"]["t_ns"], origin)
    field = sensor_model.calibrate(matrix(signals["magnetometer"], triad("magnetometer")), *triads[Sensor.MAGNETOMETER])
    field = np.column_stack([np.interp(t, at, x) for x in field.T])
    up = -np.sign(sensor_model.GRAVITY_SIGNS[settings.gravity_sign])  # VQF: specific force
    grid = np.arange(t[0], t[-1], float(np.median(np.diff(t))))
    even = [
        np.ascontiguousarray(np.column_stack([np.interp(grid, t, x) for x in v.T]))
        for v in (values[Sensor.GYROSCOPE], up * values[Sensor.ACCELEROMETER], field)
    ]
    wxyz = offlineVQF(*even, float(grid[1] - grid[0]))["quat9D"]
    aligned = results["vps_sync"].tables["vps_aligned"]
    own_t = seconds(aligned["t_ns"], origin)
    axes = taken_from(settings, Axes)
    optical = sensor_attitude(matrix(aligned, QUATERNION), axes)
    inside = (grid > own_t[0] + SETTLED_S) & (grid < own_t[-1] - SETTLED_S) & bridged(own_t, grid)
    reference = continuous(slerp(own_t, continuous(optical), grid[inside]))
    found = continuous(wxyz[:, [1, 2, 3, 0]])[inside]
    world = body = np.array([0.0, 0.0, 0.0, 1.0])
    for _ in range(ALIGNMENTS):
        turned = multiply(multiply(world, found), body)
        world = multiply(mean_quaternion(multiply(reference, conjugate(turned))), world)
        turned = multiply(multiply(world, found), body)
        body = multiply(body, mean_quaternion(multiply(conjugate(turned), reference)))
    angle = angle_between(multiply(multiply(world, found), body), reference)
    return float(np.degrees(np.sqrt(np.mean(angle**2))))


if __name__ == "__main__":
    main()
