"""Real recordings: counts, losses and values that their own description states. Needs FIELDCAL_EXAMPLE_LOGS."""

from __future__ import annotations

import csv
import json
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from example_logs import EXAMPLES, needs_examples
from logs_support import messages_by_mcap_ros2, stamp_ns

from fieldcal.config.configuration import Configuration, load
from fieldcal.errors import UnreadableLog
from fieldcal.logs import find_logs, open_log, read_log
from fieldcal.logs.ingest import read_flight, settings_of
from fieldcal.stages.pipeline import PIPELINE
from fieldcal.stages.stage import run_stage

pytestmark = needs_examples
TABLES = {"/imu/data_raw": "imu", "/imu/mag": "magnetometer", "/vps/pose": "vps"}


@pytest.fixture(scope="module")
def configuration() -> Configuration:
    return load(EXAMPLES / "fieldcal.toml")


@pytest.fixture(scope="module")
def expected() -> dict[str, Any]:
    stated: dict[str, Any] = json.loads((EXAMPLES / "expected.json").read_text())
    return stated


def test_every_log_is_read_or_refused(configuration: Configuration) -> None:
    refused = {}
    for log in find_logs(EXAMPLES):
        try:
            reader = open_log(log.path, configuration.vehicle(log.vehicle_id))
            assert sum(len(columns["t_ns"]) for _, columns in reader.batches()) > 1000
        except UnreadableLog as error:
            refused[log.path.name] = error.reason_code
    assert refused == {"empty.mcap": "empty_file"}


def test_damaged_mcap_gives_exactly_the_salvageable_messages(
    configuration: Configuration, expected: dict[str, Any]
) -> None:
    for uri, stated in expected.items():
        if "salvageable_messages" not in stated:
            continue
        frames, summary = read_log(EXAMPLES / uri, configuration.vehicle("damaged-si"))
        assert summary.counts == {TABLES[topic]: n for topic, n in stated["salvageable_messages"].items()}
        assert [finding.code for finding in summary.findings] == [
            "damaged_chunk" if "lost_messages" in stated else "truncated"
        ]
        for topic, lost in stated.get("lost_messages", {}).items():
            assert f"{topic} {lost}" in summary.findings[0].sentence
        sound, _ = read_log(EXAMPLES / "broad-imu-1/2026-05-11-B/broad_02.mcap", configuration.vehicle("broad-imu-1"))
        for table, frame in frames.items():
            assert frame.join(sound[table], on=frame.columns, how="semi").height == frame.height


def test_damaged_csv_keeps_all_whole_rows(configuration: Configuration, expected: dict[str, Any]) -> None:
    for uri, stated in expected.items():
        if not uri.endswith("imu.csv"):
            continue
        folder = EXAMPLES / Path(uri).parent
        frames, summary = read_log(folder, configuration.vehicle("damaged-counts"))
        assert frames["imu"].height == stated.get("rows", stated.get("whole_rows"))
        assert frames["vps"].height == 1464
        cut = "whole_rows" in stated
        assert [finding.code for finding in summary.findings] == (["unterminated_row"] if cut else [])
        whole, _ = read_log(
            EXAMPLES / "broad-imu-1-counts/2026-05-04-A1/broad_06", configuration.vehicle("broad-imu-1-counts")
        )
        for table in ("imu", "magnetometer", "vps"):
            assert frames[table].equals(whole[table].head(frames[table].height))


VERDICTS = {
    "broad_06_cut": ("partial", "unterminated_row"),
    "broad_06_decimal_comma": ("ok", None),
    "broad_06_units_row": ("ok", None),
    "broad_02_ff512.mcap": ("partial", "damaged_chunk"),
    "broad_02_power_loss.mcap": ("partial", "truncated"),
    "empty.mcap": ("rejected", "empty_file"),
    "ekf_failure.ulg": ("partial", "incomplete_row"),
}


def test_damaged_recordings_get_the_verdicts_they_should(configuration: Configuration) -> None:
    logs = [log for log in find_logs(EXAMPLES) if log.vehicle_id.startswith("damaged")]
    found = {}
    for log in logs:
        _, facts = read_flight(log.path, configuration.vehicle(log.vehicle_id))
        found[log.path.name] = (facts["verdict"], facts["reason_code"])
    assert found == {name: verdict for name, verdict in VERDICTS.items() if name in found}
    assert len(found) == 6


def test_sound_recordings_have_sane_sensors(configuration: Configuration) -> None:
    """No real recording is refused for what only a broken one shows."""
    for log in find_logs(EXAMPLES):
        vehicle = configuration.vehicle(log.vehicle_id)
        tables, facts = read_flight(log.path, vehicle)
        if not tables:
            continue
        assert facts["verdict"] == VERDICTS.get(log.path.name, ("ok", None))[0]
        signals = {f"ingest.{name}": frame for name, frame in tables.items()}
        result = run_stage(PIPELINE[0], signals, settings_of(facts, vehicle))
        assert not result.tables["faults"]["fatal"].any(), result.reason


def test_mcap_columns_are_what_mcap_ros2_decodes(configuration: Configuration) -> None:
    path = EXAMPLES / "broad-imu-1/2026-05-11-B/broad_02.mcap"
    frames, summary = read_log(path, configuration.vehicle("broad-imu-1"))
    poses = [
        (stamp_ns(m), *(getattr(m.pose.orientation, k) for k in "xyzw"), *(getattr(m.pose.position, k) for k in "xyz"))
        for _, m in messages_by_mcap_ros2(path, "/vps/pose")
    ]
    assert sorted(poses) == frames["vps"].rows()
    fields = [
        (stamp_ns(m), *(getattr(m.magnetic_field, k) for k in "xyz"))
        for _, m in messages_by_mcap_ros2(path, "/imu/mag")
    ]
    assert sorted(fields) == frames["magnetometer"].rows()
    assert summary.findings == []


def test_csv_columns_are_what_python_reads(configuration: Configuration) -> None:
    folder = EXAMPLES / "broad-imu-1-counts/2026-05-04-A1/broad_06"
    frames, _ = read_log(folder, configuration.vehicle("broad-imu-1-counts"))
    with (folder / "vps.csv").open(newline="") as stream:
        rows = [list(row.values()) for row in csv.DictReader(stream)]
    np.testing.assert_array_equal(frames["vps"]["t_ns"], [int(Decimal(row[0]) * 10**9) for row in rows])
    np.testing.assert_array_equal(frames["vps"].drop("t_ns"), np.array([row[1:] for row in rows], float))
