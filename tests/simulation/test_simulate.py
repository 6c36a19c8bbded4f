"""The simulator keeps its promises: noise, delay, words, translation, clocks, losses, seeds, and what it writes."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
from numerics_support import angle, rms
from scipy.spatial.transform import Rotation

from fieldcal.config.configuration import load
from fieldcal.estimation.clock_sync import by_rates
from fieldcal.geometry.rotation import conjugate, multiply, to_rotation_vector
from fieldcal.logs import find_logs, read_log
from fieldcal.names import SENSORS
from fieldcal.simulation.archive import settings, signals, truth, write_flights
from fieldcal.simulation.experiment import (
    BIAS,
    NOISE_VARIANCE,
    SCALE,
    TICK_S,
    VPS_VARIANCE,
    Experiment,
    Motion,
    SimulatedFlight,
    constants_at,
    simulate,
)

BARE: dict[str, Any] = {"noise": False, "quantisation": False, "band_limit": False}
FILTER_DELAY_S = 2 * np.sqrt(0.5) / (2 * np.pi * 50.0)
GROUP_DELAY_RIPPLE = 1e-5  # share of a signal below 1 Hz that a 50 Hz filter does more than delay
ROUNDING = 1e-9


def sensed(r: SimulatedFlight, sensor: str) -> np.ndarray:
    """True values of a sensor in SI (or norm): Eq. 5 with the true constants."""
    return r.counts[sensor] * np.array(SCALE[sensor]) + np.array(BIAS[sensor])


def motion_of(r: SimulatedFlight) -> Motion:
    return Motion(r.experiment, np.random.default_rng(np.random.SeedSequence(r.experiment.seed).spawn(6)[0]))


@pytest.fixture(scope="module")
def paper() -> SimulatedFlight:
    return simulate(seed=1)


@pytest.fixture(scope="module")
def filtered() -> SimulatedFlight:
    """The same flight without noise and quantisation, but behind the sensors' filter."""
    return simulate(seed=1, noise=False, quantisation=False)


@pytest.fixture(scope="module")
def bare() -> SimulatedFlight:
    return simulate(seed=1, **BARE)


# what is sensed ------------------------------------------------------------------------------------------------------


def test_the_motion_is_the_papers(paper: SimulatedFlight) -> None:
    """Nine doublets of 2.2–3.0 s and 0.7–1.1 rad on one axis each, 12 % on the others, tremor of 0.01 rad."""
    motion = motion_of(paper)
    assert motion.amplitudes.shape == (9, 3)
    peaks = np.abs(motion.amplitudes)
    np.testing.assert_array_equal(peaks.argmax(axis=1), [0, 1, 2] * 3)
    assert ((peaks.max(axis=1) >= 0.7) & (peaks.max(axis=1) <= 1.1)).all()
    np.testing.assert_allclose(np.sort(peaks, axis=1)[:, :2], 0.12 * peaks.max(axis=1)[:, None] * np.ones(2))
    assert ((motion.lengths >= 2.2) & (motion.lengths <= 3.0)).all()
    assert (motion.starts[1:] > motion.starts[:-1] + motion.lengths[:-1]).all()
    assert motion.starts[0] > 0
    assert motion.starts[-1] + motion.lengths[-1] < 40.0
    tremor = motion.euler(np.arange(0.0, motion.starts[0], 0.01))[0]
    assert rms(np.linalg.norm(tremor, axis=1)) == pytest.approx(0.01, rel=0.5)
    quiet = Motion(replace(paper.experiment, tremor_rad=0.0), np.random.default_rng(0))
    assert np.abs(quiet.euler(np.arange(0.0, 40.0, 0.001))[0]).max() == pytest.approx(
        np.abs(quiet.amplitudes).max(), rel=1e-3
    )


def test_rates_are_the_derivative_of_the_attitude(bare: SimulatedFlight) -> None:
    motion, t, h = motion_of(bare), np.arange(3.0, 37.0, 0.05), 1e-5
    turned = to_rotation_vector(multiply(conjugate(motion.attitude(t - h)), motion.attitude(t + h))) / (2 * h)
    np.testing.assert_allclose(motion.rate(t), turned, atol=1e-6)
    wider = (motion.rate(t + 1e-4) - motion.rate(t - 1e-4)) / 2e-4
    np.testing.assert_allclose(motion.rate_dot(t), wider, atol=2e-3)  # jerk jumps where a doublet begins


def test_a_long_motion_is_the_same_by_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    motion, t = Motion(Experiment(duration_s=90.0, sets=6), np.random.default_rng(4)), np.linspace(0.0, 90.0, 4001)
    whole = motion.euler(t)
    monkeypatch.setattr("fieldcal.simulation.experiment.BLOCK", 500)
    for part, own in zip(motion.euler(t), whole, strict=True):
        np.testing.assert_allclose(part, own, rtol=0.0, atol=1e-14)


def test_position_is_the_acceleration_integrated_twice() -> None:
    motion, h = Motion(Experiment(translation_rms_mps2=0.5), np.random.default_rng(2)), 1e-3
    t = np.arange(0.0, 20.0, 0.1)
    second = (motion.position(t + h) - 2 * motion.position(t) + motion.position(t - h)) / h**2
    np.testing.assert_allclose(second, motion.acceleration(t), atol=1e-4)


def test_bare_readings_are_exact(bare: SimulatedFlight) -> None:
    """No noise, no converter, no filter: field, gravity and rate in the body at the stamps."""
    body = Rotation.from_quat(bare.q).inv()
    np.testing.assert_allclose(sensed(bare, "magnetometer"), body.apply([1.0, 0.0, 0.0]), atol=ROUNDING)
    np.testing.assert_allclose(sensed(bare, "accelerometer"), body.apply([0.0, 0.0, 9.81]), atol=ROUNDING)
    np.testing.assert_allclose(sensed(bare, "gyroscope"), bare.rate, atol=ROUNDING)
    assert bare.delay_s == 0.0
    assert bare.lag_s == pytest.approx(-bare.experiment.vps_offset_s)


def test_dip_turns_the_field_down() -> None:
    r = simulate(seed=1, dip_rad=1.1, vps=False, duration_s=5.0, **BARE)
    field = Rotation.from_quat(r.q).apply(sensed(r, "magnetometer"))
    np.testing.assert_allclose(field, np.tile([np.cos(1.1), 0.0, np.sin(1.1)], (len(r.t), 1)), atol=ROUNDING)


def test_truth_is_delayed_by_the_sensors_filter(filtered: SimulatedFlight) -> None:
    """A two-pole 50 Hz filter of damping √½ delays slow motion by 2ζ/ω = 4.5 ms."""
    assert filtered.delay_s == pytest.approx(FILTER_DELAY_S)
    assert pytest.approx(4.5e-3, abs=5e-5) == FILTER_DELAY_S
    size = rms(filtered.rate)
    assert rms(sensed(filtered, "gyroscope") - filtered.rate) < GROUP_DELAY_RIPPLE * size
    undelayed = motion_of(filtered).rate(filtered.t)
    assert rms(sensed(filtered, "gyroscope") - undelayed) > 1e3 * GROUP_DELAY_RIPPLE * size
    field = Rotation.from_quat(filtered.q).inv().apply([1.0, 0.0, 0.0])
    assert rms(sensed(filtered, "magnetometer") - field) < GROUP_DELAY_RIPPLE


@pytest.mark.parametrize("sensor", SENSORS)
def test_noise_has_table_1s_variance_after_the_filter(
    paper: SimulatedFlight, filtered: SimulatedFlight, sensor: str
) -> None:
    noise = (paper.counts[sensor] - filtered.counts[sensor]) * np.array(SCALE[sensor])
    assert noise.var() == pytest.approx(NOISE_VARIANCE[sensor], rel=0.05)
    assert np.abs(noise.mean(axis=0)).max() < 0.05 * np.sqrt(NOISE_VARIANCE[sensor])
    lagged = np.mean(noise[1:] * noise[:-1]) / noise.var()
    assert lagged == pytest.approx(0.39, abs=0.04)  # e^{-x}(cos x + sin x), x = √½ ω Δt: Butterworth noise of 50 Hz


def test_words_are_16_bit(paper: SimulatedFlight) -> None:
    for sensor in SENSORS:
        counts = paper.counts[sensor]
        np.testing.assert_array_equal(counts, np.rint(counts))
        assert counts.min() >= 0
        assert counts.max() <= 65535
    wild = simulate(seed=1, vps=False, duration_s=10.0, doublet_s=(0.05, 0.1))
    assert wild.counts["gyroscope"].min() == 0
    assert wild.counts["gyroscope"].max() == 65535


def test_stamps_are_ticks_of_the_oscillator(paper: SimulatedFlight, bare: SimulatedFlight) -> None:
    np.testing.assert_allclose(paper.t / TICK_S, np.rint(paper.t / TICK_S), atol=1e-6)
    assert len(paper.t) == 7400
    assert np.abs(np.diff(bare.t) - 1 / 185).max() < 1e-12


# options -------------------------------------------------------------------------------------------------------------


def test_translation_has_the_rms_asked_for_below_2_hz() -> None:
    lengths = []
    for seed in range(6):
        r = simulate(seed=seed, translation_rms_mps2=0.3, vps=False, **BARE)
        other = sensed(r, "accelerometer") - Rotation.from_quat(r.q).inv().apply([0.0, 0.0, 9.81])
        lengths.append(rms(np.linalg.norm(other, axis=1)))
        spectrum = (
            np.abs(np.fft.rfft(Rotation.from_quat(r.q).apply(other) * np.hanning(len(r.t))[:, None], axis=0)) ** 2
        )
        frequency = np.fft.rfftfreq(len(r.t), 1 / 185)
        inside = (frequency > 0.2) & (frequency < 2.2)
        assert spectrum[inside].sum() > 0.99 * spectrum.sum()
    assert np.mean(lengths) == pytest.approx(0.3, rel=0.05)
    assert np.ptp(lengths) < 0.06


def test_a_lever_arm_adds_what_rotation_makes_of_it(bare: SimulatedFlight) -> None:
    arm = np.array([0.05, 0.02, -0.03])
    r = simulate(seed=1, lever_arm_m=tuple(arm), **BARE)
    motion, h = motion_of(bare), 1e-4

    def place(t: np.ndarray) -> np.ndarray:
        return Rotation.from_quat(motion.attitude(t)).apply(arm)

    moved = (place(r.t + h) - 2 * place(r.t) + place(r.t - h)) / h**2
    expected = -Rotation.from_quat(r.q).inv().apply(moved)  # a gravity-signed sensor reads minus the acceleration
    np.testing.assert_allclose(sensed(r, "accelerometer") - sensed(bare, "accelerometer"), expected, atol=1e-3)


def test_temperature_moves_scale_and_mid_scale_bias() -> None:
    e = Experiment(
        temperature_degc=(25.0, 45.0),
        scale_per_degc={"gyroscope": (1e-3, 0.0, 0.0)},
        bias_per_degc={"gyroscope": (0.0, 0.01, 0.0)},
    )
    scale, bias = constants_at(e, "gyroscope", np.array([25.0, 45.0]))
    np.testing.assert_allclose(scale[1] / scale[0], [1.02, 1.0, 1.0])
    middle = scale * 32768.0 + bias
    np.testing.assert_allclose(middle[1] - middle[0], [0.0, 0.2, 0.0], atol=1e-12)
    r = simulate(e, vps=False, duration_s=10.0, **BARE)
    assert (r.temperature[0], r.temperature[-1]) == pytest.approx((25.0, 45.0), abs=0.02)
    own_scale, own_bias = constants_at(e, "gyroscope", r.temperature)
    np.testing.assert_allclose(r.counts["gyroscope"] * own_scale + own_bias, r.rate, atol=ROUNDING)


def test_gyroscope_random_walk() -> None:
    """0.01 rad/s/√s: the bias moves by 0.01 rad/s in a second, independently in every second."""
    steps = []
    for seed in range(4):
        r = simulate(seed=seed, gyro_random_walk=0.01, vps=False, **BARE)
        walk = sensed(r, "gyroscope") - r.rate
        assert np.abs(walk[0]).max() < 0.005
        steps.append(np.diff(walk[::185], axis=0))
    assert rms(np.concatenate(steps)) == pytest.approx(0.01, rel=0.15)


def test_losses_and_jitter(paper: SimulatedFlight) -> None:
    lost = simulate(seed=1, lost_share=0.05, vps=False)
    assert 1 - len(lost.t) / len(paper.t) == pytest.approx(0.05, abs=0.01)
    kept = np.isin(np.rint(paper.t / TICK_S), np.rint(lost.t / TICK_S))
    for sensor in SENSORS:
        np.testing.assert_array_equal(lost.counts[sensor], paper.counts[sensor][kept])
    late = simulate(seed=1, jitter_s=5e-4, vps=False)
    assert np.std(np.diff(late.t)) == pytest.approx(np.sqrt(2) * 5e-4, rel=0.03)
    assert np.diff(late.t).min() > 0


def test_magnetic_bursts_reach_their_size_and_pass() -> None:
    plain, burst = (simulate(seed=1, magnetic_bursts=n, vps=False, **BARE) for n in (0, 2))
    size = np.linalg.norm(sensed(burst, "magnetometer") - sensed(plain, "magnetometer"), axis=1)
    assert 0.3 < size.max() < 0.81
    assert 0.5 < np.mean(size < 0.004) < 1.0
    np.testing.assert_array_equal(burst.counts["gyroscope"], plain.counts["gyroscope"])


# VPS -----------------------------------------------------------------------------------------------------------------


def vps_error(r: SimulatedFlight) -> np.ndarray:
    """Rotation vectors (m, 3), rad, from the true attitude in the VPS's frames to what it says."""
    e = r.experiment
    true = motion_of(r).attitude((r.vps_t - e.vps_offset_s) / (1 + 1e-6 * e.vps_skew_ppm))
    shown = multiply(multiply(r.vps_world_rotation, true), r.vps_body_rotation)
    return to_rotation_vector(multiply(conjugate(shown), r.vps_q))


def test_vps_noise_rate_and_clock(paper: SimulatedFlight) -> None:
    assert len(paper.vps_t) == 40 * 350
    assert vps_error(paper).var() == pytest.approx(VPS_VARIANCE, rel=0.03)
    assert np.diff(paper.vps_t).mean() == pytest.approx((1 + 20e-6) / 350.0, rel=1e-9)
    assert paper.vps_t[0] == pytest.approx(0.37)


@pytest.mark.parametrize("skew_ppm", [20.0, -300.0])
def test_lag_contains_the_sensors_delay(skew_ppm: float) -> None:
    """What a perfect synchroniser finds, which the tests of `sync` establish, is the lag that the truth states."""
    r = simulate(seed=4, noise=False, quantisation=False, vps_skew_ppm=skew_ppm, vps_offset_s=-1.234)
    found = by_rates.synchronise(r.t, sensed(r, "gyroscope"), r.vps_t, r.vps_q)
    assert r.lag_s == pytest.approx(1.234 + FILTER_DELAY_S, abs=2e-6)
    assert found.lag_s == pytest.approx(r.lag_s, abs=5e-5)
    assert found.skew_ppm == pytest.approx(skew_ppm, abs=3.0)


def test_misalignment_is_two_rotations_of_the_size_asked_for() -> None:
    r = simulate(seed=1, vps_misalignment_rad=0.2, duration_s=5.0)
    sizes = [np.linalg.norm(Rotation.from_quat(q).as_rotvec()) for q in (r.vps_world_rotation, r.vps_body_rotation)]
    np.testing.assert_allclose(sizes, 0.2)
    assert rms(vps_error(r)) < 1.1 * np.sqrt(VPS_VARIANCE)


def test_dropouts_and_outliers(paper: SimulatedFlight) -> None:
    gappy = simulate(seed=1, vps_dropout_share=0.1)
    assert 1 - len(gappy.vps_t) / len(paper.vps_t) == pytest.approx(0.1, abs=0.02)
    gaps = np.diff(gappy.vps_t)
    assert 0.05 < gaps.max() < 1.0
    kept = np.isin(paper.vps_t, gappy.vps_t)
    np.testing.assert_array_equal(gappy.vps_q, paper.vps_q[kept])
    wild = simulate(seed=1, vps_outlier_share=0.02)
    assert np.mean(np.linalg.norm(vps_error(wild), axis=1) > 0.01) == pytest.approx(0.02, abs=0.005)
    np.testing.assert_allclose(np.linalg.norm(wild.vps_q, axis=1), 1.0)


# seeds ---------------------------------------------------------------------------------------------------------------


def test_a_seed_is_a_flight(paper: SimulatedFlight) -> None:
    again, other = simulate(seed=1), simulate(seed=2)
    for name in ("t", "q", "rate", "vps_t", "vps_q", "vps_position"):
        np.testing.assert_array_equal(getattr(again, name), getattr(paper, name))
    for sensor in SENSORS:
        np.testing.assert_array_equal(again.counts[sensor], paper.counts[sensor])
        assert not np.array_equal(other.counts[sensor], paper.counts[sensor])


@pytest.mark.parametrize(
    ("change", "touches"),
    [
        ({"vps": False}, ()),
        ({"vps_dropout_share": 0.1}, ()),
        ({"vps_outlier_share": 0.02}, ()),
        ({"vps_misalignment_rad": 0.1}, ()),
        ({"vps_offset_s": 3.0}, ()),
        ({"gyro_random_walk": 0.01}, ("gyroscope",)),
        ({"magnetic_bursts": 2}, ("magnetometer",)),
        ({"translation_rms_mps2": 0.3}, ("accelerometer",)),
        ({"lever_arm_m": (0.05, 0.02, -0.03)}, ("accelerometer",)),
        ({"dip_rad": 1.0}, ("magnetometer",)),
        ({"temperature_degc": (10.0, 40.0), "bias_per_degc": {"gyroscope": (0.1, 0, 0)}}, ("gyroscope",)),
    ],
    ids=lambda value: "-".join(value) if isinstance(value, dict) else "",
)
def test_switching_one_effect_leaves_the_others_draws(
    paper: SimulatedFlight, change: dict[str, Any], touches: tuple[str, ...]
) -> None:
    """10 s of it: the readings that the effect does not touch are the same, bit by bit."""
    short = {"seed": 1, "duration_s": 10.0}
    plain, changed = simulate(**short), simulate(**short, **change)
    np.testing.assert_array_equal(changed.q, plain.q)
    for sensor in SENSORS:
        assert np.array_equal(changed.counts[sensor], plain.counts[sensor]) == (sensor not in touches), sensor
    if not any(name.startswith("vps") for name in change):
        np.testing.assert_array_equal(changed.vps_q, plain.vps_q)


# files ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("log_format", ["mcap", "csv"])
@pytest.mark.parametrize("quantisation", [True, False])
def test_files_hold_what_was_simulated(tmp_path: Path, log_format: str, quantisation: bool) -> None:
    e = Experiment(seed=3, duration_s=6.0, quantisation=quantisation)
    write_flights(tmp_path, e, log_format=log_format)
    (log,) = find_logs(tmp_path)
    vehicle = load(tmp_path / "fieldcal.toml").vehicle(log.vehicle_id)
    read, summary = read_log(log.path, vehicle)
    recording = simulate(e)
    expected = signals(recording)
    origin = int(read["imu"]["t_ns"][0])
    for name in ("imu", "magnetometer", "vps"):
        assert read[name].columns == expected[name].columns
        np.testing.assert_array_equal(read[name]["t_ns"] - origin, expected[name]["t_ns"])
        np.testing.assert_array_equal(read[name].drop("t_ns"), expected[name].drop("t_ns"))
    assert summary.units == dict.fromkeys(("gyroscope", "accelerometer", "magnetometer"), "counts")
    beside = json.loads((log.path.parent / "flight-01.truth.json").read_text())
    assert beside == json.loads(json.dumps(truth(recording)))
    table = pl.read_parquet(log.path.parent / "flight-01.truth.parquet")
    np.testing.assert_array_equal(table["t_ns"], read["imu"]["t_ns"])
    assert angle(table.select("qx", "qy", "qz", "qw").to_numpy(), recording.q).max() == 0.0


def test_the_archives_configuration_is_that_of_the_simulated_vehicle(tmp_path: Path) -> None:
    e = Experiment(seed=3, duration_s=2.0, dip_rad=0.4, lever_arm_m=(0.1, 0.0, -0.2), gravity_mps2=9.79)
    write_flights(tmp_path, e, vehicles=2, sessions=2, flights=2)
    logs = find_logs(tmp_path)
    assert len(logs) == 8
    assert {log.vehicle_id for log in logs} == {"sim-1", "sim-2"}
    assert len({log.session_id for log in logs}) == 2
    first = load(tmp_path / "fieldcal.toml").vehicle("sim-1")
    assert first.gravity_mps2 == 9.79
    assert first.lever_arm_m == (0.1, 0.0, -0.2)
    assert first.polarity["gyroscope"] == (-1, 1, 1)
    np.testing.assert_allclose(settings(e).field_ned, [np.cos(0.4), 0.0, np.sin(0.4)])
    truths = [json.loads(p.read_text()) for p in sorted(tmp_path.rglob("*.truth.json"))]
    assert len({t["seed"] for t in truths}) == 8
    scales = np.array([t["constants"]["gyroscope"]["scale"] for t in truths])
    assert len(np.unique(scales, axis=0)) == 2
    assert np.abs(scales / np.array(SCALE["gyroscope"]) - 1).max() <= 0.03
    assert (np.sign(scales) == np.sign(SCALE["gyroscope"])).all()


def test_unknown_format_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="mcap"):
        write_flights(tmp_path, log_format="bag")


def test_logs_do_not_depend_on_how_many_processes_fly(tmp_path: Path) -> None:
    logs = []
    for workers in (1, 2):
        folder = tmp_path / str(workers)
        found = write_flights(folder, Experiment(seed=4, duration_s=6.0), vehicles=2, flights=2, workers=workers)
        logs.append({path.relative_to(folder): path.read_bytes() for path in found})
    assert len(logs[0]) == 4
    assert logs[0] == logs[1]
