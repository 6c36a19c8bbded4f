"""What a night tells: one message with what is new, to every place, once; and metrics that a collector reads."""

from __future__ import annotations

import http.server
import json
import threading
from collections.abc import Iterator, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, cast

import pytest
from drift_history import publish_fleet

from fieldcal.batch.documents import NightDocument
from fieldcal.batch.telling.message import MOST_OF_VEHICLE, Message, failure_of, news_of
from fieldcal.batch.telling.metrics import write_metrics
from fieldcal.batch.telling.send import send, tell_once
from fieldcal.cli.main import run
from fieldcal.errors import FieldcalError
from fieldcal.flows.run import run_night
from fieldcal.reason_codes import ReasonCode
from fieldcal.simulation.archive import write_flights
from fieldcal.simulation.experiment import Experiment
from fieldcal.trends.drift_table import update_drift

ARCHIVE = Path("fleet")


def change(kind: str, vehicle_id: str, sentence: str) -> dict[str, Any]:
    nobody = dict.fromkeys(("imu_id", "unit_id", "sensor", "axis"))
    return {"kind": kind, "vehicle_id": vehicle_id, "sentence": sentence, "parameters": [], **nobody}


def log(verdict: str, log_uri: str, stages_run: int = 19, reason: str | None = "why") -> dict[str, Any]:
    return {"log_uri": log_uri, "verdict": verdict, "reason": reason, "stages_run": stages_run}


def night(changes: Sequence[dict[str, Any]] = (), logs: Sequence[dict[str, Any]] = ()) -> NightDocument:
    counts = {name: sum(one["verdict"] == name for one in logs) for name in ("ok", "partial", "no_result")}
    rest = {"quarantined": 0, "rejected": 0, "report": "w/reports/fleet.html"}
    return cast(NightDocument, {**counts, **rest, "changes": changes, "logs": logs})


class Hook(http.server.BaseHTTPRequestHandler):
    """Keeps what it is sent; refuses below /no."""

    def do_POST(self) -> None:
        body = self.rfile.read(int(self.headers["Content-Length"]))
        cast(Any, self.server).heard.append(json.loads(body))
        self.send_response(403 if self.path.startswith("/no") else 200)
        self.end_headers()

    def log_message(self, format: str, *args: object) -> None:
        """Nothing."""


@pytest.fixture
def hook() -> Iterator[http.server.ThreadingHTTPServer]:
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Hook) as server:
        cast(Any, server).heard = []
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield server
        server.shutdown()


def address(server: http.server.ThreadingHTTPServer) -> str:
    return f"json://127.0.0.1:{server.server_address[1]}"


def heard(server: http.server.ThreadingHTTPServer) -> list[dict[str, str]]:
    return cast(list[dict[str, str]], cast(Any, server).heard)


def test_nothing_new_is_no_message() -> None:
    assert news_of(night(logs=[log("ok", "a"), log("no_result", "of before", stages_run=0)]), ARCHIVE) is None


def test_the_gravest_come_first_by_vehicle_and_a_flood_is_counted() -> None:
    many = [change("drifting", "b", f"b drifts, {n}") for n in range(10)]
    told = news_of(
        night(
            [
                change("idle", "c", "c is idle"),
                *many,
                change("step", "a", "a stepped"),
                change("recovered", "d", "d is well"),
            ],
            [log("no_result", "x/1"), log("quarantined", "x/2"), log("ok", "x/3")],
        ),
        ARCHIVE,
        "https://host/reports/",
    )
    assert told is not None
    assert told.title == "fieldcal, fleet: a, b, c need a look"
    lines = told.body.splitlines()
    assert [lines.index(name) for name in ("a", "b", "c")] == sorted(lines.index(name) for name in ("a", "b", "c"))
    assert sum(line.startswith("- b drifts") for line in lines) == MOST_OF_VEHICLE
    assert "- … and 6 more: fieldcal drift --vehicle b" in lines
    assert lines.index("- x/2: quarantined. why") < lines.index("- x/1: no_result. why")
    assert "x/3" not in told.body
    assert lines[lines.index("Fine again:") + 1] == "- d is well"
    assert lines[-1] == "Report: https://host/reports/fleet.html"


def test_names_from_logs_are_shown_and_not_obeyed() -> None:
    told = news_of(night([change("step", "a\x1b[2J\nb", "s\x07")]), ARCHIVE)
    assert told is not None
    assert not {"\x1b", "\x07"} & set(told.title + told.body)
    assert "\n" not in told.title


def test_a_failure_is_told_with_its_sentence() -> None:
    told = failure_of(FieldcalError(ReasonCode.DISK_FULL, "The disk is full."), ARCHIVE)
    assert told.title == "fieldcal, fleet: the night failed"
    assert told.body.startswith("The disk is full.\n")


def test_every_place_is_tried_and_secrets_are_told_to_nobody(hook: http.server.ThreadingHTTPServer) -> None:
    to = ["nonsense", "$NOT_SET", "json://user:hidden@127.0.0.1:9/", f"{address(hook)}/no", "$PLACE"]
    sent = send(Message("title", "body\n"), to, {"PLACE": f"{address(hook)}/yes"})
    assert [one.problem is None for one in sent] == [False, False, False, False, True]
    assert sent[1].problem == "NOT_SET is not set in the environment"
    assert "hidden" not in str(sent)
    assert [(one["title"], one["message"].strip()) for one in heard(hook)] == [("title", "body")] * 2


def test_the_same_is_told_once(hook: http.server.ThreadingHTTPServer, tmp_path: Path) -> None:
    for title in ("a", "a", "b"):
        tell_once(tmp_path, Message(title, "body\n"), [address(hook)], {})
    assert [one["title"] for one in heard(hook)] == ["a", "b"]


def test_what_nobody_took_is_told_again(
    hook: http.server.ThreadingHTTPServer, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for _ in range(2):
        tell_once(tmp_path, Message("a", "body\n"), [f"{address(hook)}/no"], {})
    assert len(heard(hook)) == 2
    assert "alerts.to, entry 1" in capsys.readouterr().err


def test_the_command_tries_every_place(
    hook: http.server.ThreadingHTTPServer, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = tmp_path / "fieldcal.toml"
    config.write_text(f'[alerts]\nto = ["{address(hook)}/yes"]\n')
    assert run(["alerts", "test", str(tmp_path)]) == 0
    assert "took the message" in capsys.readouterr().out
    config.write_text(f'[alerts]\nto = ["{address(hook)}/no"]\n')
    assert run(["alerts", "test", "--config", str(config), "--json"]) == 1
    assert json.loads(capsys.readouterr().out)[0]["problem"]
    config.write_text("")
    assert run(["alerts", "test", str(tmp_path)]) == 2
    assert "[alerts]" in capsys.readouterr().err


def test_metrics_are_what_a_collector_reads(tmp_path: Path) -> None:
    prometheus = import_module("prometheus_client.openmetrics.parser")
    root = tmp_path / "warehouse"
    publish_fleet(root)
    update_drift(root)
    path = tmp_path / "fieldcal.prom"
    write_metrics(path, night([change("step", "a", "s")], [log("ok", "x")]), root, ended_at_s=1.5e9, seconds=12.5)
    families = {one.name: one.samples for one in prometheus.text_string_to_metric_families(path.read_text())}
    assert families["fieldcal_night_end_timestamp_seconds"][0].value == 1.5e9
    assert {s.labels["verdict"]: s.value for s in families["fieldcal_logs"]}["ok"] == 1
    assert sum(s.value for s in families["fieldcal_trends"]) > 0
    assert {"vehicle", "unit", "sensor"} == set(families["fieldcal_calibrated_timestamp_seconds"][0].labels)


def test_a_night_tells_what_is_new_once(
    hook: http.server.ThreadingHTTPServer, prefect_server: str, tmp_path: Path
) -> None:
    archive, root = tmp_path / "fleet", tmp_path / "warehouse"
    write_flights(archive, Experiment(seed=3, duration_s=20.0, sets=1))
    (archive / "sim-1" / "2026-01-12" / "empty.mcap").write_bytes(b"")
    with (archive / "fieldcal.toml").open("a") as config:
        config.write(f'\n[alerts]\nto = ["{address(hook)}"]\nmetrics = "{tmp_path / "fieldcal.prom"}"\n')
    for _ in range(2):
        run_night(archive, root)
    (told,) = heard(hook)
    assert "empty.mcap: rejected" in told["message"]
    assert 'fieldcal_logs{verdict="rejected"} 1' in (tmp_path / "fieldcal.prom").read_text()
