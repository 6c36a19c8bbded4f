"""The table `drift` of a warehouse: a function of its history, published under the vehicle that carries the IMU now."""

from __future__ import annotations

import datetime as dt
import json
from pathlib import Path

import polars as pl
import pytest
from drift_history import PER_DEGC, SESSIONS, TAU, UNIT_SPREAD, publish_fleet
from history_rows import START, lead, rows

from fieldcal.cli.main import run
from fieldcal.trends import drift_table as drift_table_module
from fieldcal.trends.drift_table import drift_table, history_in_groups, update_drift
from fieldcal.warehouse import Warehouse
from fieldcal.warehouse.content import content_sha256
from fieldcal.warehouse.publish import publish

STEP = 10.0 * TAU
START_TYPE = pl.Datetime("us", "UTC")


def spoil(unit: int, sensor: str, axis: str, session: int, value: float) -> float:
    """Unit 0 steps, 1 drifts, 2 is unlike its siblings, 3 had two bad flights, 4 was off in its last flight."""
    if sensor != "gyroscope" or axis != "x":
        return value
    if unit == 0 and session >= 15:
        return value + STEP
    if unit == 1:
        return value + 0.6 * TAU * session
    if unit == 2:
        return value + 15 * UNIT_SPREAD
    if unit == 3 and session in (7, 8):
        return value + (5 * session - 20) * STEP
    return value + STEP if unit == 4 and session == SESSIONS - 1 else value


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("drift")
    publish_fleet(root, spoil=spoil)
    assert len(update_drift(root)) == 12
    return root


def test_the_fleet_is_judged(root: Path) -> None:
    table = Warehouse(root).scan("drift").collect()
    assert table.height == 12 * 6
    odd = table.filter(~pl.col("status").is_in(["stable"]))
    assert odd.select("imu_id", "sensor", "axis", "status").sort("imu_id").rows() == [
        ("imu-00", "gyroscope", "x", "step"),
        ("imu-01", "gyroscope", "x", "drifting"),
        ("imu-02", "gyroscope", "x", "outlier"),
    ]
    step = odd.row(by_predicate=pl.col("status") == "step", named=True)
    assert abs(step["change_at"] - START - dt.timedelta(days=7 * 15)) <= dt.timedelta(days=7)
    assert step["change_size"] == pytest.approx(STEP, rel=0.15)
    assert step["reason"].startswith("Stepped by 0.5")
    slopes = table.filter(sensor="gyroscope")
    error = (slopes["slope_per_degc"] - PER_DEGC) / slopes["slope_per_degc_sd"]
    assert error.abs().max() < 4.0  # type: ignore[operator]
    gyroscope_x = table.filter(sensor="gyroscope", axis="x")
    bad = gyroscope_x.row(by_predicate=pl.col("imu_id") == "imu-03", named=True)
    assert bad["n_flights"] == SESSIONS - 2
    last = gyroscope_x.row(by_predicate=pl.col("imu_id") == "imu-04", named=True)
    assert last["last_z"] > 5.0
    assert "first after a step" in last["reason"]
    assert last["as_of"] == START + dt.timedelta(days=7 * (SESSIONS - 2))


def test_the_same_history_changes_nothing(root: Path) -> None:
    before = content_sha256(root)
    assert update_drift(root) == ()
    assert content_sha256(root) == before


def test_an_imu_that_moved_is_told_under_its_new_vehicle(tmp_path: Path) -> None:
    published = publish_fleet(tmp_path, units=2, sessions=8)
    update_drift(tmp_path)
    late = (
        published["v00"]
        .filter(pl.col("session_id") == "s007")
        .with_columns(
            vehicle_id=pl.lit("v01"),
            flight_id=pl.lit("moved"),
            started_at=pl.col("started_at") + pl.duration(days=7),
        )
    )
    publish(tmp_path, "v01", {"calibration": late}, ["moved"])
    assert update_drift(tmp_path) == ("v00", "v01")
    table = Warehouse(tmp_path).scan("drift").collect()
    assert table.select("imu_id", "vehicle_id").unique().sort("imu_id").rows() == [("imu-00", "v01"), ("imu-01", "v01")]
    assert table.filter(imu_id="imu-00")["n_flights"].to_list() == [9] * 6


def test_one_session_is_insufficient_and_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    publish_fleet(tmp_path, units=1, sessions=1)
    update_drift(tmp_path)
    capsys.readouterr()
    assert run(["drift", "--json", "--warehouse", str(tmp_path)]) == 0
    document = json.loads(capsys.readouterr().out)
    assert {row["status"] for row in document} == {"insufficient"}
    assert {row["reason"] for row in document} == {"1 session: a trend needs 5, 4 more."}
    assert {row["slope_per_degc"] for row in document} == {None}


def test_clock_and_agreement_have_trends_too(tmp_path: Path) -> None:
    """VPS lags that scatter from session to session more than the fleet's are an outlier's."""
    agreement = {"quantity": "attitude", "method": "quest", "reference": "vps", "signal": "raw", "sample": "all"}
    for u in range(12):
        flights, sync, fit = [], [], []
        for k in range(12):
            first = {**lead(f"v{u}", f"f{u}-{k}", 7 * k), "session_id": f"s{k}"}
            wild = 50.0 if u == 3 else 1.0
            lag = 0.37 + wild * 1e-4 * ((7 * k + 3 * u) % 11 - 5)
            flights.append({**first, "temperature_mean_degc": 20.0})
            sync.append({**first, "lag_mid_s": lag, "lag_sd_s": 1e-5, "skew_ppm": 20.0, "status": "ok"})
            fit.append({**first, **agreement, "tic": 0.03 + 1e-3 * (k % 3)})
        tables = {"flight": rows("flight", *flights), "sync": rows("sync", *sync), "fit": rows("fit", *fit)}
        publish(tmp_path, f"v{u}", tables, [row["flight_id"] for row in flights])
    table = drift_table(tmp_path)
    lag_rows = table.filter(sensor="vps", parameter="lag")
    assert lag_rows.filter(status="outlier")["imu_id"].to_list() == ["imu-of-v3"]
    assert lag_rows.filter(imu_id="imu-of-v1")["session_sd"][0] == pytest.approx(3.2e-4, rel=0.2)
    tic = table.filter(sensor="fit")
    assert tic["parameter"].unique().to_list() == ["tic_attitude"]
    assert tic["value_at_25degc"].to_list() == pytest.approx([0.031] * 12, abs=5e-4)


def test_flights_without_a_time_or_in_another_unit_do_not_count(tmp_path: Path) -> None:
    published = publish_fleet(tmp_path, units=1, sessions=8)["v00"]
    first = published.filter(pl.col("session_id") == "s000")
    untimed = first.with_columns(flight_id=pl.lit("untimed"), started_at=pl.lit(None, dtype=START_TYPE))
    counts = first.with_columns(flight_id=pl.lit("counts"), unit=pl.lit("counts"))
    publish(tmp_path, "v00", {"calibration": pl.concat([untimed, counts])}, ["untimed", "counts"])
    flights = pl.concat(history_in_groups(tmp_path))
    assert set(flights["flight_id"]) == {f"v00-{k:03d}" for k in range(8)}
    assert set(drift_table(tmp_path)["unit"]) == {"rad/s", "m/s^2"}


def test_nothing_to_tell(tmp_path: Path) -> None:
    assert update_drift(tmp_path) == ()
    assert drift_table(tmp_path).is_empty()


def test_the_command_shows_what_is_not_stable_first(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["drift", "--sensor", "gyroscope", "--json", "--warehouse", str(root)]) == 0
    document = json.loads(capsys.readouterr().out)
    assert [row["status"] for row in document[:4]] == ["step", "drifting", "outlier", "stable"]
    assert run(["drift", "--vehicle", "v00", "--parameter", "zero_bias", "--csv", "--warehouse", str(root)]) == 0
    assert capsys.readouterr().out.count("\n") == 7
    assert run(["drift", "--warehouse", str(root)]) == 0
    assert "Stepped by" in capsys.readouterr().out
    assert run(["drift", "--warehouse", str(root / "none")]) == 1


def test_what_to_fly_with_is_the_trend_unless_the_last_flight_is_off_it(root: Path) -> None:
    latest = Warehouse(root).sql("FROM latest_calibration WHERE sensor = 'gyroscope' AND axis = 'x'")
    table = Warehouse(root).scan("drift").filter(sensor="gyroscope", axis="x").collect()
    found = {row["imu_id"]: row for row in latest.iter_rows(named=True)}
    trend = {row["imu_id"]: row for row in table.iter_rows(named=True)}
    for imu_id in ("imu-00", "imu-01", "imu-02", "imu-03", "imu-05"):
        assert found[imu_id]["source"] == "drift"
        assert found[imu_id]["value_at_25degc"] == trend[imu_id]["value_at_25degc"]
    assert "after the step of" in found["imu-00"]["why"]
    assert "drifting, as of" in found["imu-01"]["why"]
    assert "unlike the rest of the fleet" in found["imu-02"]["why"]
    assert found["imu-05"]["why"] == f"Trend of {trend['imu-05']['n_flights']} flights."
    odd = found["imu-04"]
    assert odd["source"] == "flight"
    assert "spoiled, or the first after a step" in odd["why"]
    own = Warehouse(root).scan("calibration", flight_id=odd["flight_id"]).filter(sensor="gyroscope", axis="x").collect()
    warmer = trend["imu-04"]["slope_per_degc"] * (own["temperature_degc"][0] - 25.0)
    assert odd["value_at_25degc"] == pytest.approx(own["value"][0] - warmer, rel=1e-12)
    # At the temperature of the flight it is the flight's own value and sd.
    at = Warehouse(root).sql(
        "FROM calibration_at((SELECT any_value(temperature_degc) FROM calibration WHERE flight_id = ?))"
        " WHERE imu_id = 'imu-04' AND sensor = 'gyroscope' AND axis = 'x'",
        [odd["flight_id"]],
    )
    assert at["value"][0] == pytest.approx(own["value"][0], rel=1e-12)
    assert at["sd"][0] == pytest.approx(own["sd"][0], rel=1e-6)


def test_the_sd_at_a_temperature_is_least_where_flights_were(root: Path) -> None:
    sd = [
        Warehouse(root).sql(f"FROM calibration_at({t}) WHERE imu_id = 'imu-05' AND sensor = 'gyroscope'")["sd"][0]
        for t in (-40.0, 17.5, 80.0)
    ]
    assert sd[1] < 0.5 * min(sd[0], sd[2])
    why = Warehouse(root).sql("FROM calibration_at(80) WHERE imu_id = 'imu-05'")["why"][0]
    assert "80.0 degC is outside the " in why


def test_a_flight_newer_than_the_trend_is_not_hidden(tmp_path: Path) -> None:
    """The night has published a flight and not yet its trends."""
    published = publish_fleet(tmp_path, units=1)["v00"]
    update_drift(tmp_path)
    last = published.filter(pl.col("session_id") == f"s{SESSIONS - 1:03d}")
    new = last.with_columns(
        value=pl.col("value") + STEP,
        flight_id=pl.lit("new"),
        session_id=pl.lit("new"),
        started_at=pl.col("started_at") + pl.duration(days=7),
    )
    publish(tmp_path, "v00", {"calibration": new}, ["new"])
    latest = Warehouse(tmp_path).sql("FROM latest_calibration")
    assert set(latest["source"]) == {"flight"}
    assert set(latest["flight_id"]) == {"new"}


def test_warm_up_flights_sharpen_the_slope_unless_they_contradict(tmp_path: Path) -> None:
    """Slopes of the zero from two flights: x agrees with the sessions and is combined, y does not and is left out."""
    published = publish_fleet(tmp_path, units=1)["v00"]
    alone = {r["axis"]: r for r in drift_table(tmp_path).filter(sensor="gyroscope").iter_rows(named=True)}
    scale = 3e-4
    some = published.filter(pl.col("session_id").is_in(["s004", "s019"]), pl.col("sensor") == "gyroscope")
    slope = {"x": -PER_DEGC / scale, "y": -5.0 * PER_DEGC / scale}
    warm = some.filter(pl.col("axis").is_in(["x", "y"])).with_columns(
        method=pl.lit("warm_up"),
        parameter=pl.lit("zero_per_degc"),
        unit=pl.lit("counts/degC"),
        value=pl.col("axis").replace_strict(slope, return_dtype=pl.Float64),
        sd=pl.lit(0.02 * PER_DEGC / scale),
    )
    scales = published.filter(sensor="gyroscope").with_columns(
        parameter=pl.lit("scale"), unit=pl.lit("rad/s/counts"), value=pl.lit(scale), sd=pl.lit(1e-7)
    )
    ids = published["flight_id"].unique().to_list()
    publish(tmp_path, "v00", {"calibration": pl.concat([published, warm, scales])}, ids)
    found = {
        r["axis"]: r
        for r in drift_table(tmp_path).filter(sensor="gyroscope", parameter="zero_bias").iter_rows(named=True)
    }
    assert found["x"]["slope_per_degc"] == pytest.approx(PER_DEGC, rel=0.05)
    assert found["x"]["slope_per_degc_sd"] < 0.5 * alone["x"]["slope_per_degc_sd"]
    assert found["x"]["sd"] < alone["x"]["sd"] * 1.01
    for axis in "yz":
        assert found[axis]["slope_per_degc"] == pytest.approx(alone[axis]["slope_per_degc"], rel=1e-9)


def test_flights_published_meanwhile_are_in_the_trends(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Another process publishes a vehicle between reading and writing: the trends written last are of both."""
    other = tmp_path / "other"
    publish_fleet(other, units=2, sessions=8)
    update_drift(other)
    published = publish_fleet(tmp_path / "root", units=1, sessions=8)
    late = Warehouse(other).scan("calibration", vehicle_id="v01").collect()
    assert published["v00"].height == late.height
    read = drift_table_module.history_in_groups

    def and_then_another(root: Path, *, remember: bool) -> list[pl.DataFrame]:
        rows_read = list(read(root, remember=remember))
        publish(root, "v01", {"calibration": late}, late["flight_id"].unique().to_list())
        return rows_read

    monkeypatch.setattr(drift_table_module, "history_in_groups", and_then_another)
    update_drift(tmp_path / "root")
    tables = [Warehouse(root).scan("drift").collect() for root in (tmp_path / "root", other)]
    assert tables[0].equals(tables[1])


def test_a_new_unit_borrows_from_the_fleet_and_says_so(tmp_path: Path) -> None:
    """v12 has three sessions, v13 three with a step: the one is averaged, the other flies with its latest flight."""
    publish_fleet(tmp_path, 12)
    young = publish_fleet(
        tmp_path / "young", 14, 3, seed=1, spoil=lambda u, s, a, k, v: v + 20 * TAU * (u == 13 and k == 2)
    )
    for vehicle in ("v12", "v13"):
        rows = young[vehicle]
        flights = Warehouse(tmp_path / "young").scan("flight", vehicle_id=vehicle).collect()
        publish(tmp_path, vehicle, {"calibration": rows, "flight": flights}, rows["flight_id"].unique().to_list())
    update_drift(tmp_path)
    told = Warehouse(tmp_path).scan("drift").filter(pl.col("n_sessions") == 3).collect()
    assert (told["status"] == "insufficient").all()
    found = Warehouse(tmp_path).sql("FROM latest_calibration WHERE vehicle_id IN ('v12', 'v13')")
    averaged, stepped = (found.filter(vehicle_id=v) for v in ("v12", "v13"))
    assert averaged.filter(source="drift").height >= 5  # of six axes
    row = averaged.filter(source="drift").row(0, named=True)
    assert row["why"].startswith("Mean of 3 sessions, weighted by the scatter of 12 siblings")
    assert row["sd"] < TAU
    assert told.filter(imu_id="imu-12")["reason"][0].startswith("3 sessions: a trend needs 5, 2 more. The value is")
    assert (stepped["source"] == "flight").all()
    last = young["v13"].filter(flight_id="v13-002").sort("sensor", "axis")
    assert stepped.sort("sensor", "axis")["value_at_25degc"].to_list() == last["value"].to_list()
