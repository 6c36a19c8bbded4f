"""No file stops a night: names that are no text, pipes, numbers of a megabyte, comments without end, bombs, years."""

from __future__ import annotations

import os
import time
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import CompressionType, IndexType, Writer

from fieldcal.batch.plan import make_plan
from fieldcal.config.configuration import load
from fieldcal.errors import UnreadableLog, UnusableFlight
from fieldcal.estimation.clock_sync.by_rates import imu_rates, vps_rates
from fieldcal.logs import open_log
from fieldcal.logs.ingest import read_flight, tidy_log
from fieldcal.logs.unread import NO_TEXT, NOT_STORED

VEHICLE = load(None).vehicle("v")
HEADER = "t,ax,ay,az,gx,gy,gz,mx,my,mz\n"
CELL_BYTES = 900_000
WITHIN_CPU_S = 3.0


def rows(n: int) -> str:
    readings = (f"{0.1 * (i % 7)},{0.2 * (i % 5)},9.8{i % 10},0.01{i % 9},0.02{i % 8},0.0{i % 7}" for i in range(n))
    return "".join(f"{i * 0.01:.4f},{own},20.{i % 10},1.{i % 9},40.{i % 8}\n" for i, own in enumerate(readings))


def test_what_has_no_name_in_text_or_is_no_file_is_told_and_passed_over(tmp_path: Path) -> None:
    sound = tmp_path / "v" / "s" / "log.csv"
    sound.parent.mkdir(parents=True)
    sound.write_text(HEADER + rows(20))
    os.mkfifo(sound.with_name("pipe.csv"))
    os.mkfifo(sound.with_name("pipe.mcap"))
    for name in (b"v/s/lo\xffg.csv", b"v/\xe9/log.csv", b"\xff/s/log.csv"):
        path = os.path.join(os.fsencode(tmp_path), name)
        os.makedirs(os.path.dirname(path), exist_ok=True)
        with open(path, "w") as stream:
            stream.write(HEADER + rows(20))
    for globs in ("", '[archive]\nlogs = [{ glob = "**/*.csv" }]'):
        config = tmp_path / "fieldcal.toml"
        config.write_text(globs)
        plan = make_plan(tmp_path / "root", tmp_path, load(config))
        assert [job.log_uri for job in plan.jobs] == ["v/s/log.csv"]
        assert [(one.path, one.why) for one in plan.unread] == [
            ("\\xff", NO_TEXT),
            ("v/\\xe9", NO_TEXT),
            ("v/s/lo\\xffg.csv", NO_TEXT),
            ("v/s/pipe.csv", NOT_STORED),
            ("v/s/pipe.mcap", NOT_STORED),
        ]


def test_a_pipe_is_refused_by_name(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.csv")
    with pytest.raises(UnreadableLog, match=r"pipe\.csv is a pipe, socket or device\. Save its content"):
        open_log(tmp_path / "pipe.csv", VEHICLE)


DIGITS = "1" * CELL_BYTES
HUGE = {
    "time": HEADER + rows(50) + f"{DIGITS},1,2,3,4,5,6,7,8,9\n",
    "first time": HEADER + f"{DIGITS},1,2,3,4,5,6,7,8,9\n" + rows(50),
    "exponent": HEADER + rows(50) + f"{DIGITS}e5,1,2,3,4,5,6,7,8,9\n",
    "reading": HEADER + rows(50) + f"1,{DIGITS}x,2,3,4,5,6,7,8,9\n",
    "quoted": HEADER + rows(50) + f'"{DIGITS}",1,2,3,4,5,6,7,8,9\n',
    "name": HEADER.replace("mz", "m" * CELL_BYTES) + rows(50),
    "blank name": HEADER.replace("mz", "mz" + " " * CELL_BYTES + "x") + rows(50),
    "no header": f"{DIGITS}x,2,3,4,5,6,7,8,9,0\n" + rows(50),
}


@pytest.mark.parametrize("where", HUGE)
def test_a_cell_of_a_megabyte_costs_a_row_not_hours(tmp_path: Path, where: str) -> None:
    log = tmp_path / "log.csv"
    log.write_text(HUGE[where])
    began = time.process_time()
    frames, facts = read_flight(log, VEHICLE)
    assert time.process_time() - began < WITHIN_CPU_S
    assert len(facts["reason"] or "") < 2000
    if frames:
        assert facts["verdict"] == "partial"
        assert frames["imu"].height == 50


@pytest.mark.parametrize(
    "comments", ["# c\n" * 300, "\n// c\n" * 5000, "# c\n" * 300_000, ("# " + "c" * 9000 + "\n") * 1000]
)
def test_any_number_of_comments_may_stand_above(tmp_path: Path, comments: str) -> None:
    log = tmp_path / "log.csv"
    log.write_text(comments + HEADER + rows(50) + "bad,1,2,3,4,5,6,7,8,9\n")
    frames, facts = read_flight(log, VEHICLE)
    assert frames["imu"].height == 50
    assert f"the first is line {comments.count(chr(10)) + 52}" in (facts["reason"] or "")
    log.write_text(comments)
    assert read_flight(log, VEHICLE)[1]["reason_code"] == "no_rows"


def test_names_in_the_last_comment_are_found_below_many(tmp_path: Path) -> None:
    log = tmp_path / "log.csv"
    log.write_text("# c\n" * 2000 + "# " + HEADER + rows(50))
    assert read_flight(log, VEHICLE)[0]["imu"].height == 50


def bomb(path: Path, messages: int, filler: str = "0") -> None:
    """JSON messages that are all alike, which pack to next to nothing."""
    vector = '{"x":0.1,"y":0.2,"z":9.8}'
    said = f'"angular_velocity":{vector},"linear_acceleration":{vector},"pad":{filler}}}'
    message = ('{"header":{"stamp":{"sec":1,"nanosec":2}},' + said).encode()
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=200 << 20, compression=CompressionType.ZSTD, index_types=IndexType.NONE)
        writer.start()
        schema = writer.register_schema("sensor_msgs/msg/Imu", "jsonschema", b"{}")
        channel = writer.register_channel("/imu", "json", schema)
        for _ in range(messages):
            writer.add_message(channel, 1, message, 1)
        writer.finish()


def test_a_bomb_of_json_is_given_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bomb(tmp_path / "log.mcap", 300_000)
    assert (tmp_path / "log.mcap").stat().st_size < 40_000
    monkeypatch.setattr("fieldcal.logs.ingest.CPU_SECONDS_ALLOWED", 0.5)
    log = tidy_log(tmp_path / "log.mcap", VEHICLE)
    began = time.thread_time()
    with pytest.raises(UnreadableLog, match="unpacks to far more than a log does") as error:
        list(log.tables())
    assert error.value.reason_code == "over_limits"
    assert time.thread_time() - began < WITHIN_CPU_S


def test_a_json_message_of_megabytes_is_no_reading(tmp_path: Path) -> None:
    bomb(tmp_path / "log.mcap", 5, "[" + "0," * 1_000_000 + "0]")
    assert read_flight(tmp_path / "log.mcap", VEHICLE)[1]["reason_code"] == "no_messages"


@pytest.mark.parametrize("step_s", [1e-5, 1e-2])
def test_no_even_grid_spans_years(step_s: float) -> None:
    t = np.cumsum(np.where(np.arange(1000) % 10 == 0, 5e4, step_s))
    q = np.tile([0.0, 0.0, 0.0, 1.0], (len(t), 1))
    for grid in (lambda: imu_rates(t, q[:, :3], step_s), lambda: vps_rates(t, q, step_s)):
        with pytest.raises(UnusableFlight, match="Split the log there") as error:
            grid()
        assert error.value.reason_code == "gaps"
