"""An ordinary flight with a receiver's velocity through the night: warehouse, history, export and report."""

from __future__ import annotations

import json
from pathlib import Path

from fieldcal.exports import PROGRAMS
from fieldcal.exports.calibration_at import constants_of
from fieldcal.flows.run import run_night
from fieldcal.report import flight_report
from fieldcal.simulation.archive import write_flights
from fieldcal.simulation.ordinary import ordinary_flight
from fieldcal.warehouse import Warehouse
from fieldcal.warehouse.upkeep.verify import verify


def test_a_lively_flight_through_the_night(tmp_path: Path, prefect_server: str) -> None:
    archive, root = tmp_path / "archive", tmp_path / "warehouse"
    write_flights(archive, ordinary_flight("lively", 31, duration_s=45.0))
    assert run_night(archive, root, None, None, 1)["ok"] == 1
    warehouse = Warehouse(root)
    rows = warehouse.sql("FROM latest_calibration WHERE parameter IN ('scale', 'zero')")
    assert set(rows["method"]) == {"velocity"}
    assert rows.filter(sensor="gyroscope").height == 6
    assert rows.filter(sensor="accelerometer", parameter="zero").height == 3
    beside = warehouse.sql("FROM calibration WHERE parameter IN ('gnss_lag', 'gnss_lever_arm') AND status = 'ok'")
    assert sorted(beside["axis"]) == ["", "x", "y", "z"]
    assert beside["sd"].null_count() == 0
    known = warehouse.sql("FROM information WHERE status = 'ok'")
    assert set(known["sensor"]) == {"gyroscope", "accelerometer", "magnetometer"}
    exported = json.loads(PROGRAMS["json"](constants_of(root, "sim-1")).text)["sensors"]
    scale = rows.filter(sensor="gyroscope", parameter="scale").sort("axis")["value_at_25degc"].to_list()
    assert [exported["gyroscope"]["scale"][i][i] for i in range(3)] == scale
    page = flight_report(root, rows["flight_id"][0]).read_text()
    assert "lag (of the satellite receiver)" in page
    assert "velocity" in page
    assert verify(root)["ok"]
