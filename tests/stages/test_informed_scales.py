"""What is published of a scale is the recording's, not what was known beforehand."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest

from fieldcal.estimation.joint.problem import PriorConstants
from fieldcal.names import Sensor
from fieldcal.reason_codes import ReasonCode
from fieldcal.simulation.archive import settings, signals, truth
from fieldcal.simulation.experiment import simulate
from fieldcal.simulation.ordinary import ordinary_flight
from fieldcal.stages.joint.judgement import MAX_LEVEL_SCALE_SD, informed
from fieldcal.stages.pipeline import run_flight

PRIOR = PriorConstants(np.ones(3), np.zeros(3), np.diag([0.03**2] * 3 + [0.1**2] * 3))


@pytest.mark.parametrize(("sd", "told"), [(0.0149, True), (0.0151, False), (0.03, False)])
def test_a_scale_that_is_known_to_more_than_half_of_what_was_known_before_is_refused(sd: float, told: bool) -> None:
    covariance = np.diag([0.001**2, sd**2, 0.001**2, *[1e-6] * 3])
    expected = [None, None if told else ReasonCode.SCALE_UNCERTAIN, None]
    assert informed([None] * 3, covariance, PRIOR) == expected
    assert informed([None] * 3, covariance, None) == [None] * 3


def test_another_reason_stays() -> None:
    codes: list[ReasonCode | None] = [ReasonCode.NOT_A_SPHERE] * 3
    assert informed(codes, np.diag([0.03**2] * 6), PRIOR) == codes


def test_an_axis_about_which_a_vehicle_hardly_turns_has_no_scale_of_its_prior() -> None:
    """Readings in SI, turned in bank and pitch alone: of the heading's axis three per cent were known before."""
    scale = {"gyroscope": (1.05, 0.97, 1.04), "accelerometer": (1.0, 1.01, 0.99), "magnetometer": (1.0, 1.02, 0.98)}
    bias = {"gyroscope": (0.01, 0.02, -0.01), "accelerometer": (0.1, 0.1, 0.1), "magnetometer": (0.01, 0.02, 0.03)}
    turned = {"turned": (1.0, 1.0, 0.05), "tremor_rad": 0.0, "cross_coupling": 0.0}
    r = simulate(seed=5, logged="si", scale=scale, bias=bias, **turned)
    rows = run_flight(signals(r), settings(r.experiment, method="joint", use_vps=False))["joint"].tables["calibration"]
    own = rows.filter(sensor="gyroscope")
    status = own.filter(parameter="scale").select("axis", "status", "reason_code").rows()
    assert status == [("x", "ok", None), ("y", "ok", None), ("z", "refused", "scale_uncertain")]
    for k, row in enumerate(own.filter(parameter="zero").iter_rows(named=True)):
        assert row["status"] == "ok"
        assert abs(row["value"] + bias["gyroscope"][k] / scale["gyroscope"][k]) < 4.0 * row["sd"]


@pytest.mark.parametrize("seed", [1, 3, 9])
def test_a_flight_that_banks_to_accelerate_tells_no_scale_of_its_magnetometer_without_a_velocity(seed: int) -> None:
    """It feels gravity along its own axes and seems to stay level. The zero is told."""
    r = simulate(ordinary_flight("mission", seed))
    given = settings(r.experiment, method="auto", use_velocity=False)
    joint = run_flight(signals(r), given)["joint"]
    assert joint.measured["rung"] == "held"
    own = joint.tables["calibration"].filter(sensor="magnetometer")
    scales = own.filter(parameter="scale", status="ok").filter(pl.col("axis").str.len_chars() == 1)
    assert all(row["sd"] < MAX_LEVEL_SCALE_SD * row["value"] for row in scales.iter_rows(named=True))
    assert scales.height < 3
    zeros = own.filter(parameter="zero", status="ok")
    assert zeros.height >= 2
    for row in zeros.iter_rows(named=True):
        expected = truth(r)["constants"][Sensor.MAGNETOMETER]["zero"]["xyz".index(row["axis"])]
        assert abs(row["value"] - expected) < 4.0 * row["sd"]


@pytest.mark.parametrize("motion", ["hover", "mission"])
def test_what_a_level_flight_does_not_tell_alone_counts_nowhere_without_a_velocity(motion: str) -> None:
    """A tilt that nobody sees moves scales the same way in every flight: pooled they would be surer and as wrong."""
    r = simulate(ordinary_flight(motion, 3))
    given = settings(r.experiment, method="auto", use_velocity=False)
    joint = run_flight(signals(r), given)["joint"]
    rows, information = joint.tables["calibration"], joint.tables["information"]
    told = rows.filter(parameter="scale", status="ok").select("sensor", "axis").rows()
    counting = information.filter(status="ok")
    assert counting.filter(parameter="gain").select("sensor", "axis").rows() == told
    zeros = rows.filter(parameter="zero", sensor="gyroscope", status="ok")
    assert counting.filter(parameter="zero", sensor="gyroscope").height == zeros.height
    counted = counting.filter(parameter="cross")["sensor"].unique().to_list()
    assert all(len([one for one in told if one[0] == sensor]) == 3 for sensor in counted)


def test_with_a_velocity_what_is_uncertain_alone_counts() -> None:
    r = simulate(ordinary_flight("hover", 3))
    information = run_flight(signals(r), settings(r.experiment, method="auto"))["joint"].tables["information"]
    assert information.filter(sensor="magnetometer", parameter="gain", status="ok").height == 3
