"""Constants by flights together: what the moments of each add up to, and what is not one fit."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from history_rows import lead, rows
from numerics_support import Array, finely_integrated
from onboard_support import readings, tilting

import fieldcal
from fieldcal.cli.main import run
from fieldcal.exports.refit import _by_axis, _noise, _rates
from fieldcal.geometry.rotation import from_rotation_vector, multiply
from fieldcal.onboard import Limits, Moments, MomentsFit, RateEquations, RatesFit, dump
from fieldcal.onboard.rates import WEIGHT, fit_rates, noise_kept, recentred
from fieldcal.simulation.archive import settings, signals
from fieldcal.simulation.experiment import Experiment, simulate
from fieldcal.stages.pipeline import PIPELINE
from fieldcal.stages.stage import run_stage
from fieldcal.stages.tables import matrix, triad
from fieldcal.warehouse.publish import publish

SCALE, BIAS, NOISE = np.diag([1.05, 0.93, 1.02]), np.array([0.2, -0.1, 0.15]), 0.005
ROUNDING = 1e-6
"""Of the claimed sd: the order in which the same terms are added."""


def short_flight(seed: int, tilt_deg: float = 20.0, n: int = 400) -> Array:
    rng = np.random.default_rng(seed)
    return readings(tilting(rng, n, tilt_deg), SCALE, BIAS, NOISE, rng)


def row(vehicle: str, number: int, session: str, z: Array, **changes: Any) -> dict[str, Any]:
    """A flight's row of `moments` for a magnetometer that read z."""
    moments = Moments(centre=z[0])
    moments.feed(z)
    polarity = changes.pop("polarity", [1.0, 1.0, 1.0])
    collected = {"polarity": polarity, "centre": moments.centre, "noise": moments.noise.squares}
    sums = {
        **{name: np.asarray(value).tolist() for name, value in collected.items()},
        "sums": moments.values[1:].tolist(),
    }
    own = {
        **lead(vehicle, f"{number:016x}", number),
        "session_id": session,
        "sensor": "magnetometer",
        "magnitude": 1.0,
        "unit": "norm",
        "logged_unit": "norm",
        "temperature_degc": 20.0 + number,
        "reading_rate_hz": 100.0,
        "block_samples": 0,
        "n_samples": moments.n_samples,
        "n_differences": moments.noise.n_differences,
        "sums": json.dumps(sums),
        "run_key": "k" * 32,
    }
    return own | changes


Fleet = Callable[..., tuple[fieldcal.Warehouse, list[Array]]]


@pytest.fixture
def fleet(tmp_path: Path) -> Fleet:
    """Publish flights of one vehicle; the warehouse and what each flight's magnetometer read."""

    def fly(n_flights: int, tilt_deg: float = 20.0, **last: Any) -> tuple[fieldcal.Warehouse, list[Array]]:
        flown = [short_flight(seed, tilt_deg) for seed in range(n_flights)]
        made = [row("v", k, f"day-{k // 2}", z, **(last if k == n_flights - 1 else {})) for k, z in enumerate(flown)]
        flights = [lead("v", one["flight_id"], k) | {"session_id": one["session_id"]} for k, one in enumerate(made)]
        constant = {"method": "ellipsoid_robust", "parameter": "scale", "axis": "x", "value": 1.0, "status": "ok"}
        constants = [{**f, **constant, "sensor": s} for f in flights for s in ("magnetometer", "gyroscope")]
        frames = {
            "calibration": rows("calibration", *({**c, "unit": "1"} for c in constants)),
            "moments": rows("moments", *made),
            "flight": rows("flight", *({**f, "log_uri": f"v/{f['flight_id']}.mcap", "verdict": "ok"} for f in flights)),
        }
        publish(tmp_path / "w", "v", frames, [one["flight_id"] for one in made])
        return fieldcal.Warehouse(tmp_path / "w"), flown

    return fly


def only(found: list[Any]) -> tuple[Any, MomentsFit]:
    (one,) = found
    assert isinstance(one.fit, MomentsFit)
    return one, one.fit


def together(flown: list[Array]) -> MomentsFit:
    """The fit on board over all samples, one after the other."""
    moments = Moments(centre=(3.0, 2.0, -1.0))
    for z in flown:
        moments.feed(z)
        moments.gap()
    return moments.solve(Limits(magnitude=1.0))


@pytest.mark.parametrize("full", [False, True])
def test_flights_that_are_refused_alone_tell_together_what_all_samples_do(fleet: Fleet, full: bool) -> None:
    warehouse, flown = fleet(200)
    alone, fit = only(warehouse.refit("v", sessions="day-0"))
    assert alone.n_flights == 2
    assert fit.reason_code in ("too_little_motion", "ellipsoid_degenerate", "scale_uncertain")
    started = time.perf_counter()
    one, fit = only(warehouse.refit("v", full=full))
    assert time.perf_counter() - started < 2.0  # 0.04 s on a machine that does little else
    assert (one.n_flights, one.n_samples) == (200, 80_000)
    moments = Moments(centre=(3.0, 2.0, -1.0))
    for z in flown:
        moments.feed(z)
        moments.gap()
    expected = moments.solve(Limits(magnitude=1.0, full=full))
    np.testing.assert_allclose(fit.scale, expected.scale, atol=ROUNDING * expected.scale_sd.max())
    np.testing.assert_allclose(fit.bias, expected.bias, atol=ROUNDING * expected.bias_sd.max())
    np.testing.assert_allclose(fit.scale_sd, expected.scale_sd, rtol=1e-6, atol=1e-15)


def test_sessions_of_further_tilt_are_accepted(fleet: Fleet) -> None:
    warehouse, flown = fleet(6, tilt_deg=60.0)
    one, fit = only(warehouse.refit("v", sessions="day-1..day-2"))
    expected = together(flown[2:])
    assert (one.n_flights, fit.reason_code, expected.reason_code) == (4, None, None)
    np.testing.assert_allclose(fit.scale, expected.scale, atol=ROUNDING * expected.scale_sd.max())
    scales = {r["axis"]: r for r in one.rows if r["parameter"] == "scale"}
    assert {r["method"] for r in one.rows} == {"moments"}
    assert (scales["y"]["value"], scales["y"]["status"]) == (fit.scale[1, 1], "ok")
    assert scales["y"]["temperature_degc"] == pytest.approx(20.0 + (2 + 3 + 4 + 5) / 4)
    for sessions, n in (("day-1..", 4), ("..day-1", 4), ("day-1", 2), ("..", 6)):
        assert only(warehouse.refit("v", sessions=sessions))[0].n_flights == n


def test_what_is_withdrawn_does_not_count(fleet: Fleet) -> None:
    warehouse, flown = fleet(4, tilt_deg=60.0)
    warehouse.withdraw(f"{0:016x}", reason="a magnet on board")
    warehouse.withdraw(f"{1:016x}", reason="loose", sensor="magnetometer")
    warehouse.withdraw(f"{2:016x}", reason="loose", sensor="gyroscope")
    one, fit = only(warehouse.refit("v"))
    assert one.n_flights == 2
    np.testing.assert_allclose(fit.bias, together(flown[2:]).bias, rtol=1e-9)


def test_a_dump_is_one_flight_more(fleet: Fleet, tmp_path: Path) -> None:
    warehouse, flown = fleet(4, tilt_deg=60.0)
    board = Moments(sums=24, single=True)
    board.feed(flown[3])
    (tmp_path / "board.bin").write_bytes(dump("magnetometer", board))
    one, fit = only(warehouse.refit("v", sessions="..day-0", dumps=[tmp_path / "board.bin"]))
    expected = together([flown[0], flown[1], flown[3]])
    assert (one.unit_id, one.n_flights) == ("imu-of-v", 3)
    np.testing.assert_allclose(fit.scale, expected.scale, atol=1e-3 * expected.scale_sd.max())
    alone, fit = only(fieldcal.Warehouse(tmp_path / "nowhere").refit(dumps=[tmp_path / "board.bin"]))
    assert (alone.unit_id, alone.n_flights, alone.rows[0]["unit"]) == ("dump", 1, "norm/logged")
    with pytest.raises(fieldcal.FieldcalError, match="no moments for a full scale matrix"):
        warehouse.refit("v", dumps=[tmp_path / "board.bin"], full=True)


@pytest.mark.parametrize(
    ("last", "why"),
    [
        ({"magnitude": 1.01}, "fitted to 1.0 norm from norm and 1.01 norm from norm"),
        ({"unit": "uT"}, "and 1.0 uT"),
        ({"logged_unit": "counts"}, "from counts"),
        ({"polarity": [1.0, 1.0, -1.0]}, "polarities are"),
    ],
)
def test_what_is_not_one_fit_is_told(fleet: Fleet, last: dict[str, Any], why: str) -> None:
    warehouse, _ = fleet(3, **last)
    with pytest.raises(fieldcal.FieldcalError, match=why) as told:
        warehouse.refit("v")
    assert told.value.reason_code == "not_one_fit"


def test_names_that_are_not_there(fleet: Fleet, capsys: pytest.CaptureFixture[str]) -> None:
    warehouse, _ = fleet(3)
    with pytest.raises(fieldcal.FieldcalError, match="no session 'day-9' with moments; there is day-"):
        warehouse.refit("v", sessions="day-0..day-9")
    with pytest.raises(fieldcal.FieldcalError, match='No flight of a vehicle "w"'):
        warehouse.refit("w")
    root = str(warehouse.root)
    assert run(["refit", "--warehouse", root]) == 2
    assert run(["refit", "--vehicle", "v", "--sessions", "..day-0", "--json", "--warehouse", root]) == 0
    out, err = capsys.readouterr()
    assert "Magnetometer of imu-of-v: 2 flights, 800 samples." in err
    found = json.loads(out)
    assert {r["status"] for r in found} == {"refused"}
    assert (found[0]["n_flights"], found[0]["method"], found[0]["unit_id"]) == (2, "moments", "imu-of-v")


def test_noise_of_two_flights_adds_up_axis_by_axis() -> None:
    quiet = SimpleNamespace(noise=np.array([1.0, 2.0, 3.0]), n_differences=5)
    loud = SimpleNamespace(noise=np.array([10.0, 40.0, 90.0]), n_differences=7)
    noise, n_differences = _noise(cast(Any, [quiet, loud]))
    assert noise.tolist() == [11.0, 42.0, 93.0]
    assert n_differences == 12


def test_the_gyroscopes_equations_add_up_too(tmp_path: Path) -> None:
    scale, bias = np.array([-2.2e-4, 2.9e-4, 3.8e-4]), np.array([7.0, -9.6, -11.7])
    t = 0.005 * np.arange(4000)
    made, merged = [], RateEquations(20)
    for k in range(3):
        rng = np.random.default_rng(k)
        q, rate = finely_integrated(t, rng, refinement=2)
        q = multiply(q, from_rotation_vector(0.01 * rng.normal(size=(len(q), 3))))
        own = RateEquations(20)
        own.feed(t * 1e6, q, (rate - bias) / scale)
        merged.merge(own)
        sums = {"polarity": [-1.0, 1.0, 1.0], "centre": own.centre, "noise": own.noise.squares, "sums": own.values}
        as_text = json.dumps({name: np.asarray(value).tolist() for name, value in sums.items()})
        told = {"sensor": "gyroscope", "magnitude": None, "unit": "rad/s", "logged_unit": "counts", "block_samples": 20}
        told |= {"n_samples": own.n_samples, "n_differences": own.noise.n_differences, "sums": as_text}
        made.append(row("v", k, "spring", short_flight(k)) | told)
    flights = [{**lead("v", one["flight_id"], k), "log_uri": f"v/{k}", "verdict": "ok"} for k, one in enumerate(made)]
    frames = {"moments": rows("moments", *made), "flight": rows("flight", *flights)}
    publish(tmp_path, "v", frames, [one["flight_id"] for one in made])
    (one,) = fieldcal.Warehouse(tmp_path).refit("v")
    expected = merged.solve((-1.0, 1.0, 1.0))
    assert isinstance(one.fit, RatesFit)
    assert (one.fit.reason_code, one.n_samples) == ((None, None, None), 12_000)
    for name in ("scale", "bias", "scale_sd", "bias_sd"):
        np.testing.assert_allclose(getattr(one.fit, name), getattr(expected, name), rtol=1e-9)
    np.testing.assert_allclose(one.fit.scale, scale, rtol=0.02)
    sd = {r["axis"]: r["sd"] for r in one.rows if r["parameter"] == "zero"}
    assert sd["x"] == pytest.approx(np.sqrt(_zero_variance(expected, 0)))


def test_the_gyroscopes_flights_add_up_in_any_order_whatever_their_blocks() -> None:
    """Of readings' noise a block keeps a share: in the mean of both flights' blocks."""
    t = 0.005 * np.arange(2000)
    flown, kept, blocks = [], [], []
    for k, (block, samples) in enumerate(((20, 2000), (8, 1000))):
        rng = np.random.default_rng(k)
        q, rate = finely_integrated(t[:samples], rng, refinement=2)
        own = RateEquations(block)
        own.feed(t[:samples] * 1e6, q, rate + 0.1 * rng.normal(size=(samples, 3)))
        assert own.centre is not None
        told = {"centre": own.centre.astype(float), "noise": own.noise.squares, "sums": own.values}
        told |= {"n_differences": own.noise.n_differences, "n_samples": own.n_samples, "block_samples": block}
        flown.append(cast(Any, SimpleNamespace(polarity=(1.0, 1.0, 1.0), **told)))
        kept.append(noise_kept(block))
        blocks.append(own.values[WEIGHT])
        alone, expected = _rates([flown[-1]], 0.05), own.solve()
        np.testing.assert_allclose(alone.scale, expected.scale, rtol=1e-9)
        np.testing.assert_allclose(alone.bias, expected.bias, atol=1e-9)
    about_first = recentred(flown[1].sums[None], flown[1].centre[None] - flown[0].centre[None])[0]
    noise, differences = _noise(flown)
    share = float(np.dot(kept, blocks) / np.sum(blocks))
    expected = fit_rates(
        flown[0].sums + about_first, flown[0].centre, noise, differences, noise_kept=share, n_samples=3000
    )
    for order in (flown, flown[::-1]):
        found = _rates(order, 0.05)
        for name in ("scale", "bias", "scale_sd", "bias_sd", "covariance"):
            np.testing.assert_allclose(getattr(found, name), getattr(expected, name), rtol=1e-7, atol=1e-12)


def test_scale_and_bias_of_one_axis_alone_go_together() -> None:
    sd, bias_sd, covariance = np.array([0.1, 0.2, 0.3]), np.array([1.0, 2.0, 3.0]), np.array([0.05, -0.2, 0.4])
    nothing = np.zeros(3)
    found = _by_axis(RatesFit((None,) * 3, nothing, sd, nothing, bias_sd, covariance, nothing, nothing, 9))
    for i in range(3):
        own = [[sd[i] ** 2, covariance[i]], [covariance[i], bias_sd[i] ** 2]]
        np.testing.assert_allclose(found[np.ix_([i, 3 + i], [i, 3 + i])], own)
    assert np.count_nonzero(found) == 12


def _zero_variance(fit: RatesFit, axis: int) -> float:
    """Of −b/λ to first order."""
    to_zero = np.array([fit.bias[axis] / fit.scale[axis] ** 2, -1.0 / fit.scale[axis]])
    own = np.array([[fit.scale_sd[axis] ** 2, fit.covariance[axis]], [fit.covariance[axis], fit.bias_sd[axis] ** 2]])
    return float(to_zero @ own @ to_zero)


def test_the_stage_collects_what_streams_do() -> None:
    """Of a simulated flight: the same sums as readings and attitudes fed one by one, and constants near the truth."""
    experiment = Experiment(seed=4, duration_s=25.0)
    flown, own = simulate(experiment), settings(experiment)
    before = next(k for k, stage in enumerate(PIPELINE) if stage.name == "moments")
    tables = {f"ingest.{name}": frame for name, frame in signals(flown).items()}
    for stage in PIPELINE[: before + 1]:
        result = run_stage(stage, tables, own)
        tables |= {f"{stage.name}.{name}": frame for name, frame in result.tables.items()}
    made = {one["sensor"]: one for one in tables["moments.moments"].iter_rows(named=True)}
    assert list(made) == ["magnetometer", "accelerometer", "gyroscope"]
    samples = tables["smoothing.samples"]
    assert samples["segment"].n_unique() == 1
    stream = Moments(in_mean=4)
    for reading in matrix(samples, triad("accelerometer")):
        stream.feed(reading)
    sums = json.loads(made["accelerometer"]["sums"])
    np.testing.assert_allclose(sums["sums"], stream.values[1:], rtol=1e-9)
    np.testing.assert_allclose(sums["noise"], stream.noise.squares, rtol=1e-9)
    assert made["accelerometer"]["n_samples"] == samples.height
    equations = RateEquations(made["gyroscope"]["block_samples"])
    equations.values[:] = json.loads(made["gyroscope"]["sums"])["sums"]
    equations.centre = np.array(json.loads(made["gyroscope"]["sums"])["centre"])
    fit: RatesFit = equations.solve((-1.0, 1.0, 1.0))
    truth = np.array(experiment.scale["gyroscope"])
    assert fit.reason_code == (None, None, None)
    assert (np.abs(fit.scale / truth - 1.0) < 0.05).all()
