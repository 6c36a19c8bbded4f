"""Estimators on arrays against the simulator's truth, and their refusals."""

from __future__ import annotations

import numpy as np
import pytest

import fieldcal
from fieldcal.geometry.rotation import angle_between
from fieldcal.simulation.experiment import constants_at

SIGNS = {"magnetometer": (1, 1, -1), "accelerometer": (1, 1, -1), "gyroscope": (-1, 1, 1)}
FARTHEST = 4.0  # error ÷ sd
STILL = np.ones((500, 3))


@pytest.fixture(scope="module")
def flight() -> fieldcal.SimulatedFlight:
    return fieldcal.simulate(seed=7)


def true_scale(flight: fieldcal.SimulatedFlight, name: str) -> np.ndarray:
    return np.asarray(constants_at(flight.experiment, name, 25.0)[0])


def test_ellipsoid(flight: fieldcal.SimulatedFlight) -> None:
    logged = flight.counts["magnetometer"]
    fit = fieldcal.fit_ellipsoid(logged, 1.0, polarity=SIGNS["magnetometer"])
    error = fit.scale_diagonal - true_scale(flight, "magnetometer")
    assert (np.abs(error) < FARTHEST * fit.scale_sd).all()
    assert fit.bias_sd.shape == (3,)
    assert np.abs(np.linalg.norm(fit.apply(logged), axis=1) - 1.0).max() < 0.05


def test_an_ellipsoid_that_is_not_determined_is_refused(flight: fieldcal.SimulatedFlight) -> None:
    logged = flight.counts["magnetometer"]
    with pytest.raises(fieldcal.UnusableFlight) as told:
        fieldcal.fit_ellipsoid(logged, 1.0, max_scale_sd=1e-4)
    assert told.value.reason_code == "scale_uncertain"
    assert max(told.value.measured["scale_relative_sd"]) > 1e-4
    with pytest.raises(ValueError, match="non-finite"):
        fieldcal.fit_ellipsoid(np.full((20, 3), np.nan), 1.0)


def test_output_error(flight: fieldcal.SimulatedFlight) -> None:
    fit = fieldcal.fit_output_error(flight.t, flight.q, flight.counts["gyroscope"])
    error = fit.scale - true_scale(flight, "gyroscope")
    assert (np.abs(error) < FARTHEST * fit.scale_sd).all()
    angle = np.linalg.norm(fit.attitude_error, axis=1)
    assert np.sqrt(np.mean(angle**2)) == pytest.approx(fit.residual_rms, rel=0.05)
    assert fit.apply(flight.counts["gyroscope"]) == pytest.approx(fit.rate)
    again = fieldcal.fit_output_error(flight.t, -flight.q, flight.counts["gyroscope"], start=fit)
    assert again.scale == pytest.approx(fit.scale, rel=1e-3)


def test_output_error_refuses_what_did_not_turn(flight: fieldcal.SimulatedFlight) -> None:
    n = len(STILL)
    with pytest.raises(fieldcal.UnusableFlight, match="stuck, or never turned"):
        fieldcal.fit_output_error(flight.t[:n], flight.q[:n], STILL)
    with pytest.raises(fieldcal.UnusableFlight) as told:
        fieldcal.fit_output_error(flight.t, flight.q, flight.counts["gyroscope"], max_scale_sd=1e-5)
    assert told.value.reason_code == "scale_uncertain"
    with pytest.raises(ValueError, match="wanted, got"):
        fieldcal.fit_output_error(flight.t, flight.q[:, :3], flight.counts["gyroscope"])


def test_joint(flight: fieldcal.SimulatedFlight) -> None:
    joint = fieldcal.fit_joint(flight.t, **flight.counts, gravity_mps2=9.81, polarity=SIGNS)
    for name in SIGNS:
        scale = getattr(joint, name).scale
        assert (np.abs(scale.value - true_scale(flight, name)) < FARTHEST * scale.sd).all(), name
    assert np.degrees(np.sqrt(np.mean(angle_between(joint.attitude, flight.q) ** 2))) < 0.5
    assert abs(joint.dip_rad) < FARTHEST * joint.dip_sd_rad
    assert joint.accelerometer.bias.unit == "m/s^2"


def test_joint_refuses_by_axis_and_leaves_out_what_it_is_not_given(
    flight: fieldcal.SimulatedFlight,
) -> None:
    start = {"gyroscope": constants_at(flight.experiment, "gyroscope", 25.0)}
    joint = fieldcal.fit_joint(
        flight.t,
        flight.counts["gyroscope"],
        magnetometer=flight.counts["magnetometer"],
        start=start,
        polarity={**SIGNS, "gyroscope": (1, 1, 1)},
    )
    assert joint.gyroscope.scale.status == ("refused", "ok", "ok")
    assert joint.gyroscope.scale["y"] > 0
    with pytest.raises(fieldcal.Refused, match="polarity_contradiction"):
        _ = joint.gyroscope.scale.value
    with pytest.raises(fieldcal.Refused, match="No accelerometer readings"):
        _ = joint.accelerometer.scale.value
    with pytest.raises(fieldcal.UnusableFlight, match="no start"):
        fieldcal.fit_joint(flight.t, flight.counts["gyroscope"])
    with pytest.raises(ValueError, match="gravity_sign"):
        fieldcal.fit_joint(flight.t, **flight.counts, gravity_sign="up")


@pytest.mark.parametrize("with_magnetometer", [False, True])
def test_clocks(flight: fieldcal.SimulatedFlight, with_magnetometer: bool) -> None:
    q = flight.vps_q.copy()
    q[[100, 2000, 2001]] = [0.5, 0.5, 0.5, 0.5]  # outliers are left out
    sync = fieldcal.synchronise(
        flight.t,
        flight.counts["gyroscope"],
        flight.vps_t,
        q,
        magnetometer=flight.counts["magnetometer"] if with_magnetometer else None,
    )
    middle = flight.lag_at(sync.reference_s)
    assert abs(sync.lag_mid_s - middle) < FARTHEST * sync.lag_sd_s
    assert sync.lag_sd_s < (2e-4 if with_magnetometer else 2e-3)
    assert "jump away" in sync.findings[0]
    far = fieldcal.synchronise(flight.t, flight.counts["gyroscope"], flight.vps_t, flight.vps_q, max_lag_s=0.01)
    assert abs(far.lag_mid_s - flight.lag_at(far.reference_s)) < FARTHEST * far.lag_sd_s
    assert "further than vps_max_lag_s" in far.findings[-1]
    frozen = np.where((flight.vps_t < flight.vps_t[-1] * 0.6)[:, None], flight.vps_q[:1], flight.vps_q)
    with pytest.raises(fieldcal.UnusableFlight, match="Most of the VPS's poses") as refused:
        fieldcal.synchronise(flight.t, flight.counts["gyroscope"], flight.vps_t, frozen)
    assert refused.value.reason_code == "vps_lost"
