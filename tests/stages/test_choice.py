"""Method `auto`: which method counts, and what a VPS contradicts, from the simulator's flights."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest

from fieldcal.config.stage_settings import ChoiceSettings, taken_from
from fieldcal.estimation.faults import Fault
from fieldcal.names import SENSORS
from fieldcal.reason_codes import ReasonCode
from fieldcal.simulation.archive import settings, signals
from fieldcal.simulation.experiment import SimulatedFlight, simulate
from fieldcal.stages.choice import choose
from fieldcal.stages.pipeline import run_flight
from fieldcal.stages.results import StageResult, fault_rows


@pytest.fixture(scope="module")
def flown() -> tuple[SimulatedFlight, dict[str, StageResult]]:
    r = simulate(seed=61, duration_s=20.0, sets=2)
    return r, run_flight(signals(r), settings(r.experiment, method="auto"))


def published(results: dict[str, StageResult]) -> dict[str, set[str]]:
    rows = results["choice"].tables["calibration"].filter(status="ok")
    return {name: set(rows.filter(sensor=name)["method"]) for name in SENSORS}


def test_the_joint_estimate_counts_and_the_chain_is_told_so(
    flown: tuple[SimulatedFlight, dict[str, StageResult]],
) -> None:
    _, results = flown
    assert all(methods == {"joint"} for methods in published(results).values())
    assert results["choice"].measured["chosen"] == dict.fromkeys(SENSORS, "joint")
    rows = results["choice"].tables["calibration"]
    beside = rows.filter(pl.col("method").is_in(["output_error", "ellipsoid_robust"]))
    assert set(beside["status"]) == {"refused"}
    assert "other_method_chosen" in set(beside["reason_code"])
    # No number is lost: every stage's rows are there, as they were.
    for stage in ("vectors", "gyro_output", "joint"):
        own = results[stage].tables["calibration"]
        assert own.drop("status", "reason_code").join(rows, on=own.columns[:7], how="anti").is_empty()


def test_the_chain_counts_where_the_joint_estimate_gave_nothing(
    flown: tuple[SimulatedFlight, dict[str, StageResult]],
) -> None:
    r, results = flown
    tables = {
        "vectors": results["vectors"].tables["calibration"],
        "gyroscope": results["gyro_output"].tables["calibration"],
        "samples": results["smoothing"].tables["samples"],
    }
    found = choose(tables, taken_from(settings(r.experiment, method="auto"), ChoiceSettings))
    assert found.measured["chosen"] == dict.fromkeys(SENSORS, "serial")
    assert set(found.tables["calibration"].filter(sensor="gyroscope", status="ok")["method"]) >= {"output_error"}


def test_where_the_joint_estimate_found_a_contradiction_the_chain_is_not_believed(
    flown: tuple[SimulatedFlight, dict[str, StageResult]],
) -> None:
    r, results = flown
    faults = [Fault(name, "", ReasonCode.JOINT_DIVERGED, 0.0, 0.0, True, "No minimum.") for name in SENSORS]
    tables = {
        "vectors": results["vectors"].tables["calibration"],
        "gyroscope": results["gyro_output"].tables["calibration"],
        "samples": results["smoothing"].tables["samples"],
        "joint_faults": fault_rows(faults),
    }
    found = choose(tables, taken_from(settings(r.experiment, method="auto"), ChoiceSettings))
    assert found.tables["calibration"].filter(status="ok").is_empty()
    assert "joint_diverged" in found.tables["calibration"]["reason_code"].to_list()
    # Where the chain was asked for, it is what one gets.
    asked = choose(tables, taken_from(settings(r.experiment, method="serial"), ChoiceSettings))
    assert not asked.tables["calibration"].filter(status="ok").is_empty()


def test_a_chosen_method_is_left_alone(flown: tuple[SimulatedFlight, dict[str, StageResult]]) -> None:
    r, _ = flown
    results = run_flight(signals(r), settings(r.experiment, method="serial"))
    rows = pl.concat([results[stage].tables["calibration"] for stage in ("vectors", "gyro_output")])
    assert results["choice"].tables["calibration"].equals(rows)


def test_the_vps_speaks_against_a_gyroscope_that_drifts(
    flown: tuple[SimulatedFlight, dict[str, StageResult]],
) -> None:
    r, results = flown
    fit = results["verify"].tables["fit"]
    worse = fit.with_columns(rms=pl.when(pl.col("method") == "joint").then(30.0).otherwise(pl.col("rms")))
    tables = {
        "vectors": results["vectors"].tables["calibration"],
        "gyroscope": results["gyro_output"].tables["calibration"],
        "joint": results["joint"].tables["calibration"],
        "samples": results["smoothing"].tables["samples"],
        "fit": worse,
    }
    found = choose(tables, taken_from(settings(r.experiment, method="auto"), ChoiceSettings))
    assert found.measured["chosen"]["gyroscope"] == "serial"
    assert found.measured["chosen"]["magnetometer"] == "joint"


def test_a_sample_rate_that_is_off_is_contradicted_by_the_vps() -> None:
    """Stamps 2 % too slow: rates by them are 2 % too small, and every scale would be wrong by as much."""
    r = simulate(seed=62)
    frames = signals(r)
    for name in ("imu", "magnetometer"):
        t = frames[name]["t_ns"].to_numpy()
        frames[name] = frames[name].with_columns(t_ns=pl.Series((t[0] + (t - t[0]) * 1.02).astype(np.int64)))
    results = run_flight(frames, settings(r.experiment, method="serial", vps_min_peak=0.2))
    rows = results["choice"].tables["calibration"].filter(sensor="gyroscope", parameter="scale")
    assert results["vps_sync"].reason_code == "clock_rates_differ"
    assert "1.9" in str(results["vps_sync"].reason)
    assert set(rows.filter(method="output_error")["reason_code"]) == {"clock_rates_differ"}
    assert set(rows["status"]) == {"refused"}


def test_gyroscope_constants_that_are_off_are_contradicted_by_the_vps(
    flown: tuple[SimulatedFlight, dict[str, StageResult]],
) -> None:
    r, results = flown
    own = results["joint"].tables["calibration"]
    wrong = own.with_columns(
        value=pl.when((pl.col("sensor") == "gyroscope") & (pl.col("axis") == "y") & (pl.col("parameter") != "zero"))
        .then(pl.col("value") * 1.08)
        .otherwise(pl.col("value"))
    )
    tables = {
        "joint": wrong,
        "samples": results["smoothing"].tables["samples"],
        "vps_aligned": results["vps_sync"].tables["vps_aligned"],
    }
    found = choose(tables, taken_from(settings(r.experiment, method="joint"), ChoiceSettings)).tables["calibration"]
    codes = dict(found.filter(sensor="gyroscope", parameter="scale").select("axis", "reason_code").iter_rows())
    assert codes == {"x": None, "y": "vps_contradicts", "z": None}
