"""Withdrawn flights and rows count nowhere and stay; accepted ones count again; nights do not forget either."""

from __future__ import annotations

import datetime as dt
from pathlib import Path

import polars as pl
import pytest
from history_rows import flight, rows

import fieldcal
from fieldcal.batch.closing import close_night
from fieldcal.config.configuration import Alerts
from fieldcal.errors import FieldcalError
from fieldcal.names import Decision
from fieldcal.report.fitness import Criteria
from fieldcal.warehouse import Warehouse
from fieldcal.warehouse.content import content_sha256
from fieldcal.warehouse.decisions import decide as decisions
from fieldcal.warehouse.decisions.withdrawn import as_decided, withdrawn_flights
from fieldcal.warehouse.decisions.withdrawn import decisions as standing
from fieldcal.warehouse.publish import append, publish, read_history, settle
from fieldcal.warehouse.questions import units_flown
from fieldcal.warehouse.upkeep.verify import verify

NOW = dt.datetime(2026, 7, 1, tzinfo=dt.UTC)
FLIGHTS = [f"{n}{n:0>15}" for n in range(1, 7)]


def put(root: Path, n: int, vehicle: str = "a", value: float = 1.0) -> None:
    made = flight(vehicle, FLIGHTS[n], n, value + 0.001 * n)
    lead = {name: made["flight"][name][0] for name in ("flight_id", "vehicle_id", "imu_id", "session_id", "started_at")}
    clock = {
        **lead,
        "lag_mid_s": 0.1,
        "lag_s": 0.1,
        "lag_sd_s": 1e-3,
        "skew_ppm": 0.0,
        "skew_sd_ppm": 1.0,
        "status": "ok",
    }
    tic = {**lead, "quantity": "attitude", "method": "quest", "reference": "vps", "signal": "raw", "sample": "all"}
    made["sync"] = rows("sync", {**clock, "status": "ok"})
    made["fit"] = rows("fit", {**tic, "tic": 0.1 * (n + 1), "rms": 1.0, "rms_unit": "deg", "n_samples": 100})
    publish(root, vehicle, made, [FLIGHTS[n]])


@pytest.fixture
def root(tmp_path: Path) -> Path:
    for n in range(5):
        put(tmp_path, n)
    put(tmp_path, 5, "b")
    return tmp_path


def statuses(root: Path, flight_id: str) -> set[str]:
    own = Warehouse(root).scan("calibration", flight_id=flight_id).collect()
    return set(own["status"].to_list())


def latest(root: Path) -> set[str]:
    return set(Warehouse(root).sql("SELECT flight_id FROM latest_calibration WHERE vehicle_id = 'a'")["flight_id"])


def test_a_withdrawn_flight_counts_nowhere_and_stays(root: Path) -> None:
    before = read_history(root, "calibration", "a")
    decided = fieldcal.Warehouse(root).withdraw(FLIGHTS[4], reason="propeller was loose", author="ann")
    assert (decided.flight_ids, decided.constants) == ((FLIGHTS[4],), 6)
    assert statuses(root, FLIGHTS[4]) == {"withdrawn"}
    after = read_history(root, "calibration", "a")
    assert after.drop("status").equals(before.drop("status"))
    assert latest(root) == {FLIGHTS[3]}
    drift = Warehouse(root).scan("drift", vehicle_id="a").collect()
    assert set(drift["n_flights"]) == {4}
    assert set(drift["sensor"]) == {"gyroscope", "vps", "fit"}
    worst = Warehouse(root).sql("SELECT flight_id FROM worst_tic WHERE vehicle_id = 'a'")["flight_id"].to_list()
    assert worst == FLIGHTS[:4][::-1]
    refusals = Warehouse(root).sql("SELECT * FROM refusals WHERE level = 'parameter'")
    assert set(refusals["reason_code"]) == {"withdrawn"}
    assert refusals["detail"][0].startswith("propeller was loose (ann, 20")
    assert verify(root)["ok"]


def test_an_accepted_flight_counts_again_as_it_did(root: Path) -> None:
    before, content = read_history(root, "calibration", "a"), content_sha256(root)
    asked = fieldcal.Warehouse(root)
    asked.withdraw("a", reason="wrong aircraft", author="ann", session="spring")
    assert Warehouse(root).sql("SELECT * FROM latest_calibration WHERE vehicle_id = 'a'").is_empty()
    assert content_sha256(root) != content
    assert asked.accept("a", reason="it was the right one", author="ben").constants == 30
    assert read_history(root, "calibration", "a").equals(before)
    assert set(read_history(root, "sync", "a")["status"]) == {"ok"}
    told = Warehouse(root).sql("SELECT decision, author, reason FROM decision ORDER BY decided_at, flight_id")
    assert told["decision"].to_list() == ["withdraw"] * 5 + ["accept"] * 5
    assert told.row(-1) == ("accept", "ben", "it was the right one")


def test_a_night_that_publishes_a_withdrawn_flight_anew_leaves_it_withdrawn(root: Path) -> None:
    fieldcal.Warehouse(root).withdraw(FLIGHTS[2], reason="x", sensor="gyroscope", axis="y")
    put(root, 2, value=1.5)
    own = Warehouse(root).scan("calibration", flight_id=FLIGHTS[2]).collect()
    assert {(axis, status) for axis, status in own.select("axis", "status").iter_rows()} == {
        ("x", "ok"),
        ("y", "withdrawn"),
        ("z", "ok"),
    }
    assert own.filter(axis="y", method="output_error")["value"].item() == pytest.approx(1.502)
    assert set(read_history(root, "sync", "a")["status"]) == {"ok"}  # a part is not the flight


def test_a_flight_that_moves_to_another_vehicle_keeps_its_decisions(root: Path) -> None:
    fieldcal.Warehouse(root).withdraw(FLIGHTS[1], reason="x")
    publish(root, "a", {}, [FLIGHTS[1]])
    put(root, 1, "b")
    assert statuses(root, FLIGHTS[1]) == {"withdrawn"}


def test_the_last_decision_counts_also_over_a_part(root: Path) -> None:
    asked = fieldcal.Warehouse(root)
    asked.withdraw(FLIGHTS[0], reason="x", parameter="scale")
    asked.accept(FLIGHTS[0], reason="y")
    assert statuses(root, FLIGHTS[0]) == {"ok"}
    asked.withdraw(FLIGHTS[0], reason="z")
    asked.accept(FLIGHTS[0], reason="only these", sensor="gyroscope")
    assert statuses(root, FLIGHTS[0]) == {"ok"}
    assert withdrawn_flights(standing(root)) == [FLIGHTS[0]]
    assert read_history(root, "sync", "a").filter(flight_id=FLIGHTS[0])["status"].item() == "withdrawn"


def test_what_was_refused_stays_refused() -> None:
    given = rows("calibration", *({"flight_id": "f", "status": s} for s in ("ok", "refused", "absent")))
    decided = rows("decision", {"flight_id": "f", "decided_at": NOW, "decision": "withdraw"})
    assert as_decided("calibration", given, decided)["status"].to_list() == ["withdrawn", "refused", "absent"]
    again = rows("decision", {"flight_id": "f", "decided_at": NOW, "decision": "accept"})
    assert as_decided("calibration", given, again)["status"].to_list() == ["ok", "refused", "absent"]


def test_who_flies_is_not_told_by_a_withdrawn_flight(root: Path) -> None:
    """Its log lay in the wrong vehicle's folder."""
    stranger = flight("a", FLIGHTS[5], 9)
    stranger = {name: own.with_columns(imu_id=pl.lit("other")) for name, own in stranger.items()}
    publish(root, "a", stranger, [FLIGHTS[5]])
    assert units_flown(Warehouse(root), "a")["imu_id"].to_list() == ["other"]
    publish(root, "b", {}, [FLIGHTS[5]])
    fieldcal.Warehouse(root).withdraw(FLIGHTS[5], reason="wrong folder")
    assert units_flown(Warehouse(root), "a")["imu_id"].to_list() == ["imu-of-a"]


def test_where_deciding_was_interrupted_the_next_night_ends_it(root: Path) -> None:
    whole = {"vehicle_id": "a", "flight_id": FLIGHTS[4], "decided_at": NOW, "decision": "withdraw"}
    decided = rows("decision", {**whole, "author": "ann", "reason": "r"}).with_columns(
        unit_id=pl.lit(None, dtype=pl.String)
    )
    append(root, "a", "decision", decided)
    assert statuses(root, FLIGHTS[4]) == {"ok"}
    close_night(root, Criteria(Alerts()))
    assert statuses(root, FLIGHTS[4]) == {"withdrawn"}
    assert settle(root, "a") == ()


@pytest.mark.parametrize(
    ("target", "part", "sentence"),
    [
        ("aa", {}, "No vehicle, flight or log 'aa' is known; there is a"),
        ("111111", {}, "No vehicle, flight or log '111111' is known"),
        ("a", {"session": "autumn"}, "a has no session 'autumn'; the latest are: spring"),
        ("a", {"sensor": "magnetometer"}, "no constant of sensor 'magnetometer'; there is: gyroscope"),
        ("a", {"axis": "w"}, "no constant of axis 'w'; there is: x, y, z"),
        ("a", {"unit": "u"}, "no constant of unit 'u'; there is: imu-of-a"),
    ],
)
def test_what_is_not_there_is_told_and_nothing_decided(
    root: Path, target: str, part: dict[str, str], sentence: str
) -> None:
    with pytest.raises(FieldcalError, match=sentence) as caught:
        fieldcal.Warehouse(root).withdraw(target, reason="x", **part)  # type: ignore[typeddict-item]
    assert caught.value.reason_code == "not_found"
    assert standing(root).is_empty()


def test_a_decision_needs_a_reason(root: Path) -> None:
    with pytest.raises(FieldcalError, match="needs a reason") as caught:
        fieldcal.Warehouse(root).withdraw("a", reason="  ")
    assert caught.value.reason_code == "wrong_option"


def test_a_flight_is_called_by_its_beginning_where_that_is_its_own(root: Path) -> None:
    assert decisions.flights_meant(root, FLIGHTS[0][:8])["flight_id"].to_list() == [FLIGHTS[0]]
    assert decisions.flights_meant(root, f"a/spring/{FLIGHTS[0]}.mcap")["flight_id"].to_list() == [FLIGHTS[0]]
    publish(root, "a", flight("a", FLIGHTS[0][:8] + "ffff", 20), [FLIGHTS[0][:8] + "ffff"])
    with pytest.raises(FieldcalError, match="Several flights' ids begin with"):
        decisions.flights_meant(root, FLIGHTS[0][:8])


def test_decisions_of_one_moment_about_many_flights(root: Path) -> None:
    flights = decisions.flights_meant(root, "a")
    n = decisions.decide(root, flights, Decision.WITHDRAW, reason="r", author="a", part={}, now=NOW)
    assert n == 30
    assert set(standing(root)["decided_at"]) == {NOW}


def test_damage_to_what_no_night_makes_anew_says_so(root: Path) -> None:
    fieldcal.Warehouse(root).withdraw(FLIGHTS[0], reason="x")
    path = next((root / "tables" / "decision").rglob("*.parquet"))
    path.write_bytes(path.read_bytes()[:-1])
    for asked in (lambda: standing(root), lambda: fieldcal.Warehouse(root).withdraw(FLIGHTS[1], reason="x")):
        with pytest.raises(FieldcalError, match="no night makes it anew"):
            asked()
