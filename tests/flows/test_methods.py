"""Every method, alone and mixed by sensor, through the night: warehouse, history, export and report."""

from __future__ import annotations

import itertools
import json
from pathlib import Path
from typing import Any

import pytest

from fieldcal.exports import PROGRAMS
from fieldcal.exports.calibration_at import constants_of
from fieldcal.flows.run import run_night
from fieldcal.names import SENSORS
from fieldcal.report import flight_report
from fieldcal.simulation.archive import write_flights
from fieldcal.simulation.experiment import Experiment
from fieldcal.warehouse import Warehouse

METHODS = ("serial", "joint")
CHOICES: tuple[dict[str, Any], ...] = (
    *({"method": dict(zip(SENSORS, mixture, strict=True))} for mixture in itertools.product(METHODS, repeat=3)),
    {"method": "joint", "parameters": {"use_vps": True}},
    {"method": "joint", "parameters": {"use_vps": False}},
    {"method": "auto"},
    {"profile": "onboard"},
    {"profile": "paper"},
)


def configured(choice: dict[str, Any]) -> str:
    lines = [f"{key} = {json.dumps(choice[key])}" for key in ("method", "profile") if isinstance(choice.get(key), str)]
    for table in ("method", "parameters"):
        if isinstance(choice.get(table), dict):
            inside = ", ".join(f"{key} = {json.dumps(value)}" for key, value in choice[table].items())
            lines.append(f"{table} = {{ {inside} }}")
    return "\n".join(lines) + "\n"


@pytest.fixture(scope="module")
def night(tmp_path_factory: pytest.TempPathFactory, prefect_server: str) -> tuple[Path, Path, dict[str, Any]]:
    """Archive in which each vehicle is calibrated by one of CHOICES, the warehouse and the JSON of its night."""
    archive = tmp_path_factory.mktemp("methods") / "archive"
    write_flights(archive, Experiment(seed=7, duration_s=25.0), vehicles=len(CHOICES), sessions=1, flights=1)
    config = archive / "fieldcal.toml"
    text = config.read_text()
    for number, choice in enumerate(CHOICES, start=1):
        head = f'[vehicles."sim-{number}"]\n'
        assert head in text
        text = text.replace(head, head + configured(choice))
    config.write_text(text)
    root = archive.parent / "warehouse"
    return archive, root, run_night(archive, root, None, None, 2)


def test_the_night_is_fine_with_every_choice(night: tuple[Path, Path, dict[str, Any]]) -> None:
    _, root, result = night
    assert result["ok"] == len(CHOICES), [log for log in result["logs"] if log["verdict"] != "ok"]
    assert Warehouse(root).sql("SELECT * FROM run WHERE status = 'failed'").is_empty()


def expected_methods(choice: dict[str, Any], sensor: str) -> set[str]:
    if sensor != "gyroscope":
        serial = {"onboard": "ellipsoid_two_step", "paper": "ellipsoid"}
        named = serial.get(choice.get("profile", ""), "ellipsoid_robust")
        return {named, "joint"} if joint_for(choice, sensor) else {named}
    serial_gyro = {"equation_error"} if choice.get("profile") == "onboard" else {"equation_error", "output_error"}
    return serial_gyro | ({"joint"} if joint_for(choice, sensor) else set())


def joint_for(choice: dict[str, Any], sensor: str) -> bool:
    method = choice.get("method", "serial" if "profile" in choice else "auto")
    return (method if isinstance(method, str) else method[sensor]) in ("joint", "auto")


@pytest.mark.parametrize("number", range(1, len(CHOICES) + 1))
def test_the_history_holds_the_rows_of_the_methods_that_were_chosen(
    night: tuple[Path, Path, dict[str, Any]], number: int
) -> None:
    _, root, _ = night
    choice, warehouse = CHOICES[number - 1], Warehouse(root)
    rows = warehouse.scan("calibration").filter(vehicle_id=f"sim-{number}", parameter="scale").collect()
    latest = warehouse.sql("SELECT * FROM latest_calibration WHERE vehicle_id = ?", [f"sim-{number}"])
    for sensor in SENSORS:
        assert set(rows.filter(sensor=sensor)["method"]) == expected_methods(choice, sensor), sensor
        if joint_for(choice, sensor):
            flown = latest.filter(sensor=sensor, parameter="scale")
            assert set(flown["method"]) == {"joint"}, sensor
    gyroscope_is_joint = joint_for(choice, "gyroscope")
    fit = warehouse.scan("fit").filter(vehicle_id=f"sim-{number}", sample="held_out").collect()
    assert (fit.height > 0) == gyroscope_is_joint


@pytest.mark.parametrize("number", range(1, len(CHOICES) + 1))
def test_export_and_report_follow(night: tuple[Path, Path, dict[str, Any]], number: int) -> None:
    _, root, _ = night
    vehicle = f"sim-{number}"
    exported = json.loads(PROGRAMS["json"](constants_of(root, vehicle)).text)["sensors"]
    rows = Warehouse(root).sql(
        "SELECT * FROM latest_calibration WHERE vehicle_id = ? AND parameter = 'scale' AND length(axis) = 1", [vehicle]
    )
    for sensor in exported:
        known = rows.filter(sensor=sensor).sort("axis")["value_at_25degc"].to_list()
        assert [exported[sensor]["scale"][i][i] for i in range(3)] == pytest.approx(known, rel=1e-9), sensor
    flight_id = Warehouse(root).scan("flight").filter(vehicle_id=vehicle).collect()["flight_id"][0]
    page = flight_report(root, flight_id).read_text()
    for sensor in SENSORS:
        for method in expected_methods(CHOICES[number - 1], sensor):
            assert method.replace("_", " ") in page, (sensor, method)
