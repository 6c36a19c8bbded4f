"""Several IMUs and magnetometers in one log: each a unit of its own through night, history, trends, export and report.

Every unit has other constants, drawn at random, and other parameters in its autopilot; their histories are the raw
sensors'. The log's first IMU and magnetometer are the primary ones, with which the vehicle flew.
"""

from __future__ import annotations

import dataclasses
import json
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from outside_ci import outside_ci

import fieldcal
from fieldcal.flows.run import dry_run, run_night
from fieldcal.logs.dataflash import write as dataflash
from fieldcal.logs.mcap import write as mcap
from fieldcal.logs.ulog.write import Rows, write_ulog
from fieldcal.names import SENSORS
from fieldcal.report import write_flight_report, write_vehicle_report
from fieldcal.simulation.experiment import SimulatedFlight, simulate
from fieldcal.stages.tables import AXES

DIP_RAD = 1.1
IMUS, MAGNETOMETERS = 3, 2
TOO_FAR_SD = 4.0
LARGEST_SHARE = 0.05
"""Of a scale, or of 1 rad/s, m/s² or G, that a standard deviation may be: beyond it nothing was calibrated."""
EPOCH_NS = 1_700_000_000_000_000_000
LEAST_ROWS = 4
"""Scales and zeros of a triad: one axis may be refused."""
CONFIGURATION = f"""
[defaults]
field = {{ north_east_down = [{np.cos(DIP_RAD)}, 0.0, {np.sin(DIP_RAD)}], unit = "norm" }}
gravity_mps2 = 9.81
"""
LOG = Path("v") / "2026-05-01"


@dataclasses.dataclass(frozen=True)
class Truth:
    """z = scale · (raw − zero), by sensor."""

    scale: Mapping[str, np.ndarray]
    zero: Mapping[str, np.ndarray]

    @classmethod
    def drawn(cls, seed: int) -> Truth:
        rng = np.random.default_rng(seed)
        spread = {"gyroscope": 0.04, "accelerometer": 0.3, "magnetometer": 0.1}
        return cls(
            {sensor: rng.uniform(0.97, 1.03, 3) for sensor in SENSORS},
            {sensor: rng.uniform(-spread[sensor], spread[sensor], 3) for sensor in SENSORS},
        )


TRUTHS = [Truth.drawn(seed) for seed in range(100, 100 + IMUS)]
FLIGHT_SEED = 4


def flown() -> tuple[np.ndarray, Callable[[Truth], dict[str, np.ndarray]], SimulatedFlight]:
    """Stamps, µs; what the raw sensors with some constants read, each with noise of its own; the flight."""
    flight = simulate(seed=FLIGHT_SEED, dip_rad=DIP_RAD, temperature_degc=(25.0, 25.0))
    e = flight.experiment
    si = {name: flight.counts[name] * np.array(e.scale[name]) + np.array(e.bias[name]) for name in SENSORS}
    si["accelerometer"] = -si["accelerometer"]

    def raw(truth: Truth) -> dict[str, np.ndarray]:
        return {name: si[name] / truth.scale[name] + truth.zero[name] for name in SENSORS}

    return np.rint(flight.t * 1e6).astype(np.int64) + 5_000_000, raw, flight


def ardupilot(path: Path) -> dict[str, list[str]]:
    """Three IMUs and two compasses with random parameters of each."""
    t_us, raw, _ = flown()
    rng = np.random.default_rng(8)
    parameters: dict[str, float] = {"AHRS_ORIENTATION": 0.0}
    for k in range(IMUS):
        number = str(k + 1) if k else ""
        for axis in "XYZ":
            own = {
                f"INS_GYR{number}OFFS_{axis}" if k else f"INS_GYROFFS_{axis}": rng.uniform(-0.1, 0.1),
                f"INS_ACC{number}OFFS_{axis}": rng.uniform(-0.5, 0.5),
                f"INS_ACC{number}SCAL_{axis}": rng.uniform(0.97, 1.03),
                f"COMPASS_OFS{number}_{axis}": np.round(rng.uniform(-100, 100)),
                f"COMPASS_DIA{number}_{axis}": rng.uniform(0.95, 1.05),
                f"COMPASS_ODI{number}_{axis}": rng.uniform(-0.03, 0.03),
            }
            parameters |= {name: float(np.float32(value)) for name, value in own.items()}
        parameters |= {f"INS_ACC{number}_ID": 10.0 + k, f"INS_GYR{number}_ID": 20.0 + k}
        parameters[f"COMPASS_DEV_ID{number}"] = 30.0 + k
    messages = []
    for k, truth in enumerate(TRUTHS):
        logged = {
            name: dataflash.as_logged(short, raw(truth)[name], parameters, slot=k)
            for short, name in (("GYR", "gyroscope"), ("ACC", "accelerometer"), ("MAG", "magnetometer"))
        }
        imu = dataflash.imu_messages(t_us + k, logged["gyroscope"], logged["accelerometer"], 35.0 + k, instance=k)
        messages.append(imu)
        if k < MAGNETOMETERS:
            offsets = [parameters[f"COMPASS_OFS{k + 1 if k else ''}_{axis}"] for axis in "XYZ"]
            field = dataflash.mag_messages(t_us + 5 + k, logged["magnetometer"], offsets_mg=offsets, instance=k)
            messages.append(field)
    dataflash.write_dataflash(path, messages, parameters=parameters, texts=("ArduCopter V4.5.0",))
    return ids([f"v/{20 + k}" for k in range(IMUS)], [f"v/{30 + k}" for k in range(MAGNETOMETERS)])


def px4(path: Path) -> dict[str, list[str]]:
    """Three IMUs and two magnetometers as their drivers log them: raw."""
    t_us, raw, _ = flown()
    topics = []
    for k, truth in enumerate(TRUTHS):
        readings = raw(truth)
        for topic, sensor, device in (
            ("sensor_gyro", "gyroscope", 200),
            ("sensor_accel", "accelerometer", 200),
            ("sensor_mag", "magnetometer", 300),
        ):
            columns: dict[str, np.ndarray] = {
                "timestamp": t_us.astype(np.uint64),
                "timestamp_sample": t_us.astype(np.uint64),
                "device_id": np.full(len(t_us), device + k, np.uint32),
                "temperature": np.full(len(t_us), 40.0 + k, np.float32),
                **{axis: readings[sensor][:, i].astype(np.float32) for i, axis in enumerate(AXES)},
            }
            if sensor != "magnetometer" or k < MAGNETOMETERS:
                topics.append(Rows(topic, columns, k))
    ids_of_slots = {f"CAL_{short}{k}_ID": 202 - k for short in ("GYRO", "ACC") for k in range(IMUS)}
    ids_of_slots |= {f"CAL_MAG{k}_ID": 301 - k for k in range(MAGNETOMETERS)}
    write_ulog(path, topics, parameters=ids_of_slots, infos={"sys_name": "PX4", "ver_hw": "BOARD", "sys_uuid": "0042"})
    return ids([f"0042/{200 + k}" for k in range(IMUS)], [f"0042/{300 + k}" for k in range(MAGNETOMETERS)])


def ros(path: Path) -> dict[str, list[str]]:
    """Three IMUs, two magnetometers and a VPS on topics of their own; the configuration names the further units."""
    t_us, raw, flight = flown()
    t_ns = t_us * 1000 + EPOCH_NS
    vps_ns = np.rint(flight.vps_t * 1e9).astype(np.int64) + int(t_us[0]) * 1000 + EPOCH_NS
    channels = [mcap.pose_channel(vps_ns, vps_ns + 4_000_000, flight.vps_q, flight.vps_position)]
    for k, truth in enumerate(TRUTHS):
        readings, later = raw(truth), t_ns + 400_000 + k
        channels.append(
            mcap.imu_channel(t_ns, later, readings["gyroscope"], readings["accelerometer"], topic=f"/imu{k}")
        )
        if k < MAGNETOMETERS:
            field = mcap.magnetic_field_channel(t_ns, later, readings["magnetometer"] * TESLA)
            channels.append(dataclasses.replace(field, topic=f"/mag{k}"))
    mcap.write_mcap(path, channels)
    return ids(["v", "v//imu1", "v//imu2"], ["v", "v//mag1"])


def ids(imus: list[str], magnetometers: list[str]) -> dict[str, list[str]]:
    """Sensor → unit_id of each of its units, the primary one first."""
    return {"gyroscope": imus, "accelerometer": imus, "magnetometer": magnetometers}


WRITERS = {"bin": ardupilot, "ulg": px4, "mcap": ros}
TESLA = 1e-4
"""Of a gauss; only the log of messages is in tesla."""
TOPICS = """
[vehicles.v]
body = "frd"
world = "ned"
[vehicles.v.mcap]
imu = "/imu0"
magnetometer = "/mag0"
further = ["/imu1", "/imu2", "/mag1"]
"""


@dataclasses.dataclass(frozen=True)
class Night:
    """A night over one log of several units, of one format."""

    kind: str
    archive: Path
    log: Path
    root: Path
    ids: Mapping[str, list[str]]

    @property
    def warehouse(self) -> fieldcal.Warehouse:
        return fieldcal.Warehouse(self.root)

    def truth(self, sensor: str, place: int, parameter: str) -> np.ndarray:
        own = TRUTHS[place]
        tesla = TESLA if (self.kind, sensor) == ("mcap", "magnetometer") else 1.0
        return own.scale[sensor] / tesla if parameter == "scale" else own.zero[sensor] * tesla


@pytest.fixture(scope="module", params=WRITERS)
def night(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory, prefect_server: str) -> Night:
    kind = request.param
    archive = tmp_path_factory.mktemp(kind) / "archive"
    log = archive / LOG / f"flight.{kind}"
    log.parent.mkdir(parents=True)
    units = WRITERS[kind](log)
    (archive / "fieldcal.toml").write_text(CONFIGURATION + (TOPICS if kind == "mcap" else ""))
    root = archive.parent / "warehouse"
    result = run_night(archive, root)
    assert [one["verdict"] for one in result["logs"]] == ["ok"], result["logs"]
    assert "further_units" in [finding["code"] for finding in result["logs"][0]["findings"]]
    return Night(kind, archive, log, root, units)


def test_each_unit_has_its_own_constants(night: Night) -> None:
    rows = night.warehouse.scan("calibration").filter(pl.col("status") == "ok").collect()
    for sensor, units in night.ids.items():
        assert set(rows.filter(sensor=sensor)["unit_id"]) == set(units)
        for place, unit_id in enumerate(units):
            own = rows.filter(sensor=sensor, unit_id=unit_id)
            assert own["is_primary"].unique().to_list() == [place == 0]
            published = own.filter(pl.col("parameter").is_in(["scale", "zero"]), pl.col("axis").is_in(AXES))
            assert len(published) >= LEAST_ROWS, (sensor, unit_id)
            for row in published.iter_rows(named=True):
                truth = night.truth(sensor, place, row["parameter"])[AXES.index(row["axis"])]
                assert abs(row["value"] - truth) < TOO_FAR_SD * row["sd"], row
                whole = abs(truth) if row["parameter"] == "scale" else 1.0
                assert row["sd"] < LARGEST_SHARE * whole


def test_each_unit_has_runs_agreement_and_trends_of_its_own(night: Night) -> None:
    warehouse = night.warehouse
    imus, magnetometers = night.ids["gyroscope"], night.ids["magnetometer"]
    runs = warehouse.scan("run").collect()
    assert set(runs["unit_id"]) == {*imus, *magnetometers[1:]}
    stages = runs.filter(unit_id=imus[0])["stage"].to_list()
    assert runs.filter(unit_id=imus[1])["stage"].to_list() == [stage for stage in stages if stage != "ingest"]
    assert set(warehouse.scan("fit").collect()["unit_id"]) == set(imus)
    sync = warehouse.scan("sync").collect()
    assert sync["unit_id"].to_list() == (sorted(imus) if night.kind == "mcap" else [])
    _, _, flight = flown()
    late = (sync["lag_mid_s"] - flight.lag_at(flight.t.mean())).abs()
    assert (late < TOO_FAR_SD * sync["lag_sd_s"]).all(), late
    drift = warehouse.scan("drift").collect()
    for sensor, units in night.ids.items():
        assert set(drift.filter(sensor=sensor)["unit_id"]) == set(units)


def test_a_flight_is_exported_by_its_primary_units_or_by_the_one_that_is_named(night: Night) -> None:
    for unit in (None, night.ids["gyroscope"][2], night.ids["magnetometer"][1]):
        constants = night.warehouse.calibration_at("v", unit=unit)
        sensors = [sensor for sensor in SENSORS if unit is None or unit in night.ids[sensor]]
        assert set(constants.triads) == set(sensors)
        told = json.loads(fieldcal.export(constants, "json").text)["unit_ids"]
        for sensor in sensors:
            own = night.ids[sensor][0] if unit is None else unit
            assert told[sensor] == constants.unit_ids[sensor] == own
            truth = night.truth(sensor, night.ids[sensor].index(own), "scale")
            np.testing.assert_allclose(np.diagonal(constants.triads[sensor].scale), truth, rtol=LARGEST_SHARE)
    with pytest.raises(fieldcal.FieldcalError, match=f"of unit 'none'; there is: .*{night.ids['gyroscope'][0]}"):
        night.warehouse.calibration_at("v", unit="none")


@pytest.mark.parametrize("night", ["bin", "ulg"], indirect=True)
def test_every_unit_is_exported_into_the_slot_of_its_device(night: Night) -> None:
    """Of PX4 the slots are numbered against the order of the units."""
    to = {"bin": "ardupilot", "ulg": "px4"}[night.kind]
    export = fieldcal.export(night.warehouse.calibration_at("v"), to)
    lines = [line for line in export.text.splitlines() if not line.startswith("#")]
    rows = [line.split("\t")[2:4] if to == "px4" else line.split(",") for line in lines]
    assert len({name for name, _ in rows}) == len(rows)
    p = {name: float(value) for name, value in rows}
    for place in range(IMUS):
        number = "" if place == 0 else str(place + 1)
        names = {"gyroscope": f"INS_GYR{number}OFFS_?", "accelerometer": f"INS_ACC{number}OFFS_?"}
        if to == "px4":
            slot = IMUS - 1 - place
            names = {"gyroscope": f"CAL_GYRO{slot}_?OFF", "accelerometer": f"CAL_ACC{slot}_?OFF"}
        for sensor, name in names.items():
            found = np.array([p[name.replace("?", axis)] for axis in "XYZ"])
            np.testing.assert_allclose(found, night.truth(sensor, place, "zero"), rtol=0, atol=LARGEST_SHARE)
    left_out = [told for told in export.warnings if "left out" in told]
    assert len(left_out) == MAGNETOMETERS
    assert all(told.startswith("magnetometer") and "in norm" in told for told in left_out)


@outside_ci
@pytest.mark.parametrize("night", ["bin"], indirect=True)
def test_reports_tell_the_units_apart(night: Night) -> None:
    flight = night.warehouse.scan("flight").collect()["flight_id"][0]
    page = write_flight_report(night.root, flight).read_text()
    assert "Further units on board" in page
    vehicle = write_vehicle_report(night.root, "v").read_text()
    for units in night.ids.values():
        assert all(f"Unit {unit}" in vehicle for unit in units)
        assert all(unit in page for unit in units[1:])


def test_nothing_runs_again_and_one_unit_is_calibrated_by_itself(night: Night) -> None:
    again = run_night(night.archive, night.root)
    assert (again["stages_run"], again["stages_cached"] > 0) == (0, True)
    assert dry_run(night.archive, night.root, None, None)["stages_to_run"] == 0
    own = fieldcal.calibrate(night.log, config=night.archive / "fieldcal.toml", unit="imu.1").document["calibration"]
    rows = night.warehouse.scan("calibration").filter(pl.col("unit_id") == night.ids["gyroscope"][1]).collect()
    place = ("sensor", "method", "parameter", "axis", "value", "sd", "status", "unit_id", "is_primary")
    assert sorted(tuple(row[name] for name in place) for row in own) == sorted(rows.select(place).rows())
    with pytest.raises(
        fieldcal.FieldcalError, match=r"no unit 'imu\.7'; there is imu, imu\.1, imu\.2, magnetometer\.1"
    ):
        fieldcal.calibrate(night.log, config=night.archive / "fieldcal.toml", unit="imu.7")


@outside_ci
def test_the_further_units_are_left_out_where_only_the_primary_ones_are_asked_for(night: Night, tmp_path: Path) -> None:
    config = tmp_path / "fieldcal.toml"
    text = (night.archive / "fieldcal.toml").read_text()
    config.write_text(text.replace("[defaults]", '[defaults]\nunits_on_board = "primary"'))
    root = tmp_path / "warehouse"
    run_night(night.archive, root, config)
    rows = fieldcal.Warehouse(root).scan("calibration").collect()
    assert set(rows["unit_id"]) == {units[0] for units in night.ids.values()}
    whole = night.warehouse.scan("calibration").filter(pl.col("is_primary")).collect()
    assert rows.drop("run_key").equals(whole.drop("run_key"))


@pytest.mark.parametrize("night", ["mcap"], indirect=True)
def test_another_imu_id_holds_for_new_flights_and_a_dated_one_for_all(night: Night, tmp_path: Path) -> None:
    root = tmp_path / "warehouse"
    shutil.copytree(night.root, root)
    config = tmp_path / "fieldcal.toml"
    text = (night.archive / "fieldcal.toml").read_text()

    def units(imu_id: str) -> set[tuple[str, str]]:
        config.write_text(text.replace("[vehicles.v]\n", f"[vehicles.v]\nimu_id = {imu_id}\n"))
        assert run_night(night.archive, root, config)["stages_run"] == 0
        rows = fieldcal.Warehouse(root).scan("calibration").select("imu_id", "unit_id").unique().collect()
        return set(rows.rows())

    others = ("//imu1", "//imu2", "//mag1")
    assert units('"B"') == {("v", "v"), *(("v", f"v{other}") for other in others)}
    later = '[{ id = "C" }, { id = "D", from = 2030-01-01 }]'
    assert units(later) == {("C", "C"), *(("C", f"C{other}") for other in others)}
    assert units('[{ id = "D", from = 2030-01-01 }]') == {("v", "v"), *(("v", f"v{other}") for other in others)}
