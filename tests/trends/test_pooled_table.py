"""A fleet of weak flights in the warehouse: pooled, asked in every way that there is, and all answers agree."""

from __future__ import annotations

import datetime as dt
import json
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
from pooled import NAMES, SCATTER, UNITS, Truth, led

import fieldcal
from fieldcal.cli.main import run
from fieldcal.estimation.normal_equations import NormalEquations
from fieldcal.geometry.rotation import Array
from fieldcal.names import Method, Sensor
from fieldcal.report import write_vehicle_report
from fieldcal.stages.joint.information import table_of as rows_of_equations
from fieldcal.stages.results import triad_rows
from fieldcal.stages.tables import calibration_rows
from fieldcal.trends.drift_table import update_drift
from fieldcal.trends.pooled.table import update_pooled
from fieldcal.warehouse import Warehouse
from fieldcal.warehouse.publish import publish
from fieldcal.warehouse.store import empty_frame

VEHICLES, SESSIONS = 3, 8
ALONE = (0, 4)
"""Flights that show every constant by themselves; the others show eight combinations of the 18."""
UNSEEN = ("accelerometer", "gain", "x")
"""No flight of the last vehicle shows it."""


def flight(rng: np.random.Generator, at: Array, seen: int, *, blind: bool) -> NormalEquations:
    sd = np.array([SCATTER[name[:2]] for name in NAMES]) * 2.0
    look = rng.normal(size=(seen, 18)) / sd
    if blind:
        look[:, NAMES.index(UNSEEN)] = 0.0
    reading = look @ at + rng.normal(size=seen)
    nominal = np.array([1.0 if name[1] == "gain" else 0.0 for name in NAMES])
    return NormalEquations(NAMES, nominal, look.T @ (reading - look @ nominal), look.T @ look)


def rows_alone(found: NormalEquations, degc: float) -> pl.DataFrame:
    """The rows of `calibration` that a flight has by itself."""
    value = found.reference + np.linalg.solve(found.information, found.right)
    covariance = np.linalg.inv(found.information)
    rows = []
    for sensor in (Sensor.ACCELEROMETER, Sensor.GYROSCOPE, Sensor.MAGNETOMETER):
        at = [k for k, name in enumerate(NAMES) if name[0] == sensor]
        gain, zero = value[at[:3]], value[at[3:]]
        jacobian = np.block(
            [[np.diag(-1.0 / gain**2), np.zeros((3, 3))], [np.diag(zero / gain**2), np.diag(-1.0 / gain)]]
        )
        own = jacobian @ covariance[np.ix_(at, at)] @ jacobian.T
        unit = UNITS[sensor]
        rows += triad_rows(
            sensor, Method.JOINT, np.diag(1.0 / gain), -zero / gain, own, unit=unit, logged_unit=unit,
            reference_reading=np.zeros(3), temperature_degc=degc,
        )  # fmt: skip
    return calibration_rows(rows)


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Truth]]:
    root, truths = tmp_path_factory.mktemp("pooled"), []
    for vehicle in range(VEHICLES):
        rng = np.random.default_rng([3, vehicle])
        truth = Truth(rng, SESSIONS)
        truths.append(truth)
        information, calibration, flights = [], [], []
        for session in range(SESSIONS):
            degc = float(rng.uniform(10.0, 30.0))
            strong, blind = session in ALONE, vehicle == VEHICLES - 1
            found = flight(rng, truth.of_flight(session, degc), 40 if strong else 8, blind=blind)
            rows = rows_of_equations(found, [None] * 18, {Sensor(s): (u, u) for s, u in UNITS.items()})
            rows = rows.with_columns(temperature_degc=pl.lit(degc))
            information.append(led(rows, vehicle, session, session, truth.day[session]))
            if strong and not blind:
                own = rows_alone(found, degc)
                calibration.append(led(own, vehicle, session, session, truth.day[session]))
            lead = information[-1].row(0, named=True)
            facts = {"log_uri": lead["flight_id"], "log_format": "mcap", "verdict": "ok"}
            flights.append({name: {**lead, **facts}.get(name) for name in empty_frame("flight").columns})
        tables = {
            "flight": pl.DataFrame(flights, schema=empty_frame("flight").schema),
            "information": pl.concat(information),
            "calibration": pl.concat([empty_frame("calibration"), *calibration]),
        }
        publish(root, f"v{vehicle}", tables, [row["flight_id"] for row in flights])
    update_drift(root)
    assert update_pooled(root) == ("v0", "v1", "v2")
    return root, truths


def test_it_is_a_function_of_the_history(fleet: tuple[Path, list[Truth]]) -> None:
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
        assert drift[key]["n_flights"] == len(ALONE) < own["n_flights"]
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
