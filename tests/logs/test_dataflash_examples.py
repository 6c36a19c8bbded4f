"""Real and simulated DataFlash logs: each message and value as pymavlink reads it, and what each is known to hold."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from dataflash_support import by_pymavlink
from example_logs import PARENT, needs_examples
from logs_support import vehicle

from fieldcal.logs import LogSummary, open_log
from fieldcal.logs.dataflash.file import DataflashFile
from fieldcal.logs.facts import Facts
from fieldcal.logs.ingest import read_flight

LOGS = sorted(p for p in (PARENT / "autopilot-logs").glob("copter-*/*/*") if p.suffix.lower() == ".bin")
pytestmark = needs_examples


def named(name: str) -> Path:
    return next(path for path in LOGS if f"{path.parts[-3]}/{path.name}" == name)


def facts_of(name: str) -> Facts:
    return read_flight(named(name), vehicle())[1]


def summary_of(name: str) -> LogSummary:
    reader = open_log(named(name), vehicle())
    for _ in reader.batches():
        pass
    return reader.summary


def codes(facts: Facts) -> set[str]:
    return {finding["code"] for finding in facts["findings"]}


@pytest.mark.parametrize("path", LOGS, ids=lambda path: f"{path.parts[-3]}-{path.name}")
def test_every_message_and_value_is_pymavlinks(path: Path) -> None:
    counts, theirs = by_pymavlink(path)
    file = DataflashFile(path)
    file.locate(counts.keys())
    assert file.counts() == counts
    assert (file.tally.stretches, file.tally.undefined, file.tally.redefined) == (0, {}, {})
    compared = 0
    for name, columns in theirs.items():
        rows = file.rows(name)
        if rows is None:
            assert not file.layouts[next(i for i, layout in file.layouts.items() if layout.name == name)].columns
            continue
        for column, values in columns.items():
            if column in rows and rows.layout.letters[rows.layout.columns.index(column)] != "M":
                assert np.array_equal(rows.numbers(column), np.array(values, float), equal_nan=True), (name, column)
                compared += len(values)
    assert compared > 1000


def test_a_flight_of_3_4() -> None:
    facts = facts_of("copter-3.4.4/log_0036.bin")
    assert facts["verdict"] == "ok"
    assert facts["duration_s"] == pytest.approx(150.7, abs=0.1)
    assert facts["rows"]["imu"] == 3755
    assert (facts["temperature_min_degc"] or 0) > 28
    assert (facts["temperature_max_degc"] or 0) < 36
    fastest: dict[str, float] = {}
    for table, columns in open_log(named("copter-3.4.4/log_0036.bin"), vehicle()).batches():
        if table.startswith("imu"):
            fastest[table] = max(float(np.abs(columns[f"gyroscope_{axis}"]).max()) for axis in "xyz")
    assert fastest == pytest.approx({"imu": 6.48, "imu.1": 6.77}, abs=0.01)
    frames, _ = read_flight(named("copter-3.4.4/log_0036.bin"), vehicle())
    speed = frames["gnss_velocity"].select("velocity_north_mps", "velocity_east_mps").to_numpy()
    assert np.hypot(*speed.T).max() == pytest.approx(5.6, abs=0.1)
    assert frames["gnss_velocity"]["velocity_sd_mps"].null_count() == 0


def test_two_boards_of_3_6_with_a_pause() -> None:
    facts = facts_of("copter-3.6.4/sample.bin")
    assert (facts["verdict"], facts["reason_code"]) == ("partial", "dropouts_logged")
    assert "gaps" in codes(facts)
    summary = summary_of("copter-3.6.4/sample.bin")
    assert [s.unit_id for s in summary.sources if s.sensor == "gyroscope"] == ["2621706", "2687754"]
    assert summary.metadata["firmware"] == "ArduCopter V3.6.4 (6c4da9e3)"
    assert summary.metadata["hardware"] == "fmuv5"


@pytest.mark.parametrize("number", ["03", "04", "05", "10", "54"])
def test_simulations_are_set_aside(number: str) -> None:
    name = f"copter-4.1-sitl/data_000000{number}.BIN"
    facts = facts_of(name)
    assert (facts["verdict"], facts["reason_code"]) == ("quarantined", "simulated")
    summary = summary_of(name)
    assert [s.table for s in summary.sources if s.sensor == "magnetometer"] == [
        "magnetometer",
        "magnetometer.1",
        "magnetometer.2",
    ]
    accelerometer = next(s for s in summary.sources if s.sensor == "accelerometer")
    assert accelerometer.corrections[0].matrix[0][0] == pytest.approx(1.001, abs=1e-6)
    magnetometer = next(s for s in summary.sources if s.sensor == "magnetometer")
    assert np.allclose(magnetometer.corrections[0].offset, [0.005, 0.013, -0.018])


@pytest.mark.parametrize(("name", "coldest", "warmest"), [("1", 29, 66), ("33", 29, 66), ("46", 29, 66), ("7", 28, 66)])
def test_bench_logs_of_4_7(name: str, coldest: float, warmest: float) -> None:
    facts = facts_of(f"copter-4.7/{name}.bin")
    assert facts["verdict"] == "ok"
    assert {"truncated", "no_gps_fix", "further_units", "already_corrected"} <= codes(facts)
    assert facts["imu_rate_hz"] == pytest.approx(25.0, abs=0.1)
    assert coldest < (facts["temperature_min_degc"] or 0) < (facts["temperature_max_degc"] or 0) < warmest
    summary = summary_of(f"copter-4.7/{name}.bin")
    assert [s.unit_id for s in summary.sources if s.sensor == "gyroscope"] == ["3604746", "3605282"]
    assert "ISBH" in next(f.sentence for f in summary.findings if f.code == "already_corrected")


def test_at_rest_the_vehicle_reads_gravity_upwards() -> None:
    frames, _ = read_flight(named("copter-4.1-sitl/data_00000003.BIN"), vehicle())
    means = [frames["imu"][f"accelerometer_{axis}"].mean() for axis in "xyz"]
    assert np.allclose(means, [0.0, 0.0, -9.81], atol=0.02)


def test_every_format_letter_there_is() -> None:
    letters = {letter for path in LOGS for layout in DataflashFile(path).layouts.values() for letter in layout.letters}
    assert letters >= set("bBhHiIqQfdnNZcCeELM")


def test_a_log_without_sensors_is_refused() -> None:
    assert facts_of("copter-sitl-types/5.BIN")["reason_code"] == "missing_sensor"
