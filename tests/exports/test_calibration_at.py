"""`fieldcal export` and `fieldcal apply` on a simulated vehicle whose calibration is in a warehouse."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
from mcap.reader import make_reader
from mcap_ros2.reader import read_ros2_messages
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

import fieldcal
from fieldcal.cli.main import run
from fieldcal.config.configuration import load
from fieldcal.exports.calibration_at import constants_of
from fieldcal.geometry.frames import FRD_FROM_FLU
from fieldcal.logs import ingest, log_sha256
from fieldcal.logs.mcap.write import imu_channel, write_mcap
from fieldcal.schemas.frames import empty_frame
from fieldcal.simulation.archive import write_flights
from fieldcal.simulation.experiment import Experiment
from fieldcal.stages.tables import matrix, triad
from fieldcal.warehouse.publish import publish

EQUAL = 1e-9
ROUNDING = 1e-12


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    archive = tmp_path_factory.mktemp("fly") / "archive"
    return write_flights(archive, Experiment(seed=8, duration_s=25.0, temperature_degc=(20.0, 24.0)))[0]


@pytest.fixture(scope="module")
def root(log: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The flight's calibration, and another axis of it for what a full matrix would leave behind."""
    root = tmp_path_factory.mktemp("fly") / "warehouse"
    document = fieldcal.calibrate(log).document
    lead = {k: document["flight"][k] for k in ("flight_id", "vehicle_id", "imu_id", "session_id", "started_at")}
    rows = [{**row, **lead} for row in document["calibration"]]
    schema = empty_frame("calibration").schema
    frame = pl.DataFrame(rows, schema=schema, strict=False)
    publish(root, lead["vehicle_id"], {"calibration": frame}, [lead["flight_id"]])
    return root


@pytest.fixture(scope="module")
def wanted(log: Path, root: Path) -> dict[str, np.ndarray]:
    """Eq. 5 by hand: scale · counts + bias with the flight's own constants."""
    signals, _ = ingest.read_flight(log, load(log.parents[2] / "fieldcal.toml").vehicle("sim-1"))
    document = fieldcal.calibrate(log).document
    rows = {(r["sensor"], r["parameter"], r["axis"], r["method"]): r["value"] for r in document["calibration"]}
    result = {}
    for sensor in ("gyroscope", "accelerometer", "magnetometer"):
        scale, bias = (np.array([rows[sensor, p, axis, "joint"] for axis in "xyz"]) for p in ("scale", "bias"))
        table = signals["magnetometer" if sensor == "magnetometer" else "imu"]
        result[sensor] = scale * matrix(table, triad(sensor)) + bias
    return result


def same(found: np.ndarray, other: np.ndarray) -> bool:
    return bool(np.abs(found - other).max() <= EQUAL * np.abs(other).max())


def test_parquet_is_eq_5(log: Path, root: Path, wanted: dict[str, np.ndarray], tmp_path: Path) -> None:
    before = log_sha256(log)
    assert run(["apply", str(log), "-o", str(tmp_path / "out"), "--warehouse", str(root)]) == 0
    imu, magnetometer = (pl.read_parquet(tmp_path / "out" / f"{name}.parquet") for name in ("imu", "magnetometer"))
    for sensor, values in wanted.items():
        assert same(matrix(magnetometer if sensor == "magnetometer" else imu, triad(sensor)), values)
    facts = pl.read_parquet_metadata(tmp_path / "out" / "imu.parquet")
    assert facts["vehicle_id"] == "sim-1"
    assert log_sha256(log) == before


def test_mcap_is_rep_103(log: Path, root: Path, wanted: dict[str, np.ndarray], tmp_path: Path) -> None:
    """Read by another decoder: forward-left-up, specific force (+g up at rest), rates the same rotation."""
    path = tmp_path / "out.mcap"
    assert run(["apply", str(log), "-o", str(path), "--warehouse", str(root)]) == 0
    imu: list[Any] = [m.ros_msg for m in read_ros2_messages(str(path), topics=["/imu/data"])]
    rate, force = (
        np.array([[v.x, v.y, v.z] for v in (getattr(m, name) for m in imu)])
        for name in ("angular_velocity", "linear_acceleration")
    )
    assert same(rate, wanted["gyroscope"] @ FRD_FROM_FLU)
    assert same(force, -wanted["accelerometer"] @ FRD_FROM_FLU)
    assert np.median(force[:, 2]) > 0.8 * 9.81
    assert imu[0].orientation_covariance[0] == -1.0
    field = [m.ros_msg.magnetic_field for m in read_ros2_messages(str(path), topics=["/imu/mag_norm"])]
    assert same(np.array([[v.x, v.y, v.z] for v in field]), wanted["magnetometer"] @ FRD_FROM_FLU)
    assert not list(tmp_path.glob("*.part"))


@pytest.mark.parametrize("release", [Stores.ROS2_HUMBLE, Stores.ROS2_JAZZY])
def test_mcap_holds_the_messages_that_ros_2_defines(log: Path, root: Path, tmp_path: Path, release: Stores) -> None:
    """Definitions and decoder of `rosbags`, which shares nothing with ours: schemas field by field, payloads byte by
    byte; names, encodings and times as a ROS 2 recorder leaves them."""
    path = tmp_path / "out.mcap"
    assert run(["apply", str(log), "-o", str(path), "--warehouse", str(root)]) == 0
    store = get_typestore(release)
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        assert reader.get_header().profile == "ros2"
        summary = reader.get_summary()
        assert summary is not None
        assert {c.topic: summary.schemas[c.schema_id].name for c in summary.channels.values()} == {
            "/imu/data": "sensor_msgs/msg/Imu",
            "/imu/mag_norm": "sensor_msgs/msg/MagneticField",
            "/imu/temperature": "sensor_msgs/msg/Temperature",
        }
        for schema in summary.schemas.values():
            assert schema.encoding == "ros2msg"
            for name, definition in get_types_from_msg(schema.data.decode(), schema.name).items():
                assert definition == store.fielddefs[name], name
        count = 0
        for schema, channel, message in reader.iter_messages():
            assert channel.message_encoding == "cdr"
            decoded: Any = store.deserialize_cdr(message.data, schema.name)
            assert bytes(store.serialize_cdr(decoded, schema.name)) == message.data
            stamp = decoded.header.stamp
            assert stamp.sec * 10**9 + stamp.nanosec == message.publish_time == message.log_time
            assert decoded.header.frame_id == "base_link"
            if schema.name == "sensor_msgs/msg/Imu":
                # −1: no orientation; 0: a covariance that is not known
                assert decoded.orientation_covariance.tolist() == [-1.0] + [0.0] * 8
                assert not decoded.angular_velocity_covariance.any()
                assert not decoded.linear_acceleration_covariance.any()
            count += 1
    assert count == sum(summary.statistics.channel_message_counts.values()) > 5000


def test_a_sensor_that_the_log_lacks_is_marked_in_its_message(tmp_path: Path) -> None:
    t, rate = np.arange(3), np.ones((3, 3))
    write_mcap(tmp_path / "x.mcap", [imu_channel(t, None, rate, np.full((3, 3), np.nan))])
    (first, *_) = [m.ros_msg for m in read_ros2_messages(str(tmp_path / "x.mcap"))]
    assert first.linear_acceleration_covariance[0] == -1.0
    assert first.angular_velocity_covariance[0] == 0.0


@pytest.mark.parametrize("form", ["px4", "ardupilot"])
def test_counts_are_refused(form: str, root: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    capsys.readouterr()
    place = tmp_path / "x"
    assert run(["export", "sim-1", "-f", form, "--logged-raw", "-o", str(place), "--warehouse", str(root)]) == 2
    told = capsys.readouterr()
    assert told.out == ""
    assert "in counts" in told.err
    assert not place.exists()


@pytest.mark.parametrize("form", ["ros", "kalibr", "json", "c"])
def test_export_goes_to_stdout_or_into_a_file(
    form: str, root: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    capsys.readouterr()
    assert run(["export", "sim-1", "--format", form, "--warehouse", str(root)]) == 0
    told = capsys.readouterr()
    assert told.out
    assert run(["export", "sim-1", "-f", form, "-o", str(tmp_path / "x"), "--warehouse", str(root)]) == 0
    assert (tmp_path / "x").read_text() == told.out


def test_json_export_gives_what_apply_gives(
    log: Path, root: Path, wanted: dict[str, np.ndarray], capsys: pytest.CaptureFixture[str]
) -> None:
    capsys.readouterr()
    assert run(["export", "sim-1", "--warehouse", str(root)]) == 0
    document = json.loads(capsys.readouterr().out)
    signals, _ = ingest.read_flight(log, load(log.parents[2] / "fieldcal.toml").vehicle("sim-1"))
    for sensor, values in wanted.items():
        constants = document["sensors"][sensor]
        raw = matrix(signals["magnetometer" if sensor == "magnetometer" else "imu"], triad(sensor))
        assert same((raw - np.array(constants["zero"])) @ np.array(constants["scale"]).T, values)
        assert constants["raw_unit"] == "counts"
    assert document["sensors"]["gyroscope"]["unit"] == "rad/s"
    assert document["sensors"]["accelerometer"]["unit"] == "m/s^2"
    assert document["sensors"]["magnetometer"]["unit"] == "norm"
    assert "no trend" in document["sensors"]["gyroscope"]["why"][0]


def test_a_temperature_slope_is_applied_sample_by_sample(root: Path) -> None:
    t = constants_of(root, "sim-1").triads["gyroscope"]
    sloped = replace(t, zero_per_degc=np.array([1.0, 2.0, 3.0]), scale_per_degc=1e-3 * t.scale)
    raw = np.full((3, 3), 30000.0)
    found = sloped.apply(raw, np.array([25.0, 35.0, np.nan]))
    assert found[0] == pytest.approx(t.apply(raw)[0], rel=ROUNDING)
    assert found[2] == pytest.approx(t.apply(raw)[2], rel=ROUNDING)
    by_hand = 1.01 * np.diagonal(t.scale) * (raw[1] - t.zero - np.array([10.0, 20.0, 30.0]))
    assert found[1] == pytest.approx(by_hand, rel=ROUNDING)


@pytest.mark.parametrize(
    ("tokens", "code", "part"),
    [
        (["apply", "{log}", "-o", "{log}"], 2, "only ever read"),
        (["apply", "{log}.none", "-o", "{out}"], 2, "There is no log"),
        (["apply", "{log}", "-o", "{out}", "--vehicle", "other"], 1, "No calibration of vehicle 'other'"),
        (["export", "other"], 1, "there is: sim-1"),
    ],
)
def test_mistakes_are_explained(
    tokens: list[str], code: int, part: str, log: Path, root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = log_sha256(log)
    capsys.readouterr()
    full = [token.format(log=log, out=tmp_path / "out") for token in tokens]
    assert run([*full, "--warehouse", str(root)]) == code
    told = capsys.readouterr()
    assert told.out == ""
    assert part in told.err
    assert log_sha256(log) == before
