"""The C against the Python: the same numbers to a float's rounding, on this machine and on a Cortex-M4F."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from numerics_support import angle, random_attitudes
from onboard_support import MACHINES, SAMPLE, Machine, fly, needs, run

import fieldcal
from fieldcal.estimation import wahba
from fieldcal.geometry.rotation import body_from_inertial
from fieldcal.names import Triple
from fieldcal.onboard import Board, BoardResult, BoardSettings, Moments, MomentsFit, read_dumps, write_sources
from fieldcal.reason_codes import ReasonCode

RATE_HZ = 400.0
SIGNS: dict[str, Triple] = {"vectors": (1.0, 1.0, -1.0), "gyroscope": (-1.0, 1.0, 1.0)}
SETTINGS = BoardSettings(
    gravity_mps2=9.81,
    magnetometer_polarity=SIGNS["vectors"],
    accelerometer_polarity=SIGNS["vectors"],
    gyroscope_polarity=SIGNS["gyroscope"],
    imu_rate_hz=RATE_HZ,
    magnetometer_rate_hz=RATE_HZ,
)
OF_SD = 1e-4
"""Share of the claimed sd by which C and Python may differ: floats carry seven digits."""
OF_VALUE = 1e-4
"""Of standard deviations and of the numbers that decide."""
CODES = (
    None,
    None,
    ReasonCode.TOO_FEW_SAMPLES,
    ReasonCode.ELLIPSOID_DEGENERATE,
    ReasonCode.TOO_LITTLE_MOTION,
    ReasonCode.SCALE_UNCERTAIN,
    ReasonCode.NOT_A_SPHERE,
    ReasonCode.GYRO_NOT_EXCITED,
    ReasonCode.POLARITY_CONTRADICTION,
    *[None] * 3,
    ReasonCode.GYRO_CONTRADICTS_ATTITUDE,
)


@pytest.fixture(scope="module", params=MACHINES, ids=lambda machine: machine.name)
def machine(request: pytest.FixtureRequest) -> Machine:
    """Each machine in turn."""
    return request.param


@pytest.fixture(scope="module")
def folder(machine: Machine, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where it runs what is compiled for SETTINGS."""
    return tmp_path_factory.mktemp(machine.name)


def flight(seed: int = 1, **changes: object) -> np.ndarray:
    """A whole simulated flight at 400 Hz."""
    return simulated(seed, **changes).copy()


@cache
def simulated(seed: int, **changes: object) -> np.ndarray:
    flown = fieldcal.simulate(seed=seed, rate_hz=RATE_HZ, **changes)
    out = np.zeros(len(flown.t), dtype=SAMPLE)
    out["t_us"], out["has_field"] = np.rint(flown.t * 1e6), 1
    out["gyroscope"], out["accelerometer"] = flown.counts["gyroscope"], flown.counts["accelerometer"]
    out["field"] = flown.counts["magnetometer"]
    return out


def in_python(settings: BoardSettings, samples: np.ndarray, *, single: bool) -> tuple[Board, BoardResult]:
    board = Board(settings, single=single)
    field = np.where(samples["has_field"][:, None] > 0, samples["field"].astype(float), np.nan)
    for _ in range(2):
        board.feed(samples["t_us"], samples["gyroscope"], samples["accelerometer"], field)
        result = board.solve()
    return board, result


def agree(told: dict[str, list[float]], result: BoardResult, of_sd: float = OF_SD) -> None:
    for name in ("magnetometer", "accelerometer"):
        fit: MomentsFit = getattr(result, name)
        assert CODES[int(told[f"{name}.code"][0])] == fit.reason_code
        scale = np.reshape(told[f"{name}.scale"], (3, 3))
        assert (np.abs(scale - fit.scale) <= of_sd * np.diagonal(fit.scale_sd).max()).all()
        assert (np.abs(np.array(told[f"{name}.bias"]) - fit.bias) <= of_sd * fit.bias_sd).all()
        np.testing.assert_allclose(told[f"{name}.scale_sd"], fit.scale_sd.ravel(), rtol=OF_VALUE)
        np.testing.assert_allclose(told[f"{name}.bias_sd"], fit.bias_sd, rtol=OF_VALUE)
        size = np.sqrt(np.outer(np.diagonal(fit.covariance), np.diagonal(fit.covariance)))
        np.testing.assert_allclose(
            np.reshape(told[f"{name}.covariance"], (6, 6)) / size, fit.covariance / size, atol=OF_VALUE
        )
        np.testing.assert_allclose(
            told[f"{name}.numbers"], [fit.condition, fit.residual_rms, fit.excess], rtol=OF_VALUE
        )
        np.testing.assert_allclose(told[f"{name}.noise_sd"], fit.noise_sd, rtol=OF_VALUE)
    rates = result.gyroscope
    assert tuple(CODES[int(code)] for code in told["gyroscope.code"]) == rates.reason_code
    for name in ("scale", "bias"):
        sd = getattr(rates, f"{name}_sd")
        difference = np.abs(np.array(told[f"gyroscope.{name}"]) - getattr(rates, name))
        assert (difference <= 10 * of_sd * sd).all()  # attitudes are floats too
        np.testing.assert_allclose(told[f"gyroscope.{name}_sd"], sd, rtol=10 * OF_VALUE)


def test_a_whole_flight_at_400_hz(machine: Machine, folder: Path) -> None:
    samples = flight()
    samples["gyroscope"][100] = np.nan
    samples["accelerometer"][5000, 1] = np.inf
    samples["t_us"][9000:] += 10_000_000
    samples["field"][12000:12040] += 800.0  # a magnet passes: no attitudes meanwhile
    told = fly(machine, folder, SETTINGS, samples)
    board, result = in_python(SETTINGS, samples, single=True)
    assert [result.magnetometer.reason_code, *result.gyroscope.reason_code] == [None] * 4
    agree(told, result)
    agree(told, in_python(SETTINGS, samples, single=False)[1], of_sd=1e-3)
    assert told["left_out"] == [3.0]  # the accelerometer's twice, the gyroscope's once: no equations at first
    assert told["dump"] == [0.0]
    assert board.gyroscope.n_samples < len(samples) - 30
    # Merged into another centre, and the dump as Python reads it: the same.
    np.testing.assert_allclose(np.abs(told["merged.scale"]), np.abs(told["magnetometer.scale"]), rtol=1e-6)
    dumped = dict(read_dumps(folder / "dump.bin"))
    for sensor, own in zip(dumped, (board.magnetometer, board.accelerometer, board.gyroscope), strict=True):
        assert dumped[sensor].n_samples == own.n_samples
        assert dumped[sensor].noise.n_differences == own.noise.n_differences
    magnetometer = dumped[next(iter(dumped))]
    assert isinstance(magnetometer, Moments)
    again = magnetometer.solve(SETTINGS.limits("magnetometer"))
    np.testing.assert_allclose(again.scale, result.magnetometer.scale, rtol=1e-6)
    assert board.dump()[:8] == (folder / "dump.bin").read_bytes()[:8]


def test_full_matrices_and_a_slower_magnetometer(machine: Machine, tmp_path: Path) -> None:
    settings = replace(SETTINGS, full=True, magnetometer_rate_hz=100.0, max_condition=1e3, max_scale_sd=0.2)
    settings = replace(settings, forgetting=0.99)
    samples = flight(2)
    samples["has_field"] = np.arange(len(samples)) % 4 == 0
    told = fly(machine, tmp_path, settings, samples)
    _, result = in_python(settings, samples, single=True)
    assert result.magnetometer.scale[0, 1] != 0.0
    assert np.isfinite(result.gyroscope.scale).all()
    agree(told, result)


def test_motion_that_does_not_tell_is_refused(machine: Machine, folder: Path) -> None:
    """Yaw alone, and a vehicle that stands."""
    yawing = fly(machine, folder, SETTINGS, flight(3, turned=(0.0, 0.0, 1.0), tremor_rad=0.005))
    assert {CODES[int(yawing[f"{name}.code"][0])] for name in ("magnetometer", "accelerometer")} <= {
        ReasonCode.TOO_LITTLE_MOTION,
        ReasonCode.SCALE_UNCERTAIN,
        ReasonCode.ELLIPSOID_DEGENERATE,
    }
    assert {CODES[int(code)] for code in yawing["gyroscope.code"]} == {ReasonCode.TOO_FEW_SAMPLES}
    resting = np.zeros(2000, dtype=SAMPLE)
    resting["t_us"], resting["has_field"], resting["accelerometer"] = np.arange(2000) * 2500, 1, 1.0
    told = fly(machine, folder, SETTINGS, resting)
    assert CODES[int(told["accelerometer.code"][0])] == ReasonCode.ELLIPSOID_DEGENERATE
    assert CODES[int(fly(machine, folder, SETTINGS, resting[:10])["accelerometer.code"][0])] == (
        ReasonCode.TOO_FEW_SAMPLES
    )


def test_attitudes(machine: Machine, folder: Path) -> None:
    """At any attitude, half turns and nearly parallel vectors too, those of the vectorised solvers."""
    rng = np.random.default_rng(4)
    half_turns = np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0.6, 0.8, 0, 0], [0, 0, 0, 1]])
    q = np.concatenate([random_attitudes(rng, 60), half_turns])
    reference = np.array([[0.4, 0.1, 0.9], [0.0, 0.0, 1.0]])
    seen = np.einsum("nij,kj->nki", body_from_inertial(q), reference) * [[2.0], [9.8]]
    seen += 0.01 * rng.normal(size=seen.shape)
    sigma = np.array([0.03, 0.01])
    vectors = np.zeros((len(q), 14), dtype=np.float32)
    vectors[:, :6], vectors[:, 6:12], vectors[:, 12:] = seen.reshape(-1, 6), reference.ravel(), sigma
    write_sources(folder, SETTINGS)
    vectors.tofile(folder / "vectors.bin")
    told = machine.run("attitudes.c", folder)
    expected = {
        "quest": wahba.attitudes(seen, reference, sigma).q,
        "triad": wahba.attitudes(seen, reference, sigma[::-1], method="triad").q,  # the first vector exact
        "euler": wahba.attitudes(seen, reference, sigma, method="euler", declination=0.25).q,
    }
    for method, attitudes in expected.items():
        found = np.array([told[f"{method}.{k}"] for k in range(len(q))])
        assert (found[:, 0] == 0).all()
        limit = 2e-2 if method == "euler" else 2e-5  # Eq. 4 takes gravity's length from the flight there, its own here
        assert angle(found[:, 1:], attitudes).max() < limit


def test_a_checker_of_c_finds_nothing(tmp_path: Path) -> None:
    needs("cppcheck")
    write_sources(tmp_path, replace(SETTINGS, full=True), told="a */ vehicle of Å")
    everything = ("--enable=warning,style,performance,portability", "--std=c99")
    run("cppcheck", *everything, "--error-exitcode=1", "-q", tmp_path, cwd=tmp_path)


def test_the_sources_allocate_nothing_and_ask_libm_for_little() -> None:
    source = (Path(str(fieldcal.__file__)).parent / "onboard" / "c" / "fieldcal_onboard.c").read_text()
    for forbidden in ("malloc", "free(", "while", "goto", "asinf", "sqrt(", "powf", "expf"):
        assert forbidden not in source, forbidden
