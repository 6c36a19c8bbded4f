"""Real recordings with optical poses: what is published, how far off it is, and whether its sd are honest.

    python benchmarks/real_recordings.py ARCHIVE [ARCHIVE …] [--log PART …] [--method auto] [--without-vps]

ARCHIVE holds fieldcal.toml and `expected.json` with the reference constants: of the gyroscope (`truth.gyro`, rad/s; or
`gyro_lam_b_reference` of counts), of the accelerometer (`truth.observability.accel_session_reference`, with `injected`
where the log holds counts) and the VPS's clock (`vps.apparent_offset_s`). Every log with one of them is calibrated.

One Markdown row a log: open-loop drift, rms angle against the optical attitude with the gyroscope as logged, after the
serial chain, after the estimate, with the reference constants; error of the VPS's lag, ms, and, where its skew is
known, of that, ppm; then for each triad and axis the error of scale and zero. In brackets each over the sd of both
sides. "–" is a refused row. Below, the rms of all published rows over their sd.

The lag's reference (`imu_lag_s`) was fitted to each recording as ours is, and is the less exact of the two: what it
differs from one recording of an IMU to the next is more than any sensor's delay can. So the last line but one judges
the lags by that alone: over logs of one `source` whose clock's offset is invented (`vps.offset_s`), the delay of the
IMU has to be the same; its weighted mean, and what each lag differs from the mean of the others over both their sd.
"""

from __future__ import annotations

import argparse
import json
import time
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

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
from fieldcal.stages.tables import AXES, QUATERNION, constants, matrix, seconds, triad
from fieldcal.stages.vps import bridged

UNITS = {Sensor.GYROSCOPE: ("°/s", np.degrees(1.0)), Sensor.ACCELEROMETER: ("m/s²", 1.0)}
INJECTED = {Sensor.GYROSCOPE: "gyr", Sensor.ACCELEROMETER: "acc"}
Truth = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
"""Scale, its sd, zero in logged units, its sd: each (3,)."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("archive", nargs="+", type=Path)
    parser.add_argument("--log", action="append", default=[], help="only logs whose path has this part")
    parser.add_argument("--method", default="auto")
    parser.add_argument("--without-vps", action="store_true", help="the optical poses only to compare with")
    given = parser.parse_args()
    changes = {"method": given.method, "use_vps": False if given.without_vps else "auto"}
    ratios: dict[str, list[float]] = defaultdict(list)
    delays: dict[str, list[tuple[float, float]]] = defaultdict(list)
    print(
        "| log | s | rung | drift raw, serial, estimate, reference ° | lag ms, skew ppm | gyroscope | accelerometer |"
    )
    print("|---|---|---|---|---|---|---|")
    for archive in given.archive:
        expected = json.loads((archive / "expected.json").read_text())
        configuration = load(archive / "fieldcal.toml")
        for name, entry in expected.items():
            if truth_of(entry, Sensor.GYROSCOPE) is None or not any(part in name for part in given.log or [""]):
                continue
            path = archive / name
            vehicle = configuration.vehicle(path.parent.parent.name)
            signals, facts = ingest.read_flight(path, vehicle)
            settings = ingest.settings_of(facts, vehicle).changed(**changes)
            began = time.perf_counter()
            results = run_flight(signals, settings)
            print(row(name, entry, results, settings, time.perf_counter() - began, ratios), flush=True)
            if (own := delay(results, entry)) is not None:
                delays[str(entry.get("source", "")).split("/")[0]].append(own)
    for quantity, values in ratios.items():
        z = np.abs(values)
        print(f"\n{quantity}: {len(z)} rows, error ÷ sd rms {np.sqrt(np.mean(z**2)):.2f}, largest {z.max():.1f}")
    for source, own in delays.items():
        if len(own) > 1:
            mean, sd, z = one_delay(*np.array(own).T)
            print(f"\ndelay of the IMU, {source}: {len(own)} logs, {1e3 * mean:.3f} ± {1e3 * sd:.3f} ms,", end=" ")
            print(f"each against the others ÷ sd rms {np.sqrt(np.mean(z**2)):.2f}, largest {np.abs(z).max():.1f}")


def truth_of(entry: dict[str, Any], sensor: Sensor) -> Truth | None:
    """The reference in the log's own unit, or None."""
    truth = entry.get("truth")
    if not isinstance(truth, dict):
        return None
    if sensor == Sensor.GYROSCOPE and "gyro_lam_b_reference" in truth:
        own, after = truth["gyro_lam_b_reference"], truth["gyro_fit_after_nominal"]
        scale = np.array(own["lam"])
        sd = np.abs(scale) * own["lam_rel_sd"]
        return scale, sd, np.array(own["zero_counts"]), np.array(after["bias_sd_rad_s"]) / np.abs(scale)
    if sensor == Sensor.GYROSCOPE:
        found, keys = truth.get("gyro"), ("scale", "scale_sd", "bias_rad_s", "bias_sd_rad_s")
    else:
        found = truth.get("observability", {}).get("accel_session_reference")
        keys = ("scale", "scale_sd", "bias_m_s2", "bias_sd_m_s2")
    if found is None or not all(key in found for key in keys):
        return None
    scale, scale_sd, bias, bias_sd = (np.array(found[key]) for key in keys)
    if "injected" in entry:  # counts: the reference applies after the injected constants
        own = entry["injected"][INJECTED[sensor]]
        scale, scale_sd, bias = scale * own["lam"], scale_sd * np.abs(own["lam"]), scale * own["b"] + bias
    return scale, scale_sd, -bias / scale, bias_sd / np.abs(scale)


def row(
    name: str,
    entry: dict[str, Any],
    results: dict[str, StageResult],
    settings: FlightSettings,
    elapsed_s: float,
    ratios: dict[str, list[float]],
) -> str:
    """One log's line; error ÷ sd of its published rows are added to `ratios`."""
    rows = results["choice"].tables.get("calibration")
    nominal = settings.nominal_scale[Sensor.GYROSCOPE]
    sign = np.asarray(settings.polarity[Sensor.GYROSCOPE], dtype=float)
    reference = truth_of(entry, Sensor.GYROSCOPE)
    assert reference is not None
    serial = results["gyro_output"].tables.get("calibration")
    drifts = [
        None if nominal is None else drift(results, settings, np.asarray(nominal) * sign, np.zeros(3)),
        None if serial is None else drift_of(results, settings, serial.filter(method="output_error")),
        None if rows is None else drift_of(results, settings, counting(rows, Sensor.GYROSCOPE), nominal, sign),
        drift(results, settings, reference[0], -reference[0] * reference[2]),
    ]
    cells = [
        "/".join(Path(name).parts[-1:]),
        f"{elapsed_s:.0f}",
        str(results["joint"].measured.get("rung", results["joint"].reason_code)),
        ", ".join("–" if value is None else f"{value:.2f}" for value in drifts),
        lag(results, entry, ratios),
    ]
    for sensor in (Sensor.GYROSCOPE, Sensor.ACCELEROMETER):
        truth = truth_of(entry, sensor)
        if rows is None or truth is None:
            cells.append("–" if rows is None else "no reference")
            continue
        own = counting(rows, sensor)
        cells.append(", ".join(errors(own, sensor, axis, i, truth, ratios) for i, axis in enumerate(AXES)))
    return "| " + " | ".join(cells) + " |"


def counting(rows: pl.DataFrame, sensor: Sensor) -> pl.DataFrame:
    """Rows of the method that counts for a sensor: the one with a row published, else the joint estimate's."""
    own = rows.filter(sensor=sensor)
    published = own.filter(status="ok")["method"].to_list()
    return own.filter(method=published[0] if published else "joint")


def errors(rows: pl.DataFrame, sensor: Sensor, axis: str, i: int, truth: Truth, ratios: dict[str, list[float]]) -> str:
    scale, scale_sd, zero, zero_sd = truth
    _, si = UNITS[sensor]
    out = []
    for parameter, true, sd, factor in (
        ("scale", scale[i], scale_sd[i], 100.0 / abs(scale[i])),
        ("zero", zero[i], zero_sd[i], abs(scale[i]) * si),
    ):
        found = rows.filter(parameter=parameter, axis=axis, status="ok")
        if found.is_empty():
            out.append("–")
            continue
        error = float(found["value"][0]) - true
        z = error / np.hypot(float(found["sd"][0]), sd)
        ratios[f"{sensor} {parameter}"].append(z)
        out.append(f"{error * factor:+.2g}{'%' if parameter == 'scale' else ''} ({z:+.1f})")
    return f"{axis} {' '.join(out)}"


def lag(results: dict[str, StageResult], entry: dict[str, Any], ratios: dict[str, list[float]]) -> str:
    """At mid-flight, where its sd holds, and the skew."""
    sync, clock = results["vps_sync"].tables.get("sync"), entry.get("vps", {})
    true = clock.get("apparent_offset_s", clock.get("vps_minus_imu_s"))
    if sync is None or true is None or sync["lag_mid_s"][0] is None:
        return "–"
    middle = true + 1e-6 * clock.get("skew_ppm", 0.0) * 0.5 * entry["duration_s"]
    error, sd = 1e3 * (sync["lag_mid_s"][0] + middle), 1e3 * sync["lag_sd_s"][0]
    z = error / np.hypot(sd, 1e3 * reference_lag_sd_s(entry))
    ratios["lag"].append(z)
    told = f"{error:+.3f} ± {sd:.3f} ({z:+.1f})"
    if "skew_ppm" not in clock:
        return told
    wrong, skew_sd = sync["skew_ppm"][0] - clock["skew_ppm"], sync["skew_sd_ppm"][0]
    ratios["skew"].append(wrong / skew_sd)
    return f"{told}, {wrong:+.2f} ± {skew_sd:.2f} ({wrong / skew_sd:+.1f})"


def reference_lag_sd_s(entry: dict[str, Any]) -> float:
    truth = entry["truth"]
    return float(truth.get("gyro", truth.get("gyro_fit_after_nominal", {})).get("imu_lag_sd_s", 0.0))


def delay(results: dict[str, StageResult], entry: dict[str, Any]) -> tuple[float, float] | None:
    """Of the IMU behind the VPS, s, and its sd: the lag less the offset that was given to the VPS's clock."""
    sync, clock = results["vps_sync"].tables.get("sync"), entry.get("vps", {})
    if sync is None or "offset_s" not in clock or sync["lag_mid_s"][0] is None:
        return None
    middle = clock["offset_s"] + 1e-6 * clock["skew_ppm"] * 0.5 * entry["duration_s"]
    return sync["lag_mid_s"][0] + middle, sync["lag_sd_s"][0]


def one_delay(delay_s: np.ndarray, sd_s: np.ndarray) -> tuple[float, float, np.ndarray]:
    """Weighted mean, its sd, and each (n,) less the mean of the others over the sd of both."""
    weight = sd_s**-2.0
    total = weight.sum()
    mean = float(weight @ delay_s / total)
    others = (weight @ delay_s - weight * delay_s) / (total - weight)
    return mean, float(total**-0.5), (delay_s - others) / np.sqrt(sd_s**2 + 1.0 / (total - weight))


def drift_of(
    results: dict[str, StageResult],
    settings: FlightSettings,
    rows: pl.DataFrame,
    nominal: tuple[float, float, float] | None = None,
    sign: np.ndarray | None = None,
) -> float | None:
    """With a method's constants, what is refused replaced by the logged unit; None where that says nothing."""
    if rows.is_empty():
        return None
    if (rows["status"] == "ok").all():
        found = constants(rows, Sensor.GYROSCOPE)
        return None if found is None else drift(results, settings, *found)
    if nominal is None or sign is None:
        return None
    value = {(p, a): v for p, a, v in rows.filter(status="ok").select("parameter", "axis", "value").iter_rows()}
    scale = np.array([value.get(("scale", axis), nominal[i] * sign[i]) for i, axis in enumerate(AXES)])
    zero = np.array([value.get(("zero", axis), 0.0) for axis in AXES])
    return drift(results, settings, scale, -scale * zero)


def drift(
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
    logged = matrix(samples, triad("gyroscope"))
    rate = logged @ scale.T + bias if scale.ndim == 2 else logged * scale + bias
    own = slerp(t, propagate_stretches(t, rate, segment), at)[near]
    optical = sensor_attitude(matrix(vps, QUATERNION), taken_from(settings, Axes))[near]
    model = start_stretches(own, optical, part, np.ones(len(own)), fixed=False)
    return float(np.degrees(np.sqrt(np.mean(angle_between(optical, model) ** 2))))


if __name__ == "__main__":
    main()
