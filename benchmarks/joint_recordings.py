"""Open-loop attitude drift on real recordings with optical poses: gyroscope as logged, after serial, after joint, and
with the reference constants.

    python benchmarks/joint_recordings.py ARCHIVE LOG [LOG …] [--use-vps]

ARCHIVE holds fieldcal.toml and `expected.json` with reference gyroscope constants (`truth.gyro` of each log, rad/s);
LOGs are relative to it. The gyroscope is integrated over each contiguous segment from its best start and compared with
the optical attitude (rms angle, degrees); constants are compared with the reference in their stated standard deviations
(both sides' variances added; logs in counts, whose reference is of another unit, are skipped there).
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np

from fieldcal.config.configuration import load
from fieldcal.config.flight_settings import FlightSettings
from fieldcal.config.stage_settings import Axes, taken_from
from fieldcal.estimation.gyroscope.output_error import propagate_stretches, start_stretches
from fieldcal.geometry.rotation import angle_between, slerp
from fieldcal.logs import ingest
from fieldcal.names import Sensor
from fieldcal.stages.attitude import sensor_attitude
from fieldcal.stages.pipeline import run_flight
from fieldcal.stages.results import StageResult
from fieldcal.stages.tables import AXES, QUATERNION, matrix, seconds, triad
from fieldcal.stages.vps import bridged


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("archive", type=Path)
    parser.add_argument("log", nargs="+")
    parser.add_argument("--use-vps", action="store_true", help="the optical attitude in the estimate")
    given = parser.parse_args()
    configuration = load(given.archive / "fieldcal.toml")
    reference = json.loads((given.archive / "expected.json").read_text())
    print("| log | raw | serial | joint | reference | joint gyroscope − reference, sd (scale x y z, bias x y z) |")
    print("|---|---|---|---|---|---|")
    for name in given.log:
        path = given.archive / name
        vehicle = configuration.vehicle(path.parent.parent.name)
        signals, facts = ingest.read_flight(path, vehicle)
        settings = ingest.settings_of(facts, vehicle).changed(method="joint", use_vps=given.use_vps)
        results = run_flight(signals, settings)
        drift = [_raw_drift(results, settings), *(_drift(results, m) for m in ("output_error", "joint"))]
        drift.append(_reference_drift(results, settings, _entry(reference, name)))
        cells = ["–" if value is None else f"{value:.2f}°" for value in drift]
        print(f"| {name} | " + " | ".join(cells) + f" | {_against(results, settings, reference, name)} |", flush=True)


def _drift(results: dict[str, StageResult], method: str) -> float | None:
    fit = results["verify"].tables.get("fit")
    if fit is None:
        return None
    rows = fit.filter(quantity="attitude_propagated", method=method, reference="vps", signal="raw", sample="all")
    return float(rows["rms"][0]) if len(rows) else None


def _raw_drift(results: dict[str, StageResult], settings: FlightSettings) -> float | None:
    """The logged unit alone; None for counts."""
    nominal = settings.nominal_scale[Sensor.GYROSCOPE]
    if nominal is None:
        return None
    sign = np.asarray(settings.polarity[Sensor.GYROSCOPE], dtype=float)
    return _integrated_drift(results, settings, np.asarray(nominal) * sign, np.zeros(3))


def _reference_drift(
    results: dict[str, StageResult], settings: FlightSettings, entry: dict[str, Any] | None
) -> float | None:
    if entry is None or settings.units[Sensor.GYROSCOPE] == "counts":
        return None
    return _integrated_drift(results, settings, np.asarray(entry["scale"]), np.asarray(entry["bias_rad_s"]))


def _integrated_drift(
    results: dict[str, StageResult], settings: FlightSettings, scale: np.ndarray, bias: np.ndarray
) -> float | None:
    """Rms angle, degrees, between the optical attitude and the gyroscope integrated with these constants, each segment
    from its best start."""
    vps = results["vps_sync"].tables.get("vps_aligned")
    if vps is None:
        return None
    samples = results["smoothing"].tables["samples"]
    origin = int(samples["t_ns"][0])
    t, at, segment = seconds(samples["t_ns"], origin), seconds(vps["t_ns"], origin), samples["segment"].to_numpy()
    near = bridged(t, at)
    part = segment[np.clip(np.searchsorted(t, at), 0, len(t) - 1)][near]
    rate = matrix(samples, triad("gyroscope")) * scale + bias
    own = slerp(t, propagate_stretches(t, rate, segment), at)[near]
    optical = sensor_attitude(matrix(vps, QUATERNION), taken_from(settings, Axes))[near]
    model = start_stretches(own, optical, part, np.ones(len(own)), fixed=False)
    return float(np.degrees(np.sqrt(np.mean(angle_between(optical, model) ** 2))))


def _against(results: dict[str, StageResult], settings: FlightSettings, reference: dict[str, Any], name: str) -> str:
    entry = _entry(reference, name)
    rows = results["joint"].tables.get("calibration")
    if rows is None:
        return f"refused: {results['joint'].reason_code}"
    if entry is None or settings.units[Sensor.GYROSCOPE] == "counts":
        return "no reference in this unit"
    out = []
    for parameter, true_key, sd_key in (("scale", "scale", "scale_sd"), ("bias", "bias_rad_s", "bias_sd_rad_s")):
        for i, axis in enumerate(AXES):
            row = rows.filter(sensor="gyroscope", parameter=parameter, axis=axis).row(0, named=True)
            true, sd = entry[true_key][i], entry[sd_key][i]
            out.append(f"{(row['value'] - true) / np.hypot(row['sd'], sd):+.1f}")
    return " ".join(out)


def _entry(reference: dict[str, Any], name: str) -> dict[str, Any] | None:
    return None if name not in reference else reference[name]["truth"].get("gyro")


if __name__ == "__main__":
    main()
