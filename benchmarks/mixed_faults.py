"""Flights with faults that no estimator was told of: what is published, and how often it is wrong.

    python benchmarks/mixed_faults.py --flights 200          # about 20 minutes
    python benchmarks/mixed_faults.py --kind g_sensitivity --flights 10 --rows

Each flight has one of the kinds below, at random a fault large enough to matter, with a VPS or without. Of every row
published as ok (scale, bias, zero; the diagonal of a full matrix) the error over its sd is taken against the truth of
the faulty sensor. Printed: share published, share of published rows beyond 4 sd, and by kind.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace

import numpy as np
import polars as pl
from numpy.random import Generator

from fieldcal.flight.threads import one_thread
from fieldcal.geometry.rotation import Array, body_from_inertial, from_rotation_vector
from fieldcal.names import SENSORS, Rotation, Sensor, Status, Triple
from fieldcal.simulation.archive import settings, signals
from fieldcal.simulation.experiment import SimulatedFlight, simulate
from fieldcal.simulation.faults import Faults, with_faults
from fieldcal.stages.pipeline import run_flight

A, M, G = Sensor.ACCELEROMETER, Sensor.MAGNETOMETER, Sensor.GYROSCOPE


def _square(rng: Generator, degrees: float) -> Rotation:
    """Axes y and z out of square with x by about so much: lower triangular, so that body axes stay the true ones."""
    a, b, c = np.radians(degrees) * rng.choice([-1.0, 1.0], 3)
    return ((1.0, 0.0, 0.0), (a, 1.0, 0.0), (b, c, 1.0))


def _symmetric(rng: Generator, share: float) -> Rotation:
    a, b, c = share * rng.uniform(-1.0, 1.0, 3)
    return ((1.0, a, b), (a, 1.0, c), (b, c, 1.0))


def _turned(rng: Generator, degrees: float) -> Rotation:
    axis = rng.normal(size=3)
    return _rows(body_from_inertial(from_rotation_vector(np.radians(degrees) * axis / np.linalg.norm(axis))))


def _vector(rng: Generator, length: float) -> Triple:
    v = rng.normal(size=3)
    return _triple(length * v / np.linalg.norm(v))


def _triple(v: Array) -> Triple:
    x, y, z = v.tolist()
    return x, y, z


def _rows(m: Array) -> Rotation:
    x, y, z = (_triple(row) for row in m)
    return x, y, z


def _any(rng: Generator) -> Sensor:
    return (A, M, G)[rng.integers(3)]


def _sensitivity(rng: Generator) -> Rotation:
    return _rows(rng.normal(scale=1e-3, size=(3, 3)))


KINDS: dict[str, Callable[[Generator], Faults]] = {
    "accelerometer_out_of_square": lambda rng: Faults(matrix={A: _square(rng, rng.uniform(1.0, 5.0))}),
    "soft_iron": lambda rng: Faults(matrix={M: _symmetric(rng, rng.uniform(0.03, 0.15))}),
    "magnetometer_turned": lambda rng: Faults(matrix={M: _turned(rng, rng.uniform(1.0, 5.0))}),
    "coarse": lambda rng: Faults(step={_any(rng): float(2.0 ** rng.integers(4, 13))}),
    "held": lambda rng: Faults(held_hz={(A, M)[rng.integers(2)]: float(rng.choice([10.0, 20.0, 50.0]))}),
    "late": lambda rng: Faults(delay_s={(A, M)[rng.integers(2)]: rng.uniform(0.01, 0.1)}),
    "g_sensitivity": lambda rng: Faults(g_sensitivity=_sensitivity(rng)),
    "not_linear": lambda rng: Faults(nonlinearity=rng.uniform(0.005, 0.02)),
    "rate_error": lambda rng: Faults(rate_error=rng.uniform(0.005, 0.02)),
    "motors": lambda rng: Faults(field_per_ampere=_vector(rng, rng.uniform(0.02, 0.1) / 20.0)),
    "hard_iron_step": lambda rng: Faults(hard_iron_step=_vector(rng, rng.uniform(0.02, 0.3))),
    "repeated": lambda rng: Faults(repeated_s=rng.uniform(0.5, 3.0)),
}
MODERN = {"duration_s": 60.0, "sets": 5, "dip_rad": np.pi / 3, "translation_rms_mps2": 0.1}


def one(number: int, kind: str, method: str) -> tuple[str, bool, int, pl.DataFrame]:
    """Kind, whether there was a VPS, rows that could be published, and the published ones with `off`, in sd."""
    rng = np.random.default_rng(number)
    changes = MODERN if rng.integers(2) else {}
    by_vps = bool(rng.integers(2)) or kind == "rate_error"  # which nothing else can show
    flight = simulate(seed=number, vps=by_vps, temperature_degc=(25.0, 25.0), **changes)
    faults = KINDS[kind](rng)
    logged = with_faults(flight, faults, rng)
    current = None if rng.integers(2) else logged.current_a  # known or not
    with one_thread():
        results = run_flight(signals(replace(logged, current_a=current)), settings(flight.experiment, method=method))
    rows = results["choice"].tables["calibration"]
    crossed = set(rows.filter(pl.col("axis").str.len_chars() == 2, status=str(Status.OK))["sensor"])
    rows = rows.filter(pl.col("axis").str.len_chars() == 1)
    rows = rows.filter(pl.col("parameter").is_in(["scale", "bias", "zero"]))
    truth = {
        key: value for sensor in SENSORS for key, value in _truth(flight, logged, faults, sensor, sensor in crossed)
    }
    keys = zip(rows["sensor"], rows["parameter"], rows["axis"], strict=True)
    rows = rows.with_columns(true=pl.Series([truth[key] for key in keys], dtype=pl.Float64)).with_columns(
        off=(pl.col("value") - pl.col("true")) / pl.col("sd"), flight=pl.lit(number), kind=pl.lit(kind)
    )
    return kind, by_vps, 27, rows.filter(status=str(Status.OK))


def _truth(
    flight: SimulatedFlight, logged: SimulatedFlight, faults: Faults, sensor: Sensor, crossed: bool
) -> Iterator[tuple[tuple[str, str, str], float]]:
    """(sensor, parameter, axis) and the constant that makes true values of logged ones: with motors at their mean
    current, with a sensitivity to force at its mean, and of a sensor that is no line those of the nearest line. The
    bias is that of the published form: of the whole matrix (`crossed`), else zero = -bias/scale axis by axis."""
    scale = faults.true_scale(flight, sensor)
    own = np.array(flight.experiment.scale[sensor])
    zero = -np.array(flight.experiment.bias[sensor]) / own
    if sensor == G and faults.g_sensitivity is not None:  # a gyroscope's zero is that at the flight's mean force
        force = np.array(flight.experiment.scale[A]) * flight.counts[A] + np.array(flight.experiment.bias[A])
        zero = zero + np.array(faults.g_sensitivity) @ force.mean(axis=0) / own
    if sensor == M and faults.field_per_ampere is not None and logged.current_a is not None:
        zero = zero + np.array(faults.field_per_ampere) * logged.current_a.mean() / own
    if sensor == G and faults.nonlinearity:
        true = own * flight.counts[G] + np.array(flight.experiment.bias[G])
        lines = [np.polyfit(x, y, 1) for x, y in zip(logged.counts[G].T, true.T, strict=True)]
        scale, zero = np.diag([slope for slope, _ in lines]), np.array([-offset / slope for slope, offset in lines])
    for i, axis in enumerate("xyz"):
        yield (sensor, "scale", axis), float(scale[i, i])
        yield (sensor, "bias", axis), float(-scale[i] @ zero if crossed else -scale[i, i] * zero[i])
        yield (sensor, "zero", axis), float(zero[i])


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("--flights", type=int, default=200)
    arguments.add_argument("--kind", choices=sorted(KINDS), help="all in turn without it")
    arguments.add_argument("--method", default="auto")
    arguments.add_argument("--first", type=int, default=0, help="number of the first flight")
    arguments.add_argument("--workers", type=int, default=2)
    arguments.add_argument("--rows", action="store_true", help="print the rows beyond 4 sd")
    given = arguments.parse_args()
    kinds = [given.kind] if given.kind else list(KINDS)
    numbers = range(given.first, given.first + given.flights)
    with ProcessPoolExecutor(given.workers) as pool:
        done = list(pool.map(one, numbers, [kinds[k % len(kinds)] for k in numbers], [given.method] * len(numbers)))
    print(f"{'kind':30s} {'flights':>8s} {'published':>10s} {'beyond 4 sd':>12s} {'largest':>8s} {'rms':>6s}")
    for kind in [*kinds, "all"]:
        here = [d for d in done if kind in ("all", d[0])]
        if not here:
            continue
        off = pl.concat([d[3] for d in here])["off"].to_numpy()
        of = sum(d[2] for d in here)
        beyond = int(np.count_nonzero(np.abs(off) > 4.0))
        largest, rms = (np.max(np.abs(off), initial=0.0), np.sqrt(np.mean(off**2))) if len(off) else (0.0, 0.0)
        share = f"{beyond} / {len(off)}"
        print(f"{kind:30s} {len(here):8d} {len(off) / of:10.0%} {share:>12s} {largest:8.1f} {rms:6.2f}")
    if given.rows:
        wrong = pl.concat([d[3] for d in done]).filter(pl.col("off").abs() > 4.0)
        with pl.Config(tbl_rows=-1, tbl_cols=-1, tbl_width_chars=180):
            print(wrong.select("flight", "kind", "sensor", "method", "parameter", "axis", "value", "true", "sd", "off"))


if __name__ == "__main__":
    main()
