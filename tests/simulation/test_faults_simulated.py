"""Faults of real sensors, each against its definition, and what is published of flights that have them."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import polars as pl
import pytest

from fieldcal.names import Sensor
from fieldcal.simulation.archive import settings, signals
from fieldcal.simulation.experiment import SimulatedFlight, simulate
from fieldcal.simulation.faults import Faults, with_faults
from fieldcal.stages.pipeline import run_flight

A, M, G = Sensor.ACCELEROMETER, Sensor.MAGNETOMETER, Sensor.GYROSCOPE


@pytest.fixture(scope="module")
def flight() -> SimulatedFlight:
    return simulate(seed=3, duration_s=20.0, noise=False, quantisation=False, vps=False)


def sensed(flight: SimulatedFlight, counts: np.ndarray, sensor: Sensor) -> np.ndarray:
    return np.array(flight.experiment.scale[sensor]) * counts + np.array(flight.experiment.bias[sensor])


def faulty(flight: SimulatedFlight, faults: Faults) -> SimulatedFlight:
    return with_faults(flight, faults, np.random.default_rng(0))


def test_without_a_fault_it_is_the_flight(flight: SimulatedFlight) -> None:
    same = faulty(flight, Faults())
    for name in Sensor:
        np.testing.assert_allclose(same.counts[name], flight.counts[name], rtol=1e-12)
    assert same.t.tolist() == flight.t.tolist()
    assert same.current_a is None


def test_a_matrix_mixes_what_is_sensed_and_its_inverse_is_the_truth(flight: SimulatedFlight) -> None:
    m = ((1.0, 0.1, 0.0), (0.1, 1.0, 0.05), (0.0, 0.05, 1.0))
    faults = Faults(matrix={M: m})
    mixed = faulty(flight, faults)
    true = sensed(flight, flight.counts[M], M)
    np.testing.assert_allclose(sensed(flight, mixed.counts[M], M), true @ np.array(m).T, atol=1e-9)
    zero = -np.array(flight.experiment.bias[M]) / np.array(flight.experiment.scale[M])
    np.testing.assert_allclose((mixed.counts[M] - zero) @ faults.true_scale(flight, M).T, true, atol=1e-9)


def test_delay_step_hold_and_block(flight: SimulatedFlight) -> None:
    late = faulty(flight, Faults(delay_s={A: 0.05}))
    i = np.searchsorted(flight.t, 10.0)
    at = np.interp(flight.t[i] - 0.05, flight.t, flight.counts[A][:, 1])
    assert late.counts[A][i, 1] == pytest.approx(at, rel=1e-9)
    coarse = faulty(flight, Faults(step={G: 64.0}))
    assert np.abs(coarse.counts[G] / 64.0 - np.rint(coarse.counts[G] / 64.0)).max() < 1e-9
    held = faulty(flight, Faults(held_hz={M: 10.0}))
    fresh = np.any(np.diff(held.counts[M], axis=0) != 0.0, axis=1)
    assert fresh.sum() == pytest.approx(10.0 * flight.t[-1], abs=2)
    repeated = faulty(flight, Faults(repeated_s=1.0)).counts[G]
    assert any((repeated[k : k + 185] == repeated[k - 185 : k]).all() for k in range(185, len(repeated) - 185))


def test_force_rate_current_and_step(flight: SimulatedFlight) -> None:
    sensitivity = ((1e-3, 0.0, 0.0), (0.0, 0.0, 2e-3), (0.0, 0.0, 0.0))
    feels = faulty(flight, Faults(g_sensitivity=sensitivity))
    force = sensed(flight, flight.counts[A], A)
    added = sensed(flight, feels.counts[G], G) - sensed(flight, flight.counts[G], G)
    np.testing.assert_allclose(added, force @ np.array(sensitivity).T, atol=1e-9)
    bent = faulty(flight, Faults(nonlinearity=0.02))
    rate = sensed(flight, flight.counts[G], G)
    at_300 = rate * (1.0 + 0.02 * np.abs(rate) / np.radians(300.0))
    np.testing.assert_allclose(sensed(flight, bent.counts[G], G), at_300, atol=1e-9)
    assert faulty(flight, Faults(rate_error=0.02)).t[-1] == pytest.approx(1.02 * flight.t[-1])
    motors = faulty(flight, Faults(field_per_ampere=(0.001, 0.0, -0.002)))
    assert motors.current_a is not None
    field = sensed(flight, motors.counts[M], M) - sensed(flight, flight.counts[M], M)
    np.testing.assert_allclose(field, np.outer(motors.current_a, [0.001, 0.0, -0.002]), atol=1e-9)
    assert signals(motors)["power"]["current_a"].to_list() == motors.current_a.tolist()
    stepped = faulty(flight, Faults(hard_iron_step=(0.1, 0.0, 0.0)))
    step = sensed(flight, stepped.counts[M], M)[:, 0] - sensed(flight, flight.counts[M], M)[:, 0]
    assert set(step.round(9)) == {0.0, 0.1}


def mixed_faults() -> ModuleType:
    path = Path(__file__).parents[2] / "benchmarks" / "mixed_faults.py"
    spec = importlib.util.spec_from_file_location("mixed_faults", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["mixed_faults"] = module
    spec.loader.exec_module(module)
    return module


def test_of_a_flight_of_every_kind_nothing_wrong_is_published() -> None:
    """The long run is `benchmarks/mixed_faults.py`: 204 flights, 4,911 rows, none beyond 4 sd."""
    bench = mixed_faults()
    rows = pl.concat([bench.one(number, kind, "auto")[3] for number, kind in enumerate(bench.KINDS, start=300)])
    assert rows.height > 12 * 27 * 0.6
    assert rows["off"].abs().max() < 4.5  # type: ignore[operator]
    assert 0.6 < float(np.sqrt((rows["off"] ** 2).mean())) < 1.4  # type: ignore[arg-type]


@pytest.mark.parametrize("seed", [1, 8])
def test_a_sensitivity_to_force_is_found_with_a_vps_and_is_a_row(seed: int) -> None:
    flight = simulate(seed=seed, temperature_degc=(25.0, 25.0), dip_rad=1.0)
    rng = np.random.default_rng(seed)
    g = rng.normal(scale=1e-2, size=(3, 3))
    x, y, z = (tuple(map(float, row)) for row in g)
    logged = with_faults(flight, Faults(g_sensitivity=(x, y, z)), rng)  # type: ignore[arg-type]
    rows = run_flight(signals(logged), settings(flight.experiment, method="auto"))["choice"].tables["calibration"]
    found = rows.filter(parameter="g_sensitivity").sort("axis")
    assert found["axis"].to_list() == [a + b for a in "xyz" for b in "xyz"]
    assert set(found["unit"]) == {"counts per m/s^2"}
    true = (g / np.array(flight.experiment.scale["gyroscope"])[:, None]).ravel()
    off = (found["value"].to_numpy() - true) / found["sd"].to_numpy()
    assert np.abs(off).max() < 4.0
