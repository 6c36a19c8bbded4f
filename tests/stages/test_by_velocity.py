"""The estimate by a receiver's velocity through the pipeline: rows, refusals one by one, and where it stays out."""

from __future__ import annotations

from typing import Any

import numpy as np
import polars as pl
import pytest

from fieldcal.names import Method, Sensor
from fieldcal.simulation.archive import settings, signals, truth
from fieldcal.simulation.experiment import SimulatedFlight, simulate
from fieldcal.simulation.ordinary import ordinary_flight
from fieldcal.stages.pipeline import run_flight
from fieldcal.stages.results import StageResult

SHORT: dict[str, Any] = {"duration_s": 50.0, "rate_hz": 60.0, "band_limit": False}
MOST_SD = 4.5


def flown(r: SimulatedFlight, tables: dict[str, pl.DataFrame] | None = None, **changes: Any) -> dict[str, StageResult]:
    return run_flight(tables or signals(r), settings(r.experiment, **{"method": "auto", **changes}))


def published(results: dict[str, StageResult]) -> dict[tuple[str, str, str], dict[str, Any]]:
    rows = results["composition"].tables["calibration"].filter(status="ok")
    return {(row["sensor"], row["parameter"], row["axis"]): row for row in rows.iter_rows(named=True)}


@pytest.fixture(scope="module")
def lively() -> tuple[SimulatedFlight, dict[str, StageResult]]:
    r = simulate(ordinary_flight("lively", 21, **SHORT))
    return r, flown(r)


def test_a_lively_flight_tells_every_constant_but_the_level_scales(
    lively: tuple[SimulatedFlight, dict[str, StageResult]],
) -> None:
    r, results = lively
    rows, true = published(results), truth(r)
    assert {row["method"] for row in rows.values()} == {str(Method.VELOCITY)}
    assert results["joint"].measured["rung"] == "by_velocity"
    for sensor in Sensor:
        for parameter in ("scale", "zero"):
            for i, axis in enumerate("xyz"):
                row = rows.get((sensor, parameter, axis))
                level = (sensor, parameter) == (Sensor.ACCELEROMETER, "scale") and axis != "z"
                assert (row is None) == level, (sensor, parameter, axis)
                if row is not None:
                    error = row["value"] - true["constants"][sensor][parameter][i]  # type: ignore[literal-required]
                    assert abs(error) < MOST_SD * row["sd"], (sensor, parameter, axis)


def test_level_scales_are_refused_with_the_reason(lively: tuple[SimulatedFlight, dict[str, StageResult]]) -> None:
    rows = lively[1]["composition"].tables["calibration"].filter(sensor="accelerometer", parameter="scale")
    codes = dict(rows.filter(method="velocity").select("axis", "reason_code").iter_rows())
    assert codes.pop("z") is None
    assert set(codes.values()) <= {"held_at_nominal", "scale_uncertain"}
    information = lively[1]["composition"].tables["information"].filter(sensor="accelerometer", parameter="gain")
    assert information.sort("axis")["status"].to_list() == ["refused", "refused", "ok"]


def test_lag_and_arm_are_rows(lively: tuple[SimulatedFlight, dict[str, StageResult]]) -> None:
    r, results = lively
    rows = published(results)
    lag = rows["accelerometer", "gnss_lag", ""]
    assert abs(lag["value"] - r.gnss_lag_s) < MOST_SD * lag["sd"] < 0.05
    for axis, true in zip("xyz", r.experiment.gnss_arm_m, strict=True):
        arm = rows["accelerometer", "gnss_lever_arm", axis]
        assert abs(arm["value"] - true) < MOST_SD * arm["sd"] < 0.3
    assert results["joint"].measured["gnss_lag_s"] == lag["value"]


def test_hover_tells_zeros_and_refuses_scales() -> None:
    results = flown(simulate(ordinary_flight("hover", 22, **{**SHORT, "duration_s": 80.0})))
    rows = {name for name, row in published(results).items() if row["method"] == "velocity"}
    assert {(s, p) for s, p, _ in rows if p == "scale" and s != "magnetometer"} == set()
    assert {("gyroscope", "zero", axis) for axis in "xyz"} <= rows
    assert ("accelerometer", "zero", "z") not in rows


def test_a_vps_goes_first_and_nothing_changes() -> None:
    r = simulate(ordinary_flight("lively", 23, **SHORT, vps=True))
    both = signals(r)
    alone = {name: frame for name, frame in both.items() if name != "gnss_velocity"}
    with_velocity, without = (flown(r, tables)["composition"].tables["calibration"] for tables in (both, alone))
    assert with_velocity.equals(without)
    assert "velocity" not in with_velocity["method"].to_list()


def test_without_velocity_and_unwanted_are_the_same(lively: tuple[SimulatedFlight, dict[str, StageResult]]) -> None:
    r = lively[0]
    alone = {name: frame for name, frame in signals(r).items() if name != "gnss_velocity"}
    unwanted = flown(r, use_velocity=False)["composition"].tables["calibration"]
    assert unwanted.equals(flown(r, alone)["composition"].tables["calibration"])
    assert "velocity" not in unwanted["method"].to_list()


def test_a_velocity_that_is_anothers_is_refused(lively: tuple[SimulatedFlight, dict[str, StageResult]]) -> None:
    r = lively[0]
    rng = np.random.default_rng(5)
    names = [f"velocity_{way}_mps" for way in ("north", "east", "down")]
    shuffled = signals(r)["gnss_velocity"].with_columns(
        **{name: pl.Series(rng.normal(0.0, 3.0, len(r.gnss_t))) for name in names}
    )
    result = flown(r, {**signals(r), "gnss_velocity": shuffled})["joint"]
    assert result.measured["use_velocity"] is False
    assert result.measured["use_velocity_reason"] in ("velocity_contradicts", "velocity_diverged", "prior_contradicted")


def test_counts_of_unknown_units_have_no_estimate_by_velocity(
    lively: tuple[SimulatedFlight, dict[str, StageResult]],
) -> None:
    r = lively[0]
    own = settings(r.experiment, method="auto").changed(nominal_scale=dict.fromkeys(Sensor))
    assert run_flight(signals(r), own)["joint"].measured["use_velocity_reason"] == "no_nominal_scale"
