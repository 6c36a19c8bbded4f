"""Insane sensors are told by a number, sane ones left alone, and no fit that trusts an insane one is called good."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import polars as pl
import pytest

from fieldcal.config.configuration import Vehicle, parse
from fieldcal.config.flight_settings import flight_settings
from fieldcal.estimation import faults
from fieldcal.estimation.faults import (
    accelerometer_unit,
    channel_faults,
    coarse_faults,
    gyroscope_unit,
    magnetometer_unit,
    resolution,
    sampling_faults,
)
from fieldcal.names import SENSORS
from fieldcal.simulation.archive import signals
from fieldcal.simulation.experiment import simulate
from fieldcal.stages.pipeline import PUBLISHED, run_flight
from fieldcal.stages.results import StageResult
from fieldcal.stages.tables import columns_of, triad

FIELD_UT = 45.0
DIP_RAD = 1.1
T = np.arange(20_000) / 200.0
Readings = dict[str, np.ndarray]


def moving(seed: int = 0, counts: bool = False) -> np.ndarray:
    """(n, 3) readings of something that turns, with noise."""
    rng = np.random.default_rng(seed)
    slow = np.stack([np.sin(T * w + p) for w, p in ((1.3, 0.0), (0.9, 1.0), (1.7, 2.0))], axis=1)
    x = 2.0 * slow * (1.0 + 0.3 * np.sin(0.11 * T))[:, None] + 0.01 * rng.normal(size=(len(T), 3))
    return np.rint(x * 1000.0) if counts else x


def codes(faults: list[faults.Fault]) -> list[tuple[str, str, bool]]:
    return [(fault.code, fault.axis, fault.fatal) for fault in faults]


@pytest.mark.parametrize("counts", [False, True])
def test_living_channels_have_no_fault(counts: bool) -> None:
    x = moving(counts=counts)
    assert channel_faults("gyroscope", T, x, "rad/s", None if counts else 1.0) == []
    held = np.repeat(x[::8], 8, axis=0)
    assert channel_faults("magnetometer", T, held, "counts", None) == []
    at_rest = np.rint(np.random.default_rng(1).normal(0.0, 0.6, (len(T), 3)))
    assert channel_faults("gyroscope", T, at_rest, "counts", None) == []
    clean = np.rint(500.0 * np.stack([np.sin(T), np.cos(T), np.sin(2 * T)], axis=1))
    assert channel_faults("gyroscope", T, clean, "counts", None) == []


def test_a_dead_channel() -> None:
    x = moving()
    x[:, 1] = 0.0
    x[:, 2] = 7.5
    assert codes(channel_faults("gyroscope", T, x, "rad/s", 1.0)) == [("all_zero", "y", True), ("stuck", "z", True)]


@pytest.mark.parametrize(("seconds", "fatal"), [(1.5, False), (20.0, True)])
def test_a_channel_that_stands_for_a_while(seconds: float, fatal: bool) -> None:
    x = moving()
    held = (T >= 40.0) & (40.0 + seconds > T)
    x[held, 0] = x[8000, 0]
    (fault,) = channel_faults("gyroscope", T, x, "rad/s", 1.0)
    assert (fault.code, fault.axis, fault.fatal) == ("stuck", "x", fatal)
    assert fault.value == pytest.approx(seconds / T[-1], rel=0.02)


def test_a_value_before_and_after_a_pause_of_the_log_was_not_held_meanwhile() -> None:
    """A coarse channel comes back from a pause with the value of before often enough; a stuck one stands on both sides
    of it."""
    t = np.where(np.arange(len(T)) < 8000, T, T + 80.0)
    x = moving(counts=True)
    x[8000, 0] = x[7999, 0]
    assert channel_faults("magnetometer", t, x, "counts", None) == []
    x[7600:8400, 0] = x[7600, 0]
    (fault,) = channel_faults("magnetometer", t, x, "counts", None)
    assert fault.value == pytest.approx(4.0 / t[-1], rel=0.02)


@pytest.mark.parametrize("counts", [False, True])
def test_a_clipped_channel_counts_its_samples(counts: bool) -> None:
    x = moving(counts=counts)
    rail = 0.8 * x[:, 2].max()
    clipped = int((x[:, 2] >= rail).sum())
    x[:, 2] = np.minimum(x[:, 2], rail)
    (fault,) = channel_faults("gyroscope", T, x, "rad/s", None)
    assert (fault.code, fault.axis, fault.fatal) == ("saturated", "z", True)
    assert fault.value == clipped / len(T)
    assert f"{clipped} of {len(T)} samples" in fault.sentence


def test_a_random_channel() -> None:
    x = moving()
    x[:, 0] = np.random.default_rng(2).uniform(-35.0, 35.0, len(T))
    (fault,) = channel_faults("gyroscope", T, x, "rad/s", 1.0)
    assert (fault.code, fault.axis, fault.fatal) == ("random", "x", True)
    assert fault.value == pytest.approx(1.0, abs=0.05)


def test_units_by_length() -> None:
    down = np.tile([0.3, -0.2, 9.79], (100, 1))
    assert accelerometer_unit(down, "m/s^2", 1.0, 9.81) is None
    wrong = accelerometer_unit(down / 9.80665, "m/s^2", 1.0, 9.81)
    assert wrong is not None
    assert wrong.value == pytest.approx(0.1, abs=0.01)
    assert "in g they would be 1.00" in wrong.sentence
    field = np.tile([20.0, 5.0, 42.0], (100, 1))
    assert magnetometer_unit(field, "uT", 1e-6, None) is None
    for factor, name in ((0.01, "G"), (1e-6, "T"), (1000.0, "nT"), (10.0, "mG")):
        wrong = magnetometer_unit(field * factor, "uT", 1e-6, 46.8e-6)
        assert wrong is not None
        assert f"in {name} they would be 1.00" in wrong.sentence
    assert gyroscope_unit(moving(), "rad/s", 1.0) is None
    wrong = gyroscope_unit(np.degrees(moving()), "rad/s", 1.0)
    assert wrong is not None
    assert "look like deg/s" in wrong.sentence


def test_lost_samples_and_changed_rates_are_told_and_not_fatal() -> None:
    assert sampling_faults("gyroscope", T) == []
    keep = np.ones(len(T), bool)
    for start in range(1000, 20_000, 1000):
        keep[start : start + 10] = False
    (fault,) = sampling_faults("gyroscope", T[keep])
    assert (fault.code, fault.fatal) == ("dropouts", False)
    assert fault.value == pytest.approx(190 / len(T), abs=1e-6)
    slower = np.r_[T[:10_000], T[9_999] + np.arange(1, 5000) / 100.0]
    codes_found = {fault.code for fault in sampling_faults("gyroscope", slower)}
    assert "rate_changes" in codes_found


# --- the whole chain


def vehicle(polarity: str = "") -> Vehicle:
    north, down = FIELD_UT * np.cos(DIP_RAD), FIELD_UT * np.sin(DIP_RAD)
    field = f'field = {{ north_east_down = [{north}, 0.0, {down}], unit = "uT" }}\n'
    return parse(f"[vehicles.a]\ngravity_mps2 = 9.81\n{field}{polarity}\n", None).vehicle("a")


UNITS = {"gyroscope": "rad/s", "accelerometer": "m/s^2", "magnetometer": "uT"}


@pytest.fixture(scope="module")
def flown() -> tuple[np.ndarray, Readings]:
    """Stamps, ns, and readings in SI of the paper's manoeuvre."""
    recording = simulate(seed=1001, dip_rad=DIP_RAD, vps=False)
    e = recording.experiment
    si = {n: recording.counts[n] * np.array(e.scale[n]) + np.array(e.bias[n]) for n in SENSORS}
    si["magnetometer"] = si["magnetometer"] * FIELD_UT
    return signals(recording)["imu"]["t_ns"].to_numpy(), si


def calibrated(
    t_ns: np.ndarray, readings: Readings, units: dict[str, str] | None = None, method: str = "serial"
) -> dict[str, StageResult]:
    imu = np.hstack([readings["gyroscope"], readings["accelerometer"]])
    tables = {
        "imu": pl.DataFrame({"t_ns": t_ns, **columns_of(imu, triad("gyroscope") + triad("accelerometer"))}),
        "magnetometer": pl.DataFrame({"t_ns": t_ns, **columns_of(readings["magnetometer"], triad("magnetometer"))}),
    }
    settings = flight_settings(vehicle(), units={**UNITS, **(units or {})})
    return run_flight(tables, settings.changed(method=method))


def good(results: dict[str, StageResult]) -> set[tuple[str, str]]:
    """(sensor, axis) of every scale that would be published as good."""
    tables = {f"{stage}.{name}": t for stage, result in results.items() for name, t in result.tables.items()}
    published = [tables[name] for name in PUBLISHED["calibration"] if name in tables]
    if not published:
        return set()
    rows = pl.concat(published)
    return set(rows.filter(parameter="scale", status="ok").select("sensor", "axis").iter_rows())


def told(results: dict[str, StageResult]) -> set[str]:
    """Reason codes of what was refused, stages and axes."""
    stages = {result.reason_code for result in results.values() if result.status == "refused"}
    axes = {
        code
        for result in results.values()
        if "calibration" in result.tables
        for code in result.tables["calibration"]["reason_code"].drop_nulls().to_list()
    }
    return {code for code in stages | axes if code is not None}


def clipped(x: np.ndarray, share: float = 0.5) -> np.ndarray:
    middle, reach = np.median(x, axis=0), np.abs(x - np.median(x, axis=0)).max(axis=0)
    return np.clip(x, middle - share * reach, middle + share * reach)


def stuck(x: np.ndarray, axis: int) -> np.ndarray:
    x = x.copy()
    x[len(x) // 3 : 2 * len(x) // 3, axis] = x[len(x) // 3, axis]
    return x


def with_axis(x: np.ndarray, axis: int, values: np.ndarray | float) -> np.ndarray:
    x = x.copy()
    x[:, axis] = values
    return x


G = 9.80665
TRIADS = {s: {(s, a) for a in "xyz"} for s in SENSORS}
ALL = set.union(*TRIADS.values())
Change = Callable[[Readings], Readings]
CASES: dict[str, tuple[Change, set[tuple[str, str]], set[str]]] = {
    "accelerometer in g": (
        lambda r: {"accelerometer": r["accelerometer"] / G},
        TRIADS["accelerometer"],
        {"wrong_unit"},
    ),
    "gyroscope in deg/s": (lambda r: {"gyroscope": np.degrees(r["gyroscope"])}, TRIADS["gyroscope"], {"wrong_unit"}),
    "gyroscope too small by 57": (
        lambda r: {"gyroscope": np.radians(r["gyroscope"])},
        TRIADS["gyroscope"],
        {"scale_not_nominal"},
    ),
    "magnetometer in gauss": (
        lambda r: {"magnetometer": r["magnetometer"] * 0.01},
        TRIADS["magnetometer"],
        {"wrong_unit"},
    ),
    "magnetometer in tesla": (
        lambda r: {"magnetometer": r["magnetometer"] * 1e-6},
        TRIADS["magnetometer"],
        {"wrong_unit"},
    ),
    "magnetometer's y turned round": (
        lambda r: {"magnetometer": r["magnetometer"] * [1, -1, 1]},
        ALL,
        {"vectors_contradict"},
    ),
    "accelerometer's x turned round": (
        lambda r: {"accelerometer": r["accelerometer"] * [-1, 1, 1]},
        ALL,
        {"vectors_contradict"},
    ),
    "accelerometer upside down": (
        lambda r: {"accelerometer": -r["accelerometer"]},
        ALL,
        {"gravity_sign_contradiction"},
    ),
    "gyroscope's z turned round": (
        lambda r: {"gyroscope": r["gyroscope"] * [1, 1, -1]},
        {("gyroscope", "z")},
        {"gyro_contradicts_attitude", "polarity_contradiction"},
    ),
    "gyroscope's x and y swapped": (
        lambda r: {"gyroscope": r["gyroscope"][:, [1, 0, 2]]},
        {("gyroscope", "x"), ("gyroscope", "y")},
        {"scale_uncertain", "gyro_contradicts_attitude", "scale_not_nominal"},
    ),
    "magnetometer's x and z swapped": (
        lambda r: {"magnetometer": r["magnetometer"][:, [2, 1, 0]]},
        ALL,
        {"vectors_contradict"},
    ),
    "gyroscope clipped": (lambda r: {"gyroscope": clipped(r["gyroscope"])}, TRIADS["gyroscope"], {"saturated"}),
    "accelerometer clipped": (
        lambda r: {"accelerometer": clipped(r["accelerometer"], 0.8)},
        TRIADS["accelerometer"] | TRIADS["gyroscope"],
        {"saturated"},
    ),
    "magnetometer clipped": (
        lambda r: {"magnetometer": clipped(r["magnetometer"], 0.8)},
        TRIADS["magnetometer"] | TRIADS["gyroscope"],
        {"saturated"},
    ),
    "gyroscope's y stuck": (lambda r: {"gyroscope": stuck(r["gyroscope"], 1)}, TRIADS["gyroscope"], {"stuck"}),
    "accelerometer's z stuck": (
        lambda r: {"accelerometer": stuck(r["accelerometer"], 2)},
        TRIADS["accelerometer"] | TRIADS["gyroscope"],
        {"stuck"},
    ),
    "magnetometer's x stuck": (
        lambda r: {"magnetometer": stuck(r["magnetometer"], 0)},
        TRIADS["magnetometer"] | TRIADS["gyroscope"],
        {"stuck"},
    ),
    "magnetometer dead": (
        lambda r: {"magnetometer": np.zeros_like(r["magnetometer"])},
        TRIADS["magnetometer"],
        {"all_zero"},
    ),
    "gyroscope's x dead": (
        lambda r: {"gyroscope": with_axis(r["gyroscope"], 0, 0.0)},
        TRIADS["gyroscope"],
        {"all_zero"},
    ),
    "accelerometer's y random": (
        lambda r: {
            "accelerometer": with_axis(
                r["accelerometer"], 1, np.random.default_rng(1).uniform(-80, 80, len(r["accelerometer"]))
            )
        },
        TRIADS["accelerometer"] | TRIADS["gyroscope"],
        {"random", "wrong_unit"},
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_no_insane_recording_is_called_good(flown: tuple[np.ndarray, Readings], case: str) -> None:
    t_ns, readings = flown
    change, not_good, reasons = CASES[case]
    results = calibrated(t_ns, {**readings, **change(readings)}, method="serial")
    assert not good(results) & not_good
    assert told(results) & reasons, told(results)
    assert all(result.status != "failed" for result in results.values())


@pytest.mark.parametrize("case", CASES)
def test_beside_an_insane_sensor_only_what_is_right_is_called_good(
    flown: tuple[np.ndarray, Readings], case: str
) -> None:
    """The joint estimate may do without one vector triad: it never publishes that one, and of the others what is right
    (readings in SI, so that scales are 1 and zeros 0)."""
    t_ns, readings = flown
    change, not_good, reasons = CASES[case]
    results = calibrated(t_ns, {**readings, **change(readings)}, method="auto")
    changed = change(readings).keys()
    assert not good(results) & {(sensor, axis) for sensor, axis in not_good if sensor in changed}
    assert told(results) & reasons, told(results)
    rows = results["choice"].tables.get("calibration")
    published = [] if rows is None else rows.filter(parameter="scale", status="ok").iter_rows(named=True)
    for row in published:
        assert abs(row["value"] - 1.0) < 4.0 * row["sd"], row


def test_the_sane_recording_is_called_good(flown: tuple[np.ndarray, Readings]) -> None:
    results = calibrated(*flown)
    assert good(results) == ALL
    assert results["sanity"].measured["faults"] == []


def still(turning: tuple[float, float, float], seconds: float = 60.0) -> tuple[np.ndarray, Readings]:
    """Stamps and readings of a vehicle that only turns about down, with rate amplitudes; noise as MEMS have."""
    rng = np.random.default_rng(5)
    t = np.arange(int(seconds * 200)) / 200.0
    yaw = turning[2] * (1.0 - np.cos(0.8 * t))
    north, down = FIELD_UT * np.cos(DIP_RAD), FIELD_UT * np.sin(DIP_RAD)
    readings: Readings = {
        "gyroscope": np.stack([0 * t, 0 * t, turning[2] * 0.8 * np.sin(0.8 * t)], axis=1),
        "accelerometer": np.tile([0.0, 0.0, 9.81], (len(t), 1)),
        "magnetometer": np.stack([north * np.cos(yaw), -north * np.sin(yaw), 0 * t + down], axis=1),
    }
    noise = {"gyroscope": 0.003, "accelerometer": 0.02, "magnetometer": 0.2}
    noisy = {n: x + noise[n] * rng.normal(size=x.shape) for n, x in readings.items()}
    return np.rint(t * 1e9).astype(np.int64), noisy


def test_planar_and_static_recordings() -> None:
    planar = calibrated(*still((0.0, 0.0, 2.0)))
    assert good(planar) <= {("gyroscope", "z")}
    assert {"magnetometer", "accelerometer_pass2"} <= {n for n, r in planar.items() if r.status == "refused"}
    assert all(planar[stage].measured for stage in ("magnetometer", "accelerometer_pass2"))
    static = calibrated(*still((0.0, 0.0, 0.0)))
    assert good(static) == set()
    assert static["manoeuvre"].reason_code == "too_little_motion"
    assert static["manoeuvre"].measured["excited_s"] < 10.0


def test_faults_of_a_flight_are_rows() -> None:
    t_ns, readings = still((0.0, 0.0, 2.0))
    results = calibrated(t_ns, {**readings, "gyroscope": with_axis(readings["gyroscope"], 0, 0.0)})
    (row,) = results["sanity"].tables["faults"].iter_rows(named=True)
    assert (row["sensor"], row["axis"], row["reason_code"], row["fatal"]) == ("gyroscope", "x", "all_zero", True)
    found: dict[str, Any] = results["sanity"].measured["faults"][0]
    assert found["value"] == row["number"]
    assert replace(faults.Fault(**found)).sentence == row["reason"]


def test_a_coarse_sensor_that_lies_still_is_not_stuck() -> None:
    """Ten bits: for four seconds at rest one axis reads one value while the others step by one now and then."""
    rng = np.random.default_rng(5)
    t = np.arange(0.0, 30.0, 0.01)
    moving = 400.0 + 60.0 * np.sin(2.0 * np.pi * np.outer(t, [0.5, 0.7, 0.9])) + rng.normal(size=(len(t), 3))
    x = np.rint(moving)
    still = slice(1000, 1400)
    x[still] = 420.0
    x[still, 0] += rng.integers(0, 2, 400)
    x[still, 2] += rng.integers(0, 2, 400)
    assert "stuck" not in {fault.code for fault in channel_faults("accelerometer", t, x, "counts", None)}
    x[still, 0] = np.rint(moving[still, 0])  # the sensor turns, its y does not follow
    assert [fault.axis for fault in channel_faults("accelerometer", t, x, "counts", None)] == ["y"]
    x[still] = 420.0  # nothing changes at all: the logger froze
    assert {fault.axis for fault in channel_faults("accelerometer", t, x, "counts", None)} == {"x", "y", "z"}


def test_two_steps_of_one_axis_beside_are_still_rest() -> None:
    """While x stands for 3 s, y moves by two of its steps and z not at all: nothing of a stuck sensor."""
    rng = np.random.default_rng(4)
    x = np.cumsum(rng.choice([-1.0, 1.0], size=(4000, 3)), axis=0)
    hold = slice(2000, 2600)
    x[hold, 0] = x[2000, 0]
    x[hold, 1] = x[2000, 1] + np.where(np.arange(600) % 2, 2.0, 0.0)
    x[hold, 2] = x[2000, 2]
    t = np.arange(4000) / 200.0
    assert not [f for f in channel_faults("gyroscope", t, x, "counts", None) if f.axis == "x"]
    x[hold, 1] = x[2000, 1] + np.where(np.arange(600) % 2, 3.0, 0.0)
    assert [f.code for f in channel_faults("gyroscope", t, x, "counts", None) if f.axis == "x"] == ["stuck"]


def test_values_too_coarse_for_their_motion_are_refused_with_the_step() -> None:
    rng = np.random.default_rng(6)
    t = np.arange(0.0, 30.0, 0.01)
    x = 5.0 * np.sin(2.0 * np.pi * np.outer(t, [0.5, 0.7, 0.9])) + 0.01 * rng.normal(size=(len(t), 3))
    (fault, *others) = coarse_faults("accelerometer", np.rint(x), "m/s^2")
    assert [f.code for f in (fault, *others)] == ["coarse"] * 3
    assert fault.fatal
    assert "steps of 1 m/s^2" in fault.sentence
    # A tenth of that is fine, whatever the unit's own rounding in floating point.
    assert coarse_faults("accelerometer", np.rint(x * 10.0) / 10.0, "m/s^2") == []
    assert coarse_faults("accelerometer", np.rint(x * 10.0) / 10.0 + 0.3, "m/s^2") == []


def test_noise_of_a_step_makes_coarse_values_ordinary_noise() -> None:
    rng = np.random.default_rng(7)
    x = np.rint(rng.normal(scale=1.4, size=(3000, 3)))
    assert coarse_faults("gyroscope", x, "counts") == []


def test_resolution_is_the_least_step() -> None:
    assert resolution(np.array([3.0, 5.0, 5.0, 9.0])) == 2.0
    assert resolution(np.full(4, 7.0)) == 0.0
    assert resolution(np.array([0.1, 0.2, 0.1 + 0.2, 0.3])) == pytest.approx(0.1)
