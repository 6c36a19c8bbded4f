"""What a night says of the fleet: judged once, told once, the same in every place."""

from __future__ import annotations

import datetime as dt
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest
from drift_history import TAU, publish_fleet
from history_rows import START, rows
from older_history import rewrite

from fieldcal.batch.closing import close_night
from fieldcal.cli.main import run
from fieldcal.config.configuration import Alerts, Tolerances
from fieldcal.names import Standing
from fieldcal.report.fitness import Criteria, Fitness, fleet_fitness
from fieldcal.report.standing.memory import remembered_criteria, remembered_fleet
from fieldcal.report.standing.news import news
from fieldcal.report.standing.reason import EXPIRED, IDLE, Reason
from fieldcal.report.write import write_vehicle_report
from fieldcal.schemas import TABLES
from fieldcal.trends.drift_table import update_drift
from fieldcal.warehouse import Warehouse, WarehouseError
from fieldcal.warehouse.layout import history_files
from fieldcal.warehouse.publish import append

LAST = START + dt.timedelta(days=14)
FAR = Criteria(Alerts(expires_days=1e5, idle_days=1e5))


def said(*reasons: Reason, standing: Standing = Standing.LOOK) -> dict[str, Fitness]:
    return {"v": Fitness("v", standing if reasons else Standing.FINE, reasons)}


def of(kind: str, axis: str = "x", mark: str = "") -> Reason:
    return Reason(kind, f"gyroscope {axis}: {kind}.", "i", "u", "gyroscope", axis, ("zero_bias",), mark)


def test_what_is_new_is_told_and_what_holds_is_not() -> None:
    before, after = said(of("step", "y")), said(of("drifting"), of("step", "y"))
    (change,) = news(after, before)
    assert (change.kind, change.unit_id, change.sensor, change.axis) == ("drifting", "u", "gyroscope", "x")
    assert change.sentence == "v, u: gyroscope x: drifting."
    assert change.row()["parameters"] == ["zero_bias"]
    assert news(after, after) == []
    assert [c.kind for c in news(after, {})] == ["step", "drifting"]
    assert [c.kind for c in news(before, after)] == ["recovered"]
    assert news(before, after)[0].sentence == "v, u: gyroscope x: drifting no more."


def test_another_step_is_new_and_one_that_turns_out_a_drift_has_not_recovered() -> None:
    assert [c.kind for c in news(said(of("step", mark="b")), said(of("step", mark="a")))] == ["step"]
    assert [c.kind for c in news(said(of("drifting")), said(of("step")))] == ["drifting"]


def test_a_vehicle_of_which_too_little_is_left_has_not_recovered() -> None:
    assert news(said(of("few"), standing=Standing.TOO_FEW), said(of("step"))) == []


def test_age_is_told_when_it_passes_the_limit(tmp_path: Path) -> None:
    publish_fleet(tmp_path, units=1, sessions=3)  # the last two weeks after START

    def reasons(day: float, **limits: float) -> list[Reason]:
        one = fleet_fitness(Warehouse(tmp_path), Criteria(Alerts(**limits)), START + dt.timedelta(days=day))["v00"]
        return [reason for reason in (*one.told, *one.notes) if reason.kind in (IDLE, EXPIRED)]

    assert reasons(43.0) == []
    assert [r.kind for r in reasons(44.5)] == [IDLE]
    assert reasons(44.5)[0].sentence == f"No usable flight for 30 days, since {LAST:%Y-%m-%d}."
    assert [r.kind for r in reasons(104.5)] == [EXPIRED, IDLE]
    assert f"accelerometer, gyroscope last calibrated on {LAST:%Y-%m-%d}" in reasons(104.5)[0].sentence
    assert reasons(104.5)[0].key == reasons(105.5)[0].key
    assert [r.kind for r in reasons(20.0, expires_days=5.0, idle_days=60.0)] == [EXPIRED]


def test_trends_of_an_older_release_are_made_anew_and_those_of_a_newer_refused(tmp_path: Path) -> None:
    publish_fleet(tmp_path, units=2, sessions=6)
    close_night(tmp_path, FAR)
    made = Warehouse(tmp_path).scan("drift").collect()
    (path, *_) = history_files(tmp_path, "drift")
    rewrite(tmp_path, path, pq.read_table(path, partitioning=None).drop_columns(["best_known_at"]), 2)
    close_night(tmp_path, FAR)
    assert Warehouse(tmp_path).scan("drift").collect().equals(made)
    rewrite(tmp_path, path, pq.read_table(path, partitioning=None), TABLES["drift"].version + 1)
    newer = path.read_bytes()
    with pytest.raises(WarehouseError, match="A newer fieldcal wrote it") as caught:
        close_night(tmp_path, FAR)
    assert caught.value.reason_code == "schema_mismatch"
    assert path.read_bytes() == newer


def test_limits_of_the_configuration_reach_the_night(tmp_path: Path) -> None:
    """Whoever shortens a limit is told at once of what that makes old, and once only; it is remembered for the site."""
    publish_fleet(tmp_path, units=1, sessions=3)
    quiet = close_night(tmp_path, FAR, with_site=False)
    assert (quiet.changes, quiet.site, (tmp_path / "site").exists()) == ([], None, False)
    near = Criteria(Alerts(expires_days=1e5, idle_days=1e-3), Tolerances(gyroscope_degps=0.02))
    assert sorted({c.kind for c in close_night(tmp_path, near).changes}) == ["idle", "limit"]
    assert close_night(tmp_path, near).changes == []
    assert remembered_criteria(tmp_path) == near
    assert remembered_fleet(tmp_path)["v00"].next.startswith("Recalibrate now. gyroscope")


@pytest.fixture(scope="module")
def young(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """12 units x 8 sessions: one stepped by ten session sds, one drifts by half of one a session."""
    root = tmp_path_factory.mktemp("young")

    def spoil(unit: int, sensor: str, axis: str, session: int, value: float) -> float:
        if (unit, sensor, axis) == (0, "gyroscope", "x") and session >= 5:
            return value + 10 * TAU
        return value + 0.5 * TAU * session * ((unit, sensor, axis) == (1, "gyroscope", "y"))

    publish_fleet(root, 12, 8, spoil=spoil)
    return root


def test_a_young_fleet_is_told_what_so_few_sessions_tell_in_every_place_alike(
    young: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (change, *others) = close_night(young, FAR).changes
    assert others == []
    assert change.vehicle_id == "v00"
    assert "drift or step" in change.sentence
    assert "or it stepped in between: about 12 more sessions would tell" in change.sentence
    fitness = remembered_fleet(young)
    assert {v for v, one in fitness.items() if one.standing != Standing.FINE} == {"v00"}
    (reason,) = fitness["v00"].reasons
    assert change.sentence == f"v00, imu-00: {reason}"
    whole = young / "reports" / "fleet.html"
    assert list((young / "reports").glob("*.html")) == [whole], "the site has a page of every vehicle"
    assert '<a href="../site/vehicle-v00.html">v00</a>' in whole.read_text()
    for path in (whole, write_vehicle_report(young, "v00")):
        assert '<span class="badge look">drift or step</span>' in path.read_text()
    close_night(young, FAR)
    assert '<a href="../site/vehicle-v00.html">v00</a>' in whole.read_text(), "not to a report that may be old"
    page = (young / "site" / "vehicle-v00.html").read_text()
    assert reason in page
    assert reason in (young / "site" / "index.html").read_text()
    capsys.readouterr()
    assert run(["drift", "--vehicle", "v00", "--warehouse", str(young)]) == 0
    told = " ".join(capsys.readouterr().out.split())
    assert "gyro x zero bias drift or step" in told
    assert reason.partition("drift or step. ")[2] in told


def test_dates_and_sessions_follow_the_limits(young: Path) -> None:
    update_drift(young)
    last = START + dt.timedelta(days=49)

    def fitness(now: dt.datetime, **limits: float) -> Fitness:
        criteria = Criteria(FAR.alerts, Tolerances(**limits))
        return fleet_fitness(Warehouse(young), criteria, now, ["v05"])["v05"]

    assert fitness(last).next == ""
    wide, narrow = (fitness(last, gyroscope_degps=limit) for limit in (3.0, 0.3))
    dates = [dt.date.fromisoformat(one.next.split()[2].rstrip(".")) for one in (narrow, wide)]
    assert last.date() < dates[0] < dates[1]
    assert (narrow.standing, wide.standing) == (Standing.FINE, Standing.FINE)
    overdue = fitness(dt.datetime(2036, 1, 1, tzinfo=dt.UTC), gyroscope_degps=0.3)
    assert overdue.standing == Standing.LOOK
    assert "may be off what was found last by 0.3 °/s" in overdue.reasons[0]
    unknown = fitness(last, gyroscope_degps=0.001)
    assert "more sessions would tell" in unknown.reasons[0]


def test_what_moved_since_it_was_exported_is_told(tmp_path: Path) -> None:
    publish_fleet(tmp_path, 12, 24, spoil=lambda u, s, a, k, v: v + 0.01 * (u == 0 and a == "x" and k >= 12))
    update_drift(tmp_path)
    handed: dict[str, Any] = {
        "vehicle_id": "v00",
        "exported_at": START + dt.timedelta(days=50),
        "format": "px4",
        "unit_id": "imu-00",
        "sensor": "gyroscope",
        "name": "CAL_GYRO0_XOFF",
        "set_to": 0.0,
        "at_degc": 25.0,
        "author": "ann",
        "text_sha256": "0" * 64,
    }
    append(tmp_path, "v00", "export", rows("export", handed))
    criteria = Criteria(FAR.alerts, Tolerances(gyroscope_degps=0.25))
    one = fleet_fitness(Warehouse(tmp_path), criteria, START + dt.timedelta(days=170), ["v00"])["v00"]
    (moved,) = [reason for reason in one.told if reason.kind == "limit"]
    assert "gyroscope x is 0.5" in moved.sentence
    assert f"off what was exported on {START + dt.timedelta(days=50):%Y-%m-%d}; the limit is 0.25 °/s" in moved.sentence
