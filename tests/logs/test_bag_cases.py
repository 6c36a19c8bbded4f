"""An archive with logs of each container, as it was met. Needs FIELDCAL_EXAMPLE_LOGS."""

from __future__ import annotations

from pathlib import Path

import pytest
from example_logs import needs_examples
from test_csv_cases import CASES, calibrated, findings, lag

import fieldcal
from fieldcal.flows.run import dry_run

pytestmark = needs_examples

CASE = CASES / "archive_rosbag2_folder_ignored"
SESSION = CASE / "q1" / "2026-05-12"


def test_every_file_is_a_log_or_told() -> None:
    plan = dry_run(CASE, Path("/nonexistent/warehouse"), CASE / "fieldcal.toml", None)
    assert {Path(log["log_uri"]).name for log in plan["logs"]} == {
        "flight-01.mcap", "flight-02.mcap.zstd", "flight-03.bag", "flight-04.db3", "flight-07.BIN",
        "rosbag2_2026_05_12-13_45_01",
    }  # fmt: skip
    named = {Path(entry["path"]).name for entry in plan["unread"]}
    assert named == {"flight-05.tsv", "flight-06.txt", "NGIMU - 00383454"}


@pytest.mark.parametrize("name", ["flight-02.mcap.zstd", "rosbag2_2026_05_12-13_45_01"])
def test_the_containers_of_one_flight_give_the_same(name: str) -> None:
    plain, packed = (calibrated(CASE.name, f"q1/2026-05-12/{log}") for log in ("flight-01.mcap", name))
    assert packed["flight"]["verdict"] == plain["flight"]["verdict"] == "ok"
    for one, other in zip(plain["calibration"], packed["calibration"], strict=True):
        assert (one["sensor"], one["parameter"], one["axis"], one["value"]) == (
            other["sensor"], other["parameter"], other["axis"], other["value"],
        )  # fmt: skip


@pytest.mark.parametrize("name", ["flight-03.bag", "flight-04.db3"])
def test_files_of_zeros_are_rejected_by_name(name: str) -> None:
    document = calibrated(CASE.name, f"q1/2026-05-12/{name}")
    assert document["flight"]["verdict"] == "rejected"
    assert name in str(document["flight"]["reason"])


def test_transforms_of_a_frame_are_the_vps(tmp_path: Path) -> None:
    folder = CASES / "m_tf"
    told = findings(calibrated("m_tf", "log.mcap"))["unsupported_schema"]
    assert "world → quad, world → marker" in told
    text = (folder / "fieldcal.toml").read_text() + '\n[defaults.mcap]\nvps_frame = "quad"\n'
    (tmp_path / "fieldcal.toml").write_text(text)
    lag(fieldcal.calibrate(folder / "log.mcap", config=tmp_path / "fieldcal.toml").document)
