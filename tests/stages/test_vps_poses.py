"""What a flight's VPS is, through the whole chain: poses left out and told, slow systems, inverse quaternions, far
clocks; the serial chain and the joint estimate see the same."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fieldcal.flight.calibrate import identify, read, run_stages
from fieldcal.geometry.rotation import conjugate, from_rotation_vector, multiply
from fieldcal.simulation.archive import settings, signals, write_flights
from fieldcal.simulation.experiment import Experiment, SimulatedFlight, simulate
from fieldcal.stages.pipeline import run_flight
from fieldcal.stages.results import StageResult

LAG_S = 0.4e-3  # five times what a healthy flight's lag is off by
SCALE = 0.01  # a twentieth of what an unmasked stretch does
MOUNTING = from_rotation_vector(np.array([0.03, -0.04, 0.01]))  # 2.9°
MOUNTING_DEG = float(np.degrees(np.sqrt(0.03**2 + 0.04**2 + 0.01**2)))


@pytest.fixture(scope="module")
def healthy() -> SimulatedFlight:
    """The paper's sensors and a good VPS at 120 Hz, mounted 2.9° askew."""
    return mounted(simulate(seed=51, vps_rate_hz=120.0))


def mounted(r: SimulatedFlight) -> SimulatedFlight:
    return replace(r, vps_q=multiply(r.vps_q, MOUNTING))


def flown(r: SimulatedFlight, method: str = "joint", **changes: Any) -> dict[str, StageResult]:
    return run_flight(signals(r), settings(r.experiment, **{"method": method, "use_vps": "auto", **changes}))


def told(results: dict[str, StageResult]) -> dict[str, str]:
    """Code → sentence of what `vps_sync` found."""
    faults = results["vps_sync"].measured["faults"]
    assert isinstance(faults, list)
    rows = results["vps_sync"].tables["faults"]
    assert [(f["code"], f["sentence"]) for f in faults] == list(rows.select("reason_code", "reason").iter_rows())
    return {str(f["code"]): str(f["sentence"]) for f in faults}


def lag_error(results: dict[str, StageResult], r: SimulatedFlight) -> float:
    return float(results["vps_sync"].tables["sync"]["lag_s"][0]) - r.lag_s


def joint_lag_error(results: dict[str, StageResult], r: SimulatedFlight) -> float:
    lag = results["joint"].measured["vps_lag_mid_s"]
    assert isinstance(lag, float)
    return lag - r.lag_at(0.5 * float(r.t[-1]))


def gyroscope_errors(results: dict[str, StageResult], r: SimulatedFlight) -> np.ndarray:
    rows = results["joint"].tables["calibration"].filter(sensor="gyroscope", parameter="scale", status="ok")
    found = dict(rows.select("axis", "value").iter_rows())
    return np.array([found[axis] for axis in "xyz"]) / r.experiment.scale["gyroscope"] - 1.0


def body_rotation_deg(results: dict[str, StageResult]) -> float:
    found = results["vps_sync"].measured["vps_body_rotation_deg"]
    assert isinstance(found, float)
    return found


def check_right(results: dict[str, StageResult], r: SimulatedFlight, lag_s: float = LAG_S) -> None:
    assert results["vps_sync"].status == "ok"
    assert results["joint"].measured["rung"] == "by_vps"
    assert abs(lag_error(results, r)) < lag_s
    assert abs(joint_lag_error(results, r)) < lag_s
    assert np.abs(gyroscope_errors(results, r)).max() < SCALE
    assert abs(body_rotation_deg(results) - MOUNTING_DEG) < 0.3


def rows_in(r: SimulatedFlight, starts: tuple[float, ...], length_s: float) -> np.ndarray:
    t = r.vps_t - r.vps_t[0]
    return np.any([(t > start) & (t < start + length_s) for start in starts], axis=0)


def moving(r: SimulatedFlight, n: int) -> tuple[float, ...]:
    """Starts of n stretches of 0.3 s, 2 s apart, in which the vehicle turns by 0.7 rad/s and more."""
    speed = np.linalg.norm(r.rate, axis=1)
    starts: list[float] = []
    for start in r.t[(r.t > 3.0) & (r.t < 37.0)]:
        slowest = speed[(r.t > start - 0.1) & (r.t < start + 0.4)].min()
        if slowest > 0.7 and (not starts or start > starts[-1] + 2.0):
            starts.append(float(start))
    assert len(starts) >= n
    return tuple(starts[:n])


def test_nothing_is_told_of_a_healthy_vps(healthy: SimulatedFlight) -> None:
    results = flown(healthy)
    assert told(results) == {}
    assert results["vps_sync"].measured["vps_masked"] == 0
    check_right(results, healthy)


def test_frozen_poses_are_left_out_and_told(healthy: SimulatedFlight) -> None:
    rows = rows_in(healthy, moving(healthy, 4), 0.3)
    source = np.maximum.accumulate(np.where(rows, -1, np.arange(len(rows))))
    r = replace(healthy, vps_q=healthy.vps_q[source], vps_position=healthy.vps_position[source])
    results = flown(r)
    check_right(results, r)
    sentence = told(results)["vps_frozen"]
    assert f"{rows.sum()} of the VPS's {len(rows)} poses" in sentence
    assert "4 stretches" in sentence
    assert results["vps_sync"].measured["vps_frozen"] == rows.sum()


def test_poses_that_stand_for_none_are_left_out_and_told(healthy: SimulatedFlight) -> None:
    rows = rows_in(healthy, moving(healthy, 5), 0.2)
    turned = multiply(np.array([0.5, 0.5, 0.5, 0.5]), healthy.vps_q)  # a world far from the identity
    q = np.where(rows[:, None], [0.0, 0.0, 0.0, 1.0], turned)
    r = replace(healthy, vps_q=q, vps_position=np.where(rows[:, None], 0.0, healthy.vps_position))
    results = flown(r)
    check_right(results, r)
    assert f"{rows.sum()} of the VPS's {len(rows)} poses" in told(results)["vps_default_pose"]


def test_a_vps_of_which_most_is_lost_is_refused(healthy: SimulatedFlight) -> None:
    rows = rows_in(healthy, tuple(np.arange(2.0, 38.0, 0.6)), 0.42)
    turned = multiply(np.array([0.5, 0.5, 0.5, 0.5]), healthy.vps_q)
    r = replace(healthy, vps_q=np.where(rows[:, None], [0.0, 0.0, 0.0, 1.0], turned))
    results = flown(r)
    assert rows.mean() > 0.5
    assert results["vps_sync"].reason_code == results["joint"].measured["use_vps_reason"] == "vps_lost"
    assert f"{rows.sum()} of the VPS's" in str(results["vps_sync"].reason)


def test_a_tracker_slower_than_its_log_gives_each_pose_once(healthy: SimulatedFlight) -> None:
    fast = mounted(simulate(seed=51, vps_rate_hz=360.0))
    source = np.arange(len(fast.vps_t)) // 3 * 3
    r = replace(fast, vps_q=fast.vps_q[source], vps_position=fast.vps_position[source])
    results = flown(r)
    check_right(results, r)
    assert "only every 3 rows" in told(results)["vps_held"]


@pytest.mark.parametrize(("rate_hz", "jitter_s"), [(20.0, 2e-3), (10.0, 4e-3)])
def test_slow_systems_with_jitter_are_used_and_told(rate_hz: float, jitter_s: float) -> None:
    slow = mounted(simulate(seed=51, vps_rate_hz=rate_hz))
    r = replace(slow, vps_t=slow.vps_t + jitter_s * np.random.default_rng(1).normal(size=len(slow.vps_t)))
    results = flown(r)
    # Stamps that scatter by j are known together to j / √n at best; those of turns count.
    check_right(results, r, lag_s=8.0 * jitter_s / np.sqrt(len(r.vps_t)))
    found = told(results)
    assert f"a pose every {1e3 / rate_hz:.0f} ms" in found["vps_slow"]
    assert "log when they were captured" in found["vps_jitter"]
    scatter = results["vps_sync"].measured["vps_stamp_jitter_s"]
    assert isinstance(scatter, float)
    assert scatter == pytest.approx(jitter_s, rel=0.3)


@pytest.mark.parametrize("method", ["joint", "serial"])
@pytest.mark.parametrize("mistake", ["inverse", "scalar first"])
def test_quaternions_of_another_convention_are_refused_with_its_name(
    healthy: SimulatedFlight, mistake: str, method: str
) -> None:
    q = conjugate(healthy.vps_q) if mistake == "inverse" else healthy.vps_q[:, [3, 0, 1, 2]]
    results = flown(replace(healthy, vps_q=q), method)
    found = results["vps_sync"]
    assert (found.status, found.reason_code) == ("refused", "vps_mirrored")
    assert "vps_aligned" not in found.tables
    first = str(found.reason).split("They are ")[1]
    assert first.startswith("the inverse" if mistake == "inverse" else "scalar first")
    assert f"mounted {MOUNTING_DEG:.0f}°" in first
    assert ("csv.vps.quaternion_wxyz" in first.split(";")[0]) == (mistake == "scalar first")
    if method == "joint":
        assert results["joint"].measured["use_vps_reason"] == "vps_mirrored"


def test_a_gyroscope_axis_wired_the_other_way_is_not_the_vps_mistake(healthy: SimulatedFlight) -> None:
    polarity = settings(healthy.experiment).polarity
    wrong = {**polarity, "gyroscope": [-polarity["gyroscope"][0], *polarity["gyroscope"][1:]]}
    reason = flown(healthy, polarity=wrong)["joint"].measured["use_vps_sentence"]
    assert "polarity.gyroscope" in str(reason)


@pytest.mark.parametrize("offset_s", [90.0, -150.0, 7200.0])
def test_a_clock_further_away_than_the_search_is_found_and_told(healthy: SimulatedFlight, offset_s: float) -> None:
    shifted = replace(healthy.experiment, vps_offset_s=offset_s)
    r = replace(healthy, experiment=shifted, vps_t=healthy.vps_t + offset_s - healthy.experiment.vps_offset_s)
    results = flown(r)
    check_right(results, r)
    # Starts are aligned first where the clocks are of different epochs: then nothing is beyond the search.
    assert ("vps_far" in told(results)) == (abs(offset_s) < 100.0)


@pytest.mark.parametrize("method", ["joint", "serial"])
def test_clocks_of_other_rates_refuse_the_gyroscope(healthy: SimulatedFlight, method: str) -> None:
    results = flown(replace(healthy, vps_t=1.03 * healthy.vps_t), method)
    assert results["vps_sync"].reason_code == "clock_rates_differ"
    rows = results["choice"].tables["calibration"].filter(sensor="gyroscope", parameter="scale")
    assert set(rows["status"]) == {"refused"}


def test_what_was_found_stands_among_the_flights_findings(tmp_path: Any) -> None:
    (log,) = write_flights(tmp_path, Experiment(seed=51, vps_rate_hz=20.0, duration_s=20.0, sets=1))
    document = run_stages(read(*identify(log))).document
    findings = document["flight"]["findings"]
    assert findings is not None
    assert [f["code"] for f in findings] == ["vps_slow"]


def test_poses_in_an_enu_world_are_read_alike(healthy: SimulatedFlight) -> None:
    """East-north-up and nose-left-up by scipy's rotations: the same lag, mounting and gyroscope."""
    ned_from_enu = Rotation.from_matrix([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    flu = Rotation.from_matrix(np.diag([1.0, -1.0, -1.0]))
    q = (ned_from_enu * Rotation.from_quat(healthy.vps_q) * flu).as_quat()
    r = replace(healthy, vps_q=q)
    results = flown(r, world="enu", body="flu", rotation_body_from_sensor=np.diag([1.0, -1.0, -1.0]).tolist())
    assert told(results) == {}
    check_right(results, r)
