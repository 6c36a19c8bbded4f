"""A simulated flight in other tools' CSV formats comes out as the simulator's truth, with no columns configured."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from preset_files import IMU_FILES, ONLY_BY_NAME, VPS_FILES, Readings
from scipy.spatial.transform import Rotation

import fieldcal
from fieldcal.simulation.experiment import SimulatedFlight

FIELD_T = 5e-5
FRD_FROM_FLU = Rotation.from_euler("x", 180, degrees=True)
ENU_FROM_NED = Rotation.from_matrix([[0, 1, 0], [1, 0, 0], [0, 0, -1]])
SCALES = {"gyroscope": (1.02, 0.985, 1.01), "accelerometer": (0.99, 1.015, 1.005), "magnetometer": (1.03, 0.97, 1.01)}
BIASES = {"gyroscope": (0.02, -0.01, 0.03), "accelerometer": (0.1, -0.05, 0.08), "magnetometer": (0.02, 0.01, -0.03)}
START_NS = 1_000_000_000
VPS_OFFSET_S = 0.37
NOMINAL = {
    **{"1": 1.0, "rad/s/(deg/s)": np.pi / 180, "m/s^2/g": 9.80665},
    **{"uT/G": 100.0, "uT/T": 1e6, "uT/counts": 0.01},
}
"""Unit of a scale → that of a sensor without fault; a count of the explorer's magnetometer is written as 10 nT."""
LARGEST_SD = 0.02
FLU = ("rostopic", "plotjuggler")
"""Formats that fix the body's axes, other than nose, starboard, underside."""


@pytest.fixture(scope="module")
def flight() -> SimulatedFlight:
    return fieldcal.simulate(
        seed=4,
        scale=SCALES,
        bias=BIASES,
        quantisation=False,
        dip_rad=1.1,
        vps_rate_hz=100.0,
        vps_offset_s=VPS_OFFSET_S,
        vps_skew_ppm=0.0,
        translation_rms_mps2=0.5,
    )


def readings(flight: SimulatedFlight, body: Rotation) -> Readings:
    """The flight as a sensor logs it whose axes `body` turns into nose, starboard, underside: specific force, a world
    with z up."""
    back = body.inv()
    return Readings(
        START_NS + np.rint(flight.t * 1e6).astype(np.int64) * 1000,
        back.apply(flight.counts["gyroscope"]),
        back.apply(-flight.counts["accelerometer"]),
        back.apply(flight.counts["magnetometer"]) * FIELD_T,
        START_NS + np.rint(flight.vps_t * 1e6).astype(np.int64) * 1000,
        (ENU_FROM_NED * Rotation.from_quat(flight.vps_q) * body).as_quat(),
        ENU_FROM_NED.apply(flight.vps_position),
    )


@pytest.mark.parametrize(
    ("imu", "vps"),
    [
        ("ulog2csv", "ulog2csv_poses"),
        ("ngimu", "motive"),
        ("blackbox_explorer", "qualisys"),
        ("rostopic", "rostopic_poses"),
        ("plotjuggler", "vicon"),
        ("phyphox", "euroc_poses"),
        ("mavlogdump", "motive_z_up"),
    ],
)
def test_a_simulated_flight(tmp_path: Path, flight: SimulatedFlight, imu: str, vps: str) -> None:
    r = readings(flight, FRD_FROM_FLU if imu in FLU else Rotation.identity())
    (tmp_path / "log").mkdir()
    for name, files, written in (("imu", IMU_FILES, imu), ("vps", {**VPS_FILES, **ONLY_BY_NAME}, vps)):
        (tmp_path / "log" / f"{name}.csv").write_text(files[written][1](r), encoding="utf-8")
    (tmp_path / "fieldcal.toml").write_text(
        "[defaults]\n"
        f"gravity_mps2 = {flight.experiment.gravity_mps2}\n"
        f"field = {{ north_east_down = [{np.cos(1.1) * 50}, 0.0, {np.sin(1.1) * 50}], unit = 'uT' }}\n"
        + ("[defaults.csv]\npreset = 'motive_z_up'\n" if vps in ONLY_BY_NAME else "")
    )
    document = fieldcal.calibrate(tmp_path / "log", config=tmp_path / "fieldcal.toml").document
    flown, sync = document["flight"], document["sync"]
    assert flown["verdict"] == "ok", flown["reason"]
    presets = [finding for finding in flown["findings"] or [] if finding["code"] == "preset"]
    assert len(presets) == 2
    rows = [row for row in document["calibration"] if (row["parameter"], row["status"]) == ("scale", "ok")]
    assert {row["sensor"] for row in rows} >= {"gyroscope", "accelerometer"}
    for row in rows:
        assert row["value"] is not None
        assert row["sd"] is not None
        nominal = NOMINAL[str(row["unit"])]
        off = row["value"] / nominal - SCALES[row["sensor"]]["xyz".index(str(row["axis"]))]
        assert abs(off) < 4 * row["sd"] / nominal, row
        assert row["sd"] / nominal < LARGEST_SD, row
    assert sync is not None
    assert sync["lag_s"] is not None
    # Vicon counts frames from the first one on.
    start_s = r.vps_ns[0] * 1e-9 if vps == "vicon" else 0.0
    assert sync["lag_s"] - start_s == pytest.approx(flight.lag_s, abs=5e-4)
