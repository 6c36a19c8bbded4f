"""A fleet whose gyroscopes' zeros bend with temperature, from flights to exports; who knows a bend is asked."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
from history_rows import lead, rows
from pooled import NAMES, SCATTER, Truth
from pooled_support import publish_unit

import fieldcal
from fieldcal.geometry.rotation import Array
from fieldcal.names import Sensor
from fieldcal.schemas.frames import empty_frame
from fieldcal.trends.drift_table import update_drift
from fieldcal.trends.pooled.table import near, strengths_told
from fieldcal.trends.pooled.units import by_unit, unit_of
from fieldcal.trends.pooled.verdicts import CURVE, read
from fieldcal.trends.regression import Trends
from fieldcal.warehouse import Warehouse
from fieldcal.warehouse.publish import publish

VEHICLES, SESSIONS = 4, 14
ZERO = ("gyroscope", "zero", "x")
PLACE = NAMES.index(ZERO)
PER_DEGC2 = 40.0 * SCATTER[ZERO[:2]] / 10.0**2
"""Forty scatters amid the 10 to 30 °C flown."""
DEGC = (10.0, 18.0, 25.0, 40.0)


class Bent(Truth):
    """With a bend in one zero."""

    def of_flight(self, session: int, degc: float) -> Array:
        return super().of_flight(session, degc) + PER_DEGC2 * (degc - 25.0) ** 2 * (np.arange(18) == PLACE)

    def zero(self, degc: float) -> float:
        """As of the last session, without its scatter."""
        warmth = degc - 25.0
        return float(self.walked[-1, PLACE] + self.slope[PLACE] * warmth + PER_DEGC2 * warmth**2)


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Bent]]:
    root, truths = tmp_path_factory.mktemp("bends"), []
    for vehicle in range(VEHICLES):
        rng = np.random.default_rng([8, vehicle])
        truths.append(Bent(rng, SESSIONS))
        publish_unit(root, vehicle, rng, truths[-1], SESSIONS, lambda session: 30)
    update_drift(root)
    return root, truths


def test_tables_say_how_it_bends_and_that_nothing_else_does(fleet: tuple[Path, list[Bent]]) -> None:
    root = fleet[0]
    pooled = Warehouse(root).scan("pooled").collect()
    bent = pooled.filter(pl.col("curve_per_degc2").is_not_null())
    assert set(bent.select("sensor", "parameter", "axis").iter_rows()) == {ZERO}
    assert bent.height == VEHICLES
    drift = Warehouse(root).scan("drift").collect()
    for row in bent.iter_rows(named=True):
        assert abs(row["curve_per_degc2"] - PER_DEGC2) < 4.0 * row["curve_per_degc2_sd"] < 0.3 * PER_DEGC2
        assert "It bends with temperature, " in row["reason"]
        own = drift.filter(vehicle_id=row["vehicle_id"], sensor="gyroscope", axis="x")
        told, scale, *biases = (
            own.filter(parameter=name).row(0, named=True) for name in ("zero", "scale", "bias", "zero_bias")
        )
        for column in ("value_at_25degc", "sd", "slope_per_degc", "curve_per_degc2", "curve_per_degc2_sd"):
            assert told[column] == row[column], column
        assert told["curve_per_degc3"] is None
        for bias in biases:
            assert bias["curve_per_degc2"] == pytest.approx(-scale["value_at_25degc"] * row["curve_per_degc2"])
            assert bias["curve_per_degc2_sd"] == pytest.approx(scale["value_at_25degc"] * row["curve_per_degc2_sd"])
    assert drift.filter(pl.col("curve_per_degc2").is_not_null()).height == 3 * VEHICLES


def test_at_any_temperature_it_is_the_truth_by_its_sd_and_exported_so(fleet: tuple[Path, list[Bent]]) -> None:
    """The sd of SQL is that of the smoother's own combination, beyond the temperatures flown too."""
    root, truths = fleet
    warehouse, z = fieldcal.Warehouse(root), []
    latest = warehouse.sql("FROM latest_calibration WHERE sensor = 'gyroscope' AND parameter = 'zero' AND axis = 'x'")
    assert set(latest["source"]) == {"pooled"}
    for row in latest.iter_rows(named=True):
        vehicle = row["vehicle_id"]
        one = unit_of(by_unit(Warehouse(root).scan("information", vehicle_id=vehicle).collect())[0])
        found, _ = near(one, strengths_told(Warehouse(root).scan("pooled", vehicle_id=vehicle).collect(), one))
        place, per = found.names.index(ZERO), one.per[ZERO]
        for degc in DEGC:
            own = warehouse.sql("SELECT * FROM calibration_at(?) WHERE vehicle_id = ?", [degc, vehicle])
            told = own.filter(sensor="gyroscope", parameter="zero", axis="x").row(0, named=True)
            value, variance = found.at().of(found.combination(place, degc - 25.0))
            assert told["value"] == pytest.approx(per * value, rel=1e-6)
            assert told["sd"] == pytest.approx(per * np.sqrt(variance), rel=1e-4)
            z.append((told["value"] - truths[int(vehicle[1:])].zero(degc)) / told["sd"])
            triad = warehouse.calibration_at(vehicle, degc).triads[Sensor.GYROSCOPE]
            assert triad.zero[0] == pytest.approx(told["value"])
            assert triad.zero_sd[0] == pytest.approx(told["sd"])
            exported = json.loads(fieldcal.export(warehouse.calibration_at(vehicle, degc), "json").text)
            curve = exported["sensors"]["gyroscope"]["zero_per_degc2"]
            assert curve == pytest.approx([row["curve_per_degc2"], 0.0, 0.0], rel=1e-6)
    assert np.abs(z).max() < 4.0
    assert 0.4 < np.sqrt(np.mean(np.square(z))) < 1.6


def zero(curve: float | None, sd: float) -> dict[str, Any]:
    own = {"sensor": "gyroscope", "parameter": "zero", "axis": "x", "unit": "counts", "sd": sd}
    return {**own, "value_at_25degc": 100.0, "slope_per_degc": 0.1, "slope_per_degc_sd": 0.01, "curve_per_degc2": curve}


@pytest.mark.parametrize("sd", [0.5, 2.0])
@pytest.mark.parametrize(
    ("of_trend", "of_pooled", "source"),
    [(0.02, None, "drift"), (None, 0.03, "pooled"), (0.02, 0.03, None), (None, None, None)],
)
def test_who_knows_a_bend_is_flown_with_else_who_knows_the_zero_better(
    tmp_path: Path, of_trend: float | None, of_pooled: float | None, source: str | None, sd: float
) -> None:
    """The trend's sd is 1."""
    first = lead("v", "f1")
    seen = {"sensor": "gyroscope", "method": "output_error", "parameter": "zero", "axis": "x", "unit": "counts"}
    flight = {**first, **seen, "value": 100.0, "sd": 0.1, "status": "ok", "temperature_degc": 25.0}
    own = {name: first[name] for name in ("vehicle_id", "imu_id")}
    counted = {"n_flights": 9, "n_sessions": 9, "status": "stable"}
    trend = {**own, **zero(of_trend, 1.0), **counted, "method": "output_error"}
    together = {**first, **zero(of_pooled, sd), "place": 0, "status": "ok", "session_sd": 0.1, "reason": "together"}
    publish(tmp_path, "v", {"calibration": rows("calibration", flight)}, ["f1"])
    publish(tmp_path, "v", {"drift": rows("drift", trend), "pooled": rows("pooled", together)}, [])
    (row,) = Warehouse(tmp_path).sql("FROM latest_calibration").to_dicts()
    assert row["source"] == (source or ("pooled" if sd < 1.0 else "drift"))
    assert row["curve_per_degc2"] == (of_trend if row["source"] == "drift" else of_pooled)


@pytest.mark.parametrize(("of_trend", "of_pooled"), [(0.02, None), (0.02, 0.03), (None, 0.03), (None, None)])
def test_the_trends_numbers_stand_where_it_alone_knows_a_bend(of_trend: float | None, of_pooled: float | None) -> None:
    key = {"unit_id": "u", "sensor": "gyroscope", "method": "joint", "parameter": "zero", "axis": "x", "unit": "counts"}
    regressed = rows(
        "drift", {**key, "curve_per_degc2": of_trend, "curve_per_degc2_sd": of_trend, "curve_per_degc3": of_trend}
    )
    trends = Trends(**{name: np.full(1, 7.0) for name in Trends.__dataclass_fields__})
    together = rows(
        "pooled", {**key, **zero(of_pooled, 0.5), "curve_per_degc2_sd": of_pooled, "status": "ok", "n_innovations": 9.0}
    )
    found = read({}, regressed, trends, np.full(1, np.nan), together)
    own = of_trend is not None and of_pooled is None
    assert found.covered.all()
    assert found.trends.value == pytest.approx([7.0 if own else 100.0])
    expected = [of_trend, of_trend, of_trend, None] if own else [of_pooled, of_pooled, None, None]
    assert found.rows.select(CURVE).row(0) == tuple(expected)
    assert found.rows.schema == empty_frame("drift").schema
