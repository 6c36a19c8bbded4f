"""The circle of a season: a night finds constants, they are exported and loaded, the next night's log tells so."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import fieldcal
from fieldcal.flows.run import run_night
from fieldcal.logs.dataflash import write as dataflash
from fieldcal.names import SENSORS
from fieldcal.simulation.experiment import simulate

DIP_RAD = 1.1
TRUE_ZERO = {"gyroscope": (0.02, -0.03, 0.015), "accelerometer": (0.2, -0.25, 0.1), "magnetometer": (0.05, -0.08, 0.02)}
"""Of the raw sensors, rad/s, m/s², G; scales are 1."""
CONFIGURATION = f"""
[defaults]
field = {{ north_east_down = [{0.5 * np.cos(DIP_RAD)}, 0.0, {0.5 * np.sin(DIP_RAD)}], unit = "G" }}
gravity_mps2 = 9.81
"""
SLOTS = {"INS_ACC_ID": 10.0, "INS_GYR_ID": 20.0, "COMPASS_DEV_ID": 30.0, "INS_GYR_CAL": 0.0, "AHRS_ORIENTATION": 0.0}
UNCALIBRATED = {
    **SLOTS,
    **{f"INS_GYROFFS_{axis}": 0.0 for axis in "XYZ"},
    **{f"INS_ACCOFFS_{axis}": 0.0 for axis in "XYZ"},
    **{f"INS_ACCSCAL_{axis}": 1.0 for axis in "XYZ"},
    **{f"COMPASS_OFS_{axis}": 0.0 for axis in "XYZ"},
    **{f"COMPASS_DIA_{axis}": 1.0 for axis in "XYZ"},
    **{f"COMPASS_ODI_{axis}": 0.0 for axis in "XYZ"},
    "COMPASS_SCALE": 1.0,
}


def fly(path: Path, parameters: dict[str, float], seed: int) -> None:
    """A flight of ArduPilot with these parameters loaded."""
    flight = simulate(seed=seed, dip_rad=DIP_RAD, temperature_degc=(25.0, 25.0))
    e = flight.experiment
    si = {name: flight.counts[name] * np.array(e.scale[name]) + np.array(e.bias[name]) for name in SENSORS}
    si["accelerometer"], si["magnetometer"] = -si["accelerometer"], 0.5 * si["magnetometer"]
    raw = {name: si[name] + np.array(TRUE_ZERO[name]) for name in SENSORS}
    t_us = np.rint(flight.t * 1e6).astype(np.int64) + 5_000_000
    logged = {
        name: dataflash.as_logged(short, raw[name], parameters, slot=0)
        for short, name in (("GYR", "gyroscope"), ("ACC", "accelerometer"), ("MAG", "magnetometer"))
    }
    offsets = [parameters[f"COMPASS_OFS_{axis}"] for axis in "XYZ"]
    messages = [
        dataflash.imu_messages(t_us, logged["gyroscope"], logged["accelerometer"], 35.0, instance=0),
        dataflash.mag_messages(t_us + 5, logged["magnetometer"], offsets_mg=offsets, instance=0),
    ]
    path.parent.mkdir(parents=True)
    dataflash.write_dataflash(path, messages, parameters=parameters, texts=("ArduCopter V4.5.0",))


def test_what_was_exported_is_found_in_the_next_log(
    tmp_path: Path, prefect_server: str, capsys: pytest.CaptureFixture[str]
) -> None:
    archive, root, file = tmp_path / "archive", tmp_path / "warehouse", tmp_path / "v.param"
    fly(archive / "v" / "2026-05-01" / "1.bin", UNCALIBRATED, 4)
    (archive / "fieldcal.toml").write_text(CONFIGURATION)
    assert [log["verdict"] for log in run_night(archive, root)["logs"]] == ["ok"]
    from fieldcal.cli.main import run

    assert run(["export", "v", "-f", "ardupilot", "-o", str(file), "--warehouse", str(root)]) == 0
    lines = [line.split(",") for line in file.read_text().splitlines() if not line.startswith("#")]
    loaded = UNCALIBRATED | {name: float(np.float32(value)) for name, value in lines}
    fly(archive / "v" / "2026-05-02" / "2.bin", loaded, 5)
    run_night(archive, root)
    warehouse = fieldcal.Warehouse(root)
    latest = warehouse.sql("SELECT flight_id FROM flight ORDER BY sequence")["flight_id"][-1]
    fates = {one.sensor: (str(one.fate), one.since) for one in warehouse.exports("v")}
    assert fates == dict.fromkeys(SENSORS, ("flies", latest))
    capsys.readouterr()
    assert run(["compare", "v", "--warehouse", str(root)]) == 0
    told = " ".join(capsys.readouterr().out.split())
    assert told.count(f"loaded since flight {latest}") == len(SENSORS)
    # What flies now is what is estimated: nothing matters any more.
    assert not [row for row in fieldcal.compare(warehouse.calibration_at("v")) if row.matters]
    assert warehouse.sql("SELECT count(*) AS n FROM active WHERE exported_at IS NOT NULL")["n"].item() > 0
