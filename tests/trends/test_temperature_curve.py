"""A known cubic over temperature comes back from warm-up flights and sessions, honestly; a line is not bent."""

from __future__ import annotations

import datetime as dt
import json
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
from history_rows import START, rows
from numerics_support import Array, rms

from fieldcal.config.configuration import load
from fieldcal.config.stage_settings import WarmUpSettings
from fieldcal.estimation.warm_up import fit_warm_up
from fieldcal.exports.calibration_at import constants_of
from fieldcal.names import Sensor
from fieldcal.stages.beside.warm_up import find_warm_up
from fieldcal.trends.drift_table import drift_table, update_drift
from fieldcal.trends.temperature_curve import Curve, about_reference, combined, of_sessions, together
from fieldcal.warehouse import Warehouse
from fieldcal.warehouse.publish import publish

CUBIC, LINE = np.array([4.0, 0.15, -0.004]), np.array([4.0, 0.0, 0.0])
"""counts per °C, °C², °C³ at 25 °C"""
ZERO, SCALE, REFERENCE_READING = 31000.0, 3e-4, 32768.0
RATE_HZ, SECONDS = 50.0, 120.0
SESSION_SD = 8.0
HONEST = (0.8, 1.25)


def over(degc: Any, c: Array) -> Array:
    d = np.asarray(degc) - 25.0
    return np.asarray(c[0] * d + c[1] * d**2 + c[2] * d**3)


def warming(seed: list[int], low: float, high: float, c: Array) -> tuple[Array, Array, Array]:
    rng = np.random.default_rng(seed)
    t = np.arange(round(SECONDS * RATE_HZ)) / RATE_HZ
    warm = low + (high - low) * (1.0 - np.exp(-3.0 * t / t[-1]))
    return t, ZERO + over(warm, c)[:, None] + 30.0 * rng.normal(size=(len(t), 3)), warm


def warmed_up(seed: int, c: Array, flights: int = 4) -> list[tuple[Array, Array, float, int]]:
    """What flights from some cold to some warm say together, an axis each."""
    rng = np.random.default_rng([seed, 1])
    sources = []
    for k in range(flights):
        low = rng.uniform(-10.0, 25.0)
        f = fit_warm_up(*warming([seed, 2, k], low, low + rng.uniform(10.0, 20.0), c))
        assert f.bend is not None
        assert f.bend_covariance is not None
        told = zip(f.bend, f.bend_covariance, strict=True)
        sources.append([about_reference(b, v, f.temperature_degc, f.width_degc) for b, v in told])
    return [together(np.stack([s[a][0] for s in sources]), np.stack([s[a][1] for s in sources])) for a in range(3)]


def sessions(seed: int, c: Array, n: int = 24) -> tuple[Array, Array] | None:
    rng = np.random.default_rng([seed, 3])
    warm, sd = rng.uniform(-10.0, 45.0, n), rng.uniform(3.0, 8.0, n)
    value = ZERO + over(warm, c) + np.hypot(SESSION_SD, sd) * rng.normal(size=n)
    return of_sessions(warm, 7.0 * np.arange(n), value, SESSION_SD**2 + sd**2)


def test_cubics_about_different_temperatures_are_one() -> None:
    b, covariance = np.array([3.0, -2.0, 0.5]), np.diag([1.0, 4.0, 9.0])
    c, information = about_reference(b, covariance, 10.0, 5.0)
    warm = np.linspace(-5.0, 40.0, 20)
    x = (warm - 10.0) / 5.0
    own = b[0] * x + b[1] * x**2 + b[2] * x**3
    np.testing.assert_allclose(own - own[0], over(warm, c) - over(warm, c)[0], atol=1e-9)
    # The sd of a difference of temperatures does not depend on where the cubic is written about.
    lever = x[-1] ** np.arange(1, 4) - x[0] ** np.arange(1, 4)
    d = warm - 25.0
    other = d[-1] ** np.arange(1, 4) - d[0] ** np.arange(1, 4)
    assert other @ np.linalg.inv(information) @ other == pytest.approx(lever @ covariance @ lever, rel=1e-9)


def test_each_source_is_honest_and_they_agree() -> None:
    ratios: dict[str, list[Array]] = {"warm": [], "sessions": []}
    agree, orders = [], []
    for seed in range(40):
        told = sessions(seed, CUBIC)
        assert told is not None
        ratios["sessions"].append((told[0] - CUBIC) / np.sqrt(np.diagonal(np.linalg.inv(told[1]))))
        for c, information, squares, freedom in warmed_up(seed, CUBIC):
            widened = information / max(1.0, squares / freedom)
            ratios["warm"].append((c - CUBIC) / np.sqrt(np.diagonal(np.linalg.inv(widened))))
            curve = combined((c, widened), told)
            assert curve is not None
            agree.append(curve.agrees)
            orders.append(curve.order)
    for name, ratio in ratios.items():
        assert HONEST[0] < rms(ratio) < HONEST[1], name
    assert np.mean(agree) > 0.97
    assert np.mean(np.array(orders) == 3) > 0.97


def test_a_line_is_not_bent_and_contradicting_sources_are_not_mixed() -> None:
    bent = 0
    for seed in range(40):
        told = sessions(seed, LINE)
        bent += sum(combined((c, n), told) is not None for c, n, _, _ in warmed_up(seed, LINE))
    assert bent <= 2
    c, information, _, _ = warmed_up(1, CUBIC + 2.5 * LINE)[0]
    told = sessions(1, CUBIC)
    apart = combined((c, information), told)
    alone = combined(None, told)
    assert isinstance(apart, Curve)
    assert alone is not None
    assert apart.agrees is False
    np.testing.assert_allclose(apart.coefficients, alone.coefficients)
    assert combined(None, None) is None
    assert of_sessions(np.arange(5.0), np.arange(5.0), np.zeros(5), np.ones(5)) is None


def published(root: Path) -> None:
    """24 sessions of one unit with the cubic in its zero; four flights also warm up at rest."""
    rng = np.random.default_rng(9)
    calibration, runs, flights, ids = [], [], [], []
    for k, warm in enumerate(rng.uniform(-10.0, 45.0, 24)):
        lead = {
            "flight_id": f"f{k:02d}",
            "vehicle_id": "v",
            "imu_id": "imu",
            "session_id": f"s{k}",
            "started_at": START + dt.timedelta(days=7 * k),
        }
        ids.append(lead["flight_id"])
        flights.append({**lead, "log_uri": f"v/{k}", "verdict": "ok", "temperature_mean_degc": warm})
        for axis in "xyz":
            zero = ZERO + over(warm, CUBIC) + 10.0 * rng.normal()
            for parameter, value, sd, unit in (
                ("zero", zero, 6.0, "counts"),
                ("scale", SCALE * (1.0 + 1e-3 * rng.normal()), 1e-3 * SCALE, "rad/s/counts"),
                ("zero_bias", SCALE * (REFERENCE_READING - zero), 6.0 * SCALE, "rad/s"),
            ):
                calibration.append(
                    {
                        **lead,
                        **{"sensor": "gyroscope", "method": "output_error", "parameter": parameter, "axis": axis},
                        **{"value": float(value), "sd": sd, "unit": unit, "temperature_degc": warm, "status": "ok"},
                    }
                )
        if k % 6 == 0:
            told = rested(k, float(warm))
            runs.append({**lead, "stage": "warm_up", "status": "ok", "measured": json.dumps(told.measured)})
            calibration += [{**lead, **row} for row in told.tables["calibration"].iter_rows(named=True)]
    tables = {"calibration": calibration, "run": runs, "flight": flights}
    publish(root, "v", {name: rows(name, *own) for name, own in tables.items()}, ids)


def rested(seed: int, low: float) -> Any:
    t, logged, warm = warming([seed, 4], low, low + 20.0, CUBIC)
    t_ns = np.rint(1e9 * t).astype(np.int64)
    imu = pl.DataFrame({"t_ns": t_ns, **{f"gyroscope_{a}": logged[:, i] for i, a in enumerate("xyz")}})
    temperature = pl.DataFrame({"t_ns": t_ns, "temperature_degc": warm})
    s = WarmUpSettings(units={Sensor.GYROSCOPE: "counts"}, manoeuvre_max_gap_s=0.1)
    assert load(None).vehicle("v").parameters.manoeuvre_max_gap_s == 0.1
    return find_warm_up({"imu": imu, "temperature": temperature}, s)


def test_the_history_holds_the_curve_and_the_vehicle_flies_with_it(tmp_path: Path) -> None:
    published(tmp_path)
    update_drift(tmp_path)
    table = Warehouse(tmp_path).scan("drift").collect()
    assert table.equals(drift_table(tmp_path).select(table.columns))
    for parameter, factor in (("zero", 1.0), ("zero_bias", -SCALE)):
        for row in table.filter(parameter=parameter).iter_rows(named=True):
            for power, column in enumerate(("slope_per_degc", "curve_per_degc2", "curve_per_degc3")):
                error = row[column] - factor * CUBIC[power]
                assert abs(error) < 4.0 * row[f"{column}_sd"], (parameter, row["axis"], column)
                assert abs(error) < 0.3 * abs(factor * CUBIC[power])
    straight = table.filter(~pl.col("parameter").is_in(["zero", "zero_bias"]))
    assert straight["curve_per_degc2"].is_null().all()
    truth = ZERO + over(np.array([-5.0, 12.0, 25.0, 40.0]), CUBIC)
    for degc, zero in zip((-5.0, 12.0, 25.0, 40.0), truth, strict=True):
        answer = Warehouse(tmp_path).sql("SELECT * FROM calibration_at(?) WHERE parameter = 'zero'", [degc])
        assert answer["value"].to_numpy() == pytest.approx(zero, abs=12.0)  # of 200 counts that the curve covers
        triad = constants_of_zero(tmp_path, degc)
        spread = triad["zero"] + triad["first"] * 8.0 + triad["second"] * 64.0 + triad["third"] * 512.0
        assert spread == pytest.approx(ZERO + over(degc + 8.0, CUBIC), abs=25.0)


def constants_of_zero(root: Path, degc: float) -> dict[str, Array]:
    t = constants_of(root, "v", degc).triads["gyroscope"]
    return {"zero": t.zero, "first": t.zero_per_degc, "second": t.zero_per_degc2, "third": t.zero_per_degc3}
