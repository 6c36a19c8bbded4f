"""MCAP logs as they were met, each with what its README calls right. Needs FIELDCAL_EXAMPLE_LOGS."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from example_logs import needs_examples
from test_csv_cases import CASES, TRUE_LAG_S, as_in_base, calibrated, findings, lag, scales

import fieldcal
from fieldcal.schemas.rows import FlightDocument

pytestmark = needs_examples


def absent(document: FlightDocument) -> None:
    assert set(findings(document)) == {"missing_topic"}
    as_in_base(document)


def unstamped(document: FlightDocument) -> None:
    assert "the time of recording is used" in findings(document)["no_header_stamp"]
    as_in_base(document)
    sync = document["sync"]
    assert sync is not None
    # The recorder's stamps of IMU and VPS are late by different transports.
    assert sync["lag_mid_s"] == pytest.approx(TRUE_LAG_S, abs=5e-3)


def boot_clock(document: FlightDocument) -> None:
    told = findings(document)["clocks_apart"]
    assert "clocks of magnetometer and IMU do not overlap: 7400 readings" in told


def with_vps(document: FlightDocument) -> None:
    as_in_base(document)
    lag(document)


def transforms(document: FlightDocument) -> None:
    assert "/tf" in findings(document)["unsupported_schema"]
    as_in_base(document)


def two_imus(document: FlightDocument) -> None:
    assert document["flight"]["reason_code"] == "several_units"
    assert "imu_left, imu_right" in str(document["flight"]["reason"])


def estimate(document: FlightDocument) -> None:
    assert "the vehicle's own estimate" in findings(document)["vps_is_estimate"]


CHECKS: list[tuple[str, str, Callable[[FlightDocument], None]]] = [
    ("m_configured_vps_absent", "fieldcal.toml", absent),
    ("m_configured_vps_absent", "fieldcal_temperature.toml", absent),
    ("m_header_stamp_zero", "fieldcal.toml", unstamped),
    ("m_mag_boot_clock", "fieldcal.toml", boot_clock),
    ("m_message_compression", "fieldcal.toml", with_vps),
    ("m_odom_and_goal", "fieldcal.toml", with_vps),
    ("m_realsense_split", "fieldcal.toml", with_vps),
    ("m_ros1", "fieldcal.toml", with_vps),
    ("m_tf", "fieldcal.toml", transforms),
    ("m_tf", "fieldcal_vps_tf.toml", transforms),
    ("m_two_imus_one_topic", "fieldcal.toml", two_imus),
    ("m_ekf_pose_as_vps", "fieldcal.toml", estimate),
]


@pytest.mark.parametrize(("case", "config", "check"), CHECKS, ids=[f"{case}-{config}" for case, config, _ in CHECKS])
def test_what_is_right_of_a_case(case: str, config: str, check: Callable[[FlightDocument], None]) -> None:
    check(calibrated(case, "log.mcap", config))


@pytest.mark.parametrize(("frame", "factor"), [("imu_left", 1.0), ("imu_right", 1 / 1.05)])
def test_one_of_two_imus_is_chosen(tmp_path: Path, frame: str, factor: float) -> None:
    folder = CASES / "m_two_imus_one_topic"
    text = (folder / "fieldcal.toml").read_text() + f'\n[defaults.mcap]\nframe_id = "{frame}"\n'
    (tmp_path / "fieldcal.toml").write_text(text)
    document = fieldcal.calibrate(folder / "log.mcap", method="serial", config=tmp_path / "fieldcal.toml").document
    assert scales(document) == pytest.approx([factor * scale for scale in (1.02, 0.985, 1.01)], rel=0.025)
    other = fieldcal.calibrate(
        folder / "log.mcap", method="serial", config=tmp_path / "fieldcal.toml", unit="imu.1"
    ).document
    (unit_id,) = {row["unit_id"] for row in other["calibration"]}
    left_out = {"imu_left": "imu_right", "imu_right": "imu_left"}[frame]
    assert unit_id.endswith(f":{left_out}")
    others_factor = {1.0: 1 / 1.05, 1 / 1.05: 1.0}[factor]
    assert scales(other) == pytest.approx([others_factor * scale for scale in (1.02, 0.985, 1.01)], rel=0.025)
