"""What an autopilot had corrected is calibrated as the raw sensor: in closed form, and from simulated flights whose raw
readings an autopilot's own formula turns into logged ones."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from ulog_support import combined, selection

import fieldcal
from fieldcal.config.configuration import Alerts, Tolerances, parse
from fieldcal.config.flight_settings import flight_settings
from fieldcal.config.stage_settings import CompositionSettings
from fieldcal.flows.run import run_night
from fieldcal.logs.dataflash import write as dataflash
from fieldcal.logs.ulog.write import Rows, write_ulog
from fieldcal.names import FIELD_ASSUMED, SENSORS, Method, Sensor
from fieldcal.report.fitness import Criteria, fleet_fitness
from fieldcal.simulation.experiment import simulate
from fieldcal.stages.composition import ORIGIN, compose, in_log
from fieldcal.stages.results import ZERO_SLOPE, triad_rows, zero_slope_rows
from fieldcal.stages.tables import AXES, calibration_rows, constants

LAMBDA = {"gyroscope": (1.02, 0.985, 1.01), "accelerometer": (1.01, 0.99, 1.02), "magnetometer": (1.05, 0.95, 1.1)}
ZERO = {"gyroscope": (0.02, -0.03, 0.015), "accelerometer": (0.2, -0.3, 0.15), "magnetometer": (0.12, -0.08, 0.2)}
"""Of the raw sensors, SI and G."""
DIP_RAD = 1.1
GYRO_ID, ACCEL_ID, MAG_ID = 2621704, 2490378, 590114


def settings(matrix: np.ndarray, offset: np.ndarray, *, known: bool = True) -> CompositionSettings:
    own = dict.fromkeys(SENSORS)
    rows = tuple(tuple(map(float, row)) for row in matrix)
    return CompositionSettings(
        applied_matrix={**own, Sensor.GYROSCOPE: rows},  # type: ignore[dict-item]
        applied_offset={**own, Sensor.GYROSCOPE: tuple(map(float, offset))},  # type: ignore[dict-item]
        applied_known={**own, Sensor.GYROSCOPE: known},
        applied_matrix_sd={**own, Sensor.GYROSCOPE: 0.0},
        applied_offset_sd={**own, Sensor.GYROSCOPE: (0.0, 0.0, 0.0)},
        own_sensors=SENSORS,
        body="frd",
        applied_offset_per_degc=dict.fromkeys(SENSORS),
        gravity_sign="specific_force",
        field_ned=(0.2, 0.0, 0.45),
        field_unit="G",
        field_source="configured",
        rotation_body_from_sensor=((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
        loaded=dict.fromkeys(SENSORS),
    )


def rows_of(scale: np.ndarray, bias: np.ndarray, sensor: Sensor = Sensor.GYROSCOPE) -> pl.DataFrame:
    return calibration_rows(
        triad_rows(
            sensor,
            Method.JOINT,
            scale,
            bias,
            np.diag(np.r_[np.full(3, 1e-6), np.full(3, 1e-8)]),
            unit="rad/s",
            logged_unit="rad/s",
            reference_reading=np.zeros(3),
            temperature_degc=25.0,
            cross_sd=np.full((3, 3), 1e-3),
        )
    )


@pytest.mark.parametrize("square", [True, False])
def test_raw_readings_through_the_composed_constants_are_the_logged_ones_through_the_found(square: bool) -> None:
    rng = np.random.default_rng(0)
    p = np.diag([1.03, 0.98, 1.01]) if square else np.eye(3) + 0.02 * (lambda m: m + m.T)(rng.normal(size=(3, 3)))
    o, bias = rng.normal(size=3), rng.normal(size=3)
    scale = np.diag([1.01, 0.97, 1.02]) if square else np.eye(3) + 0.03 * rng.normal(size=(3, 3))
    result = compose({"calibration": rows_of(scale, bias)}, settings(p, o)).tables["calibration"]
    raw = rng.normal(size=(20, 3))
    found = constants(result.filter(~pl.col("parameter").str.starts_with("residual_")), Sensor.GYROSCOPE)
    assert found is not None
    logged = raw @ p.T + o
    np.testing.assert_allclose(raw @ found[0].T + found[1], logged @ scale.T + bias, atol=1e-12)
    residual = constants(in_log(result), Sensor.GYROSCOPE)
    assert residual is not None
    np.testing.assert_allclose(residual[0], scale, atol=1e-15)
    np.testing.assert_allclose(residual[1], bias, atol=1e-15)


def test_the_sd_is_that_of_the_found_constants_in_raw_units() -> None:
    p = np.diag([2.0, 0.5, 1.0])
    result = compose({"calibration": rows_of(np.eye(3), np.zeros(3))}, settings(p, np.array([0.1, 0.2, 0.3])))
    rows = {(r["parameter"], r["axis"]): r for r in result.tables["calibration"].iter_rows(named=True)}
    assert [rows["scale", a]["sd"] for a in AXES] == pytest.approx([2e-3, 5e-4, 1e-3])
    assert [rows["zero", a]["value"] for a in AXES] == pytest.approx([-0.05, -0.4, -0.3])
    assert [rows["zero", a]["sd"] for a in AXES] == pytest.approx([5e-5, 2e-4, 1e-4])


def test_a_slope_within_the_flight_has_that_of_the_compensation_beside_it() -> None:
    """logged = P raw + o(T): what a compensated reading still follows of the temperature is not all of it."""
    p, o_per_degc, slope = np.diag([2.0, 0.5, 1.0]), np.array([-2e-4, 3e-4, 0.0]), np.array([1e-5, 0.0, 2e-5])
    own = settings(p, np.array([0.1, 0.2, 0.3]))
    own = replace(own, applied_offset_per_degc={**own.applied_offset_per_degc, Sensor.GYROSCOPE: tuple(o_per_degc)})  # type: ignore[dict-item]
    rows = zero_slope_rows(
        Sensor.GYROSCOPE, Method.WARM_UP, slope, np.full(3, 1e-6), logged_unit="rad/s", temperature_degc=25.0
    )
    found = compose({"warm_up": calibration_rows(rows)}, own).tables["calibration"].filter(parameter=ZERO_SLOPE)
    np.testing.assert_allclose(found["value"].to_numpy(), (slope - o_per_degc) / np.diagonal(p))
    np.testing.assert_allclose(found["sd"].to_numpy(), 1e-6 / np.diagonal(p))


def test_what_is_raw_or_only_turned_stays_as_it_is() -> None:
    rows = pl.concat(
        [rows_of(np.diag([1.1, 1.0, 0.9]), np.ones(3)), rows_of(np.eye(3), np.ones(3), Sensor.ACCELEROMETER)]
    )
    alike = compose({"calibration": rows}, settings(np.eye(3), np.zeros(3))).tables["calibration"]
    assert alike.sort(alike.columns).equals(rows.sort(rows.columns))
    assert in_log(rows).equals(rows)


def test_of_an_unknown_correction_nothing_is_said_of_the_raw_sensor() -> None:
    result = compose({"calibration": rows_of(np.eye(3), np.ones(3))}, settings(np.eye(3), np.zeros(3), known=False))
    rows = result.tables["calibration"]
    of_raw = rows.filter(~pl.col("parameter").str.starts_with("residual_"))
    assert set(of_raw["reason_code"]) == {"already_corrected"}
    assert set(in_log(rows)["status"]) == {"ok"}


def raw_readings() -> tuple[np.ndarray, dict[str, np.ndarray], fieldcal.SimulatedFlight]:
    """Times, µs, and readings of the raw sensors of a simulated flight: specific force, body axes, G."""
    flight = simulate(seed=4, dip_rad=DIP_RAD, temperature_degc=(25.0, 25.0))
    e = flight.experiment
    si = {name: flight.counts[name] * np.array(e.scale[name]) + np.array(e.bias[name]) for name in SENSORS}
    si["accelerometer"] = -si["accelerometer"]
    raw = {name: si[name] / np.array(LAMBDA[name]) + np.array(ZERO[name]) for name in SENSORS}
    return np.rint(flight.t * 1e6).astype(np.uint64) + np.uint64(5_000_000), raw, flight


def px4(path: Path) -> None:
    t_us, raw, flight = raw_readings()
    rng = np.random.default_rng(7)
    off = {name: rng.uniform(-0.2, 0.2, 3) for name in SENSORS}
    gain = {name: rng.uniform(0.95, 1.05, 3) for name in SENSORS}
    ids = {"GYRO": GYRO_ID, "ACC": ACCEL_ID, "MAG": MAG_ID}
    of = {"GYRO": "gyroscope", "ACC": "accelerometer", "MAG": "magnetometer"}
    parameters: dict[str, int | float] = {f"CAL_{short}0_ID": number for short, number in ids.items()}
    for short, name in of.items():
        for i, axis in enumerate("XYZ"):
            parameters[f"CAL_{short}0_{axis}OFF"] = float(np.float32(off[name][i]))
            if short != "GYRO":
                parameters[f"CAL_{short}0_{axis}SCALE"] = float(np.float32(gain[name][i]))
    # logged = (raw − OFF) ∘ SCALE; of the gyroscope without a scale.
    logged = {name: (raw[name] - off[name]) * (1.0 if name == "gyroscope" else gain[name]) for name in SENSORS}
    mag = {
        "timestamp": t_us,
        "timestamp_sample": t_us,
        "device_id": np.full(len(t_us), MAG_ID, np.uint32),
        "magnetometer_ga": logged["magnetometer"].astype(np.float32),
    }
    vps_us = np.rint(flight.vps_t * 1e6).astype(np.uint64) + np.uint64(5_000_000)
    pose = {
        "timestamp": vps_us,
        "timestamp_sample": vps_us,
        "position": flight.vps_position.astype(np.float32),
        "q": flight.vps_q[:, [3, 0, 1, 2]].astype(np.float32),
        "pose_frame": np.ones(len(vps_us), np.uint8),
    }
    topics = [
        combined(t_us, logged["gyroscope"], logged["accelerometer"]),
        Rows("vehicle_magnetometer", mag),
        Rows("vehicle_mocap_odometry", pose),
        selection((int(t_us[0]), GYRO_ID, ACCEL_ID)),
    ]
    write_ulog(path, topics, parameters=parameters, infos={"sys_name": "PX4", "ver_hw": "BOARD"})


def ardupilot(path: Path) -> None:
    t_us, raw, _ = raw_readings()
    rng = np.random.default_rng(8)
    parameters = {"AHRS_ORIENTATION": 0.0, "INS_ACC_ID": 1.0, "INS_GYR_ID": 2.0, "COMPASS_DEV_ID": 3.0}
    for i, axis in enumerate("XYZ"):
        parameters[f"INS_GYROFFS_{axis}"] = float(np.float32(rng.uniform(-0.1, 0.1)))
        parameters[f"INS_ACCOFFS_{axis}"] = float(np.float32(rng.uniform(-0.5, 0.5)))
        parameters[f"INS_ACCSCAL_{axis}"] = float(np.float32(rng.uniform(0.97, 1.03)))
        parameters[f"COMPASS_OFS_{axis}"] = float(np.round(rng.uniform(-100, 100)))
        parameters[f"COMPASS_DIA_{axis}"] = float(np.float32(rng.uniform(0.95, 1.05)))
        parameters[f"COMPASS_ODI_{axis}"] = float(np.float32(0.01 * (i + 1)))
    logged = {
        name: dataflash.as_logged(short, raw[name], parameters)
        for short, name in (("GYR", "gyroscope"), ("ACC", "accelerometer"), ("MAG", "magnetometer"))
    }
    offsets = [parameters[f"COMPASS_OFS_{axis}"] for axis in "XYZ"]
    messages = [
        dataflash.imu_messages(t_us.astype(np.int64), logged["gyroscope"], logged["accelerometer"], 35.0),
        dataflash.mag_messages(t_us.astype(np.int64) + 3, logged["magnetometer"], offsets_mg=offsets),
    ]
    dataflash.write_dataflash(path, messages, parameters=parameters, texts=("ArduCopter V4.5.0",))


CONFIGURATION = f"""
[defaults]
field = {{ north_east_down = [{np.cos(DIP_RAD)}, 0.0, {np.sin(DIP_RAD)}], unit = "norm" }}
gravity_mps2 = 9.81
"""


@pytest.mark.parametrize(("write", "ending"), [(px4, "ulg"), (ardupilot, "bin")])
def test_a_night_over_an_autopilots_log_has_the_raw_sensors_constants(
    tmp_path: Path, prefect_server: str, write: object, ending: str
) -> None:
    assert callable(write)
    archive = tmp_path / "archive"
    log = archive / "v" / "2026-05-01" / f"flight.{ending}"
    log.parent.mkdir(parents=True)
    write(log)
    (archive / "fieldcal.toml").write_text(CONFIGURATION)
    assert run_night(archive, tmp_path / "warehouse")["ok"] == 1
    warehouse = fieldcal.Warehouse(tmp_path / "warehouse")
    rows = warehouse.scan("calibration").filter(pl.col("status") == "ok").collect()
    published = 0
    for sensor in SENSORS:
        for i, axis in enumerate(AXES):
            for parameter, truth in (("scale", LAMBDA[sensor][i]), ("zero", ZERO[sensor][i])):
                for row in rows.filter(sensor=sensor, parameter=parameter, axis=axis).iter_rows(named=True):
                    assert abs(row["value"] - truth) < 4.0 * row["sd"], row
                    assert row["sd"] < 0.05
                    published += 1
    assert published >= 16
    residual = rows.filter(parameter="residual_zero", sensor="gyroscope")
    assert (residual["value"] - pl.Series(ZERO["gyroscope"][: len(residual)])).abs().max() > 0.01  # type: ignore[operator]
    limits = Criteria(Alerts(expires_days=1e5, idle_days=1e5), Tolerances(heading_deg=2.0))
    assert "2° of heading" in fleet_fitness(warehouse, limits, datetime.now(UTC))["v"].next
    exported = fieldcal.export(warehouse.calibration_at("v", 25.0), "json").text
    assert "residual" not in exported
    calibration = fieldcal.calibrate(log, config=archive / "fieldcal.toml")
    _, logged = calibration.recording.readings("gyroscope")
    _, z = fieldcal.apply(calibration.recording, calibration).readings["gyroscope"]
    np.testing.assert_allclose(z, calibration.gyroscope.apply(logged), atol=1e-9)


@pytest.mark.parametrize(
    ("source", "field", "dip", "share"),
    [
        ("configured", (0.2, 0.0, 0.45), 0.3, 0.2 / np.hypot(0.2, 0.45)),
        (FIELD_ASSUMED, (1.0, 0.0, 0.0), 0.3, np.cos(0.3)),
        (FIELD_ASSUMED, (1.0, 0.0, 0.0), None, None),
    ],
)
def test_how_level_the_field_is_goes_by_the_known_one_else_by_the_dip_of_the_flight(
    source: str, field: tuple[float, float, float], dip: float | None, share: float | None
) -> None:
    rows = rows_of(np.eye(3), np.zeros(3), Sensor.MAGNETOMETER)
    own = rows.head(1).with_columns(parameter=pl.lit("dip"), value=pl.lit(dip, pl.Float64))
    poorer = own.with_columns(value=pl.lit(1.2), sd=pl.lit(9.0))
    if dip is not None:
        rows = pl.concat([rows, poorer, own])
    of = replace(settings(np.eye(3), np.zeros(3)), field_source=source, field_ned=field)
    origin = compose({"calibration": rows}, of).measured[ORIGIN]
    assert isinstance(origin, dict)
    assert origin["horizontal_share"] == (None if share is None else pytest.approx(share))


def test_the_settings_of_a_flight_know_nothing_of_an_autopilot_by_themselves() -> None:
    own = flight_settings(parse("", None).vehicle("v"), units=dict.fromkeys(SENSORS, "counts"))
    assert set(own.applied_matrix.values()) == {None}
