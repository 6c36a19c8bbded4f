"""A fleet of weak flights in the warehouse: pooled, asked in every way that there is, and all answers agree."""

from __future__ import annotations

import datetime as dt
import json
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
from pooled import NAMES, UNITS, Truth
from pooled_support import publish_unit

import fieldcal
from fieldcal.cli.main import run
from fieldcal.names import Sensor
from fieldcal.report import write_vehicle_report
from fieldcal.trends.drift_table import update_drift
from fieldcal.trends.pooled.table import update_pooled
from fieldcal.warehouse import Warehouse

VEHICLES, SESSIONS = 3, 8
ALONE = (0, 4)
"""Flights that show every constant by themselves; the others show eight combinations of the 18."""
UNSEEN = ("accelerometer", "gain", "x")
"""No flight of the last vehicle shows it."""


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Truth]]:
    root, truths = tmp_path_factory.mktemp("pooled"), []
    for vehicle in range(VEHICLES):
        rng = np.random.default_rng([3, vehicle])
        truth = Truth(rng, SESSIONS)
        truths.append(truth)
        blind = vehicle == VEHICLES - 1
        publish_unit(
            root, vehicle, rng, truth, SESSIONS, lambda session: 40 if session in ALONE else 8,
            unseen=UNSEEN if blind else None, alone=lambda session, blind=blind: session in ALONE and not blind,
        )  # fmt: skip
    assert update_drift(root) == ("v0", "v1", "v2")
    return root, truths


def test_it_is_a_function_of_the_history(fleet: tuple[Path, list[Truth]]) -> None:
    assert update_drift(fleet[0]) == ()
    assert update_pooled(fleet[0]) == ()


def test_values_are_within_their_sd_of_the_truth(fleet: tuple[Path, list[Truth]]) -> None:
    root, truths = fleet
    z = []
    for row in Warehouse(root).scan("pooled").filter(pl.col("status") == "ok").collect().iter_rows(named=True):
        parameter = "gain" if row["parameter"] == "scale" else row["parameter"]
        own = truths[int(row["vehicle_id"][1:])].walked[-1][NAMES.index((row["sensor"], parameter, row["axis"]))]
        z.append((row["value_at_25degc"] - (1.0 / own if parameter == "gain" else own)) / row["sd"])
    assert len(z) >= 18 * VEHICLES - 3
    assert 0.6 < np.sqrt(np.mean(np.square(z))) < 1.3
    assert np.abs(z).max() < 4.0


def test_what_no_flight_shows_is_refused_with_the_motion_that_would(fleet: tuple[Path, list[Truth]]) -> None:
    rows = Warehouse(fleet[0]).scan("pooled", vehicle_id="v2").collect()
    unseen = rows.filter(sensor=UNSEEN[0], parameter="scale", axis=UNSEEN[2]).row(0, named=True)
    assert (unseen["status"], unseen["value_at_25degc"], unseen["sd"]) == ("refused", None, None)
    assert "do not show the accelerometer's x scale at all. Turn it over" in unseen["reason"]
    assert rows.filter(status="ok").height >= 15, "the others are not spoiled by it"


def test_sql_history_drift_report_and_export_agree(
    fleet: tuple[Path, list[Truth]], capsys: pytest.CaptureFixture[str]
) -> None:
    """Five ways to ask, one answer where they speak of the same."""
    root = fleet[0]
    warehouse = fieldcal.Warehouse(root)

    def printed(*command: str) -> Any:
        assert run([*command, "--warehouse", str(root)]) == 0
        return json.loads(capsys.readouterr().out)

    latest = warehouse.sql("FROM latest_calibration WHERE vehicle_id = 'v0' AND parameter IN ('scale', 'zero')")
    assert set(latest["source"]) == {"pooled"}
    assert latest.height == 18
    pooled = {(r["sensor"], r["parameter"], r["axis"]): r for r in printed("pooled", "--vehicle", "v0", "--json")}
    drift = {
        (r["sensor"], r["parameter"], r["axis"]): r
        for r in printed("drift", "--vehicle", "v0", "--json")
        if r["parameter"] in ("scale", "zero")
    }
    history = printed("history", "--vehicle", "v0", "--json")
    exported = json.loads(fieldcal.export(warehouse.calibration_at("v0"), "json").text)
    constants = warehouse.calibration_at("v0", 15.0)
    page = write_vehicle_report(root, "v0").read_text(encoding="utf-8")
    assert "What 8 flights in 8 sessions know together." in page
    at_15 = warehouse.sql("FROM calibration_at(15) WHERE vehicle_id = 'v0'")
    for row in latest.iter_rows(named=True):
        key = row["sensor"], row["parameter"], row["axis"]
        own, i = pooled[key], "xyz".index(row["axis"])
        assert (row["value_at_25degc"], row["sd"]) == (own["value_at_25degc"], own["sd"])
        assert own["covariance"][-1] == pytest.approx(own["sd"] ** 2)
        # Flights alone, and the trend of their rows, scatter about it by their own sd.
        alone = [r for r in history if (r["sensor"], r["parameter"], r["axis"]) == key]
        assert len(alone) == len(ALONE)
        for r in alone:
            spread = np.hypot(r["sd"], 2.0 * own["session_sd"]) + abs(own["slope_per_degc"]) * 20.0
            assert abs(r["value"] - own["value_at_25degc"]) < 5.0 * spread
        told = drift[key]
        for column in ("n_flights", "n_sessions", "value_at_25degc", "sd", "slope_per_degc", "slope_per_day"):
            assert told[column] == own[column], column
        assert told["n_flights"] == SESSIONS > len(ALONE)
        # What is exported is what SQL says at that temperature, with its sd.
        triad = constants.triads[Sensor(row["sensor"])]
        then = at_15.filter(sensor=row["sensor"], parameter=row["parameter"], axis=row["axis"]).row(0, named=True)
        value = triad.scale[i, i] if row["parameter"] == "scale" else triad.zero[i]
        assert value == pytest.approx(then["value"], rel=1e-12)
        sd = triad.scale_sd[i] if row["parameter"] == "scale" else triad.zero_sd[i]
        assert sd == pytest.approx(then["sd"], rel=1e-12)
    for sensor in UNITS:
        expected = [pooled[sensor, "scale", axis]["value_at_25degc"] for axis in "xyz"]
        np.testing.assert_allclose(np.diagonal(exported["sensors"][sensor]["scale"]), expected, rtol=1e-9)


def test_each_flight_s_share_is_told(fleet: tuple[Path, list[Truth]], capsys: pytest.CaptureFixture[str]) -> None:
    command = ["pooled", "--vehicle", "v0", "--sensor", "gyroscope", "--parameter", "zero", "--flights", "--json"]
    assert run([*command, "--warehouse", str(fleet[0])]) == 0
    rows = json.loads(capsys.readouterr().out)
    assert len(rows) == 3 * SESSIONS
    share = {k: np.mean([r["share"] for r in rows if r["flight_id"].endswith(f"{k}")]) for k in range(SESSIONS)}
    assert min(share[k] for k in ALONE) > max(share[k] for k in share if k not in ALONE)
    assert not any(r["left_out"] for r in rows)


def test_any_moment_can_be_asked_for(fleet: tuple[Path, list[Truth]], capsys: pytest.CaptureFixture[str]) -> None:
    """At the last session it is the table; at every session the truth of then, by its sd; between two, less is known;
    before the first, less and less."""
    root, truths = fleet
    warehouse = fieldcal.Warehouse(root)
    now, day = warehouse.pooled(vehicle="v0"), truths[0].day
    start = now["started_at"][0] - dt.timedelta(days=float(day[-1]))
    z, sd = [], []
    for at in (*day, 0.5 * (day[3] + day[4]), day[0] - 100.0):
        then = warehouse.pooled(vehicle="v0", at=start + dt.timedelta(days=float(at)))
        assert then.select("sensor", "parameter", "axis").equals(now.select("sensor", "parameter", "axis"))
        sd.append(then["sd"].to_numpy())
        if at not in day:
            continue
        truth = truths[0].walked[int(np.flatnonzero(day == at)[0])]
        for row in then.iter_rows(named=True):
            name = row["sensor"], "gain" if row["parameter"] == "scale" else "zero", row["axis"]
            value = truth[NAMES.index(name)]
            expected = 1.0 / value if row["parameter"] == "scale" else value
            z.append((row["value_at_25degc"] - expected) / row["sd"])
    assert warehouse.pooled(vehicle="v0", at=now["started_at"][0])["value_at_25degc"].to_list() == pytest.approx(
        now["value_at_25degc"].to_list()
    )
    moment = f"{start + dt.timedelta(days=float(day[2])):%Y-%m-%dT%H:%M:%S}"
    capsys.readouterr()
    assert run(["pooled", "--vehicle", "v0", "--at", moment, "--json", "--warehouse", str(root)]) == 0
    told = json.loads(capsys.readouterr().out)
    assert [row["sd"] for row in told] == pytest.approx(sd[2], rel=1e-3)
    assert np.abs(z).max() < 4.5
    assert 0.5 < np.sqrt(np.mean(np.square(z))) < 1.5
    assert (sd[-2] >= np.minimum(sd[3], sd[4])).all()
    assert (sd[-1] > sd[0]).all()


def test_a_withdrawn_flight_counts_no_more(fleet: tuple[Path, list[Truth]], tmp_path: Path) -> None:
    import shutil

    root = Path(shutil.copytree(fleet[0], tmp_path / "copy"))
    warehouse = fieldcal.Warehouse(root)
    before = warehouse.pooled(vehicle="v1")
    warehouse.withdraw(f"001-{SESSIONS - 1:04d}", reason="a magnet lay beside it")
    after = warehouse.pooled(vehicle="v1")
    assert before["n_flights"].max() == SESSIONS
    assert after["n_flights"].max() == SESSIONS - 1
    warehouse.accept(f"001-{SESSIONS - 1:04d}", reason="it did not")
    assert warehouse.pooled(vehicle="v1").equals(before)


def test_what_to_fly_next_is_what_would_show_what_no_flight_shows(
    fleet: tuple[Path, list[Truth]], capsys: pytest.CaptureFixture[str]
) -> None:
    """The accelerometer's x scale: of all turns about a single axis, pitch alone moves gravity along x."""
    found = fieldcal.Warehouse(fleet[0]).plan("v2")
    best = found.manoeuvres[0]
    assert (best.refused_now, best.refused_after) == (1, 0)
    assert "pitch" in best.words
    assert "by 60° either way" in best.words
    after = {
        m.words.split(" by ")[0]: e.sd_after
        for m in found.manoeuvres
        for e in m.expected
        if e.constant == "the accelerometer's x scale"
    }
    assert after["pitch"] < 0.5 < 2.0 < min(after["roll"], after["turn the heading"])  # per cent
    (unseen,) = [e for e in best.expected if e.constant == "the accelerometer's x scale"]
    assert unseen.sd_now == np.inf
    assert unseen.sd_after < unseen.limit == 5.0
    assert all(e.sd_after <= e.sd_now * (1.0 + 1e-6) for m in found.manoeuvres for e in m.expected)
    assert run(["plan", "v2", "--warehouse", str(fleet[0])]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert f"v2: {best.words}." in " ".join(" ".join(lines).split())
    assert max(map(len, lines)) <= 80
    assert any(line.startswith("the accelerometer's x scale") and "not known" in line for line in lines)
    assert run(["plan", "nobody", "--warehouse", str(fleet[0])]) == 2
