"""The compiled kernel of the joint estimate against its NumPy counterpart: the same numbers to rounding."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fieldcal import compiled
from fieldcal.errors import EstimationError
from fieldcal.estimation.joint.chain_solver import STATES, Normal, Probe
from fieldcal.estimation.joint.fit import linearised
from fieldcal.estimation.joint.measurement_model import layout_of, residuals, trajectory
from fieldcal.estimation.joint.problem import TERMS
from fieldcal.geometry.rotation import Array, from_rotation_vector, multiply
from fieldcal.simulation.archive import settings, signals
from fieldcal.simulation.experiment import Experiment, simulate
from fieldcal.stages.pipeline import run_flight

sys.path.insert(0, str(Path(__file__).parents[1] / "estimation" / "joint"))
from small_record import Small, small

ROUNDING = 1e-11  # of the largest element of an array
# Of the published sd. Poses of a noise far below the gyroscope's make the chain's equations less well conditioned.
OF_SD, OF_SD_BY_POSES = 1e-9, 1e-5
ALL = tuple(TERMS)
pytestmark = pytest.mark.skipif(compiled.LIBRARY is None, reason="No kernel was compiled, or FIELDCAL_KERNEL=numpy.")

CASES: dict[str, dict[str, Any]] = {
    "plain": {},
    "every term": {"terms": ALL},
    "specific force": {"terms": ALL, "sign": -1.0},
    "delays": {"terms": ("accelerometer_delay", "magnetometer_delay")},
    "no arm, no translation": {"lever_arm": None, "translation_mps2": 0.0},
    "accelerometer alone": {"vectors": ("accelerometer",), "terms": ("accelerometer_cross", "gyroscope_temperature")},
    "magnetometer alone": {"vectors": ("magnetometer",), "terms": ("magnetometer_cross",)},
    "gyroscope alone": {"vectors": ()},
    "1 kHz": {"terms": ALL, "rate_hz": 1000.0},
    "slower than its knots": {"rate_hz": 20.0, "missing": False, "spacing_s": 0.05},
}


def disturbed(**how: Any) -> Small:
    """A record whose attitudes are off by some hundredths of a radian, so that nothing vanishes."""
    given = small(**how)
    turn = 0.03 * np.random.default_rng(1).normal(size=(len(given.state.q), 3))
    return replace(given, state=replace(given.state, q=multiply(from_rotation_vector(turn), given.state.q)))


def by_both(monkeypatch: pytest.MonkeyPatch, compute: Any) -> tuple[Any, Any]:
    """What a function gives with the kernel and without."""
    own = compute()
    with monkeypatch.context() as without:
        without.setattr(compiled, "LIBRARY", None)
        return own, compute()


def assert_same(own: Any, oracle: Any) -> None:
    for a, b in zip(own, oracle, strict=True):
        np.testing.assert_allclose(a, b, rtol=0.0, atol=ROUNDING * max(float(np.abs(b).max(initial=0.0)), 1e-300))


@pytest.mark.parametrize("case", CASES)
def test_trajectory_and_residuals(case: str, monkeypatch: pytest.MonkeyPatch) -> None:
    given = disturbed(**CASES[case])

    def compute() -> tuple[Array, ...]:
        path = trajectory(given.model, given.state)
        return path.q, path.jump, path.rate, residuals(given.model, given.state, path)

    assert_same(*by_both(monkeypatch, compute))


@pytest.mark.parametrize("averaged", [False, True])
@pytest.mark.parametrize("case", CASES)
def test_normal_equations_and_what_is_solved(case: str, averaged: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    given = disturbed(**CASES[case])
    model, state = given.model, given.state
    if averaged:  # rows at some samples only
        rows = np.arange(1, len(model.at), 3)
        kept = {
            n: x if n == "gyroscope" else replace(x, x=x.x[rows], valid=x.valid[rows]) for n, x in model.triads.items()
        }
        model = replace(model, at=rows, triads=kept)
    layout, p = layout_of(model, state.values, dip=True, lever_arm=CASES[case].get("lever_arm", 1) is not None)
    path = trajectory(model, state)
    probe = Probe.draw(model.knots, model.readings.t, model.at, 3 * len(model.vectors))
    weight = np.random.default_rng(2).uniform(0.0, 1.0, (len(model.at), 3 * len(model.vectors)))

    def assembled() -> tuple[Normal, Any, Any]:
        return linearised(model, state, path, layout, p, weight, given.levels, probe, None)

    def compute() -> tuple[Array, ...]:
        normal, joints, reaction = assembled()
        return *normal.blocks(), joints.moved, *reaction

    assert_same(*by_both(monkeypatch, compute))

    def solved() -> tuple[Array, ...]:
        normal = assembled()[0]
        normal.parameters += np.eye(p)
        found = normal.eliminate()
        theta = np.linalg.solve(found.information, found.gradient)
        return found.information, found.gradient, found.solved(slice(p)), found.response(theta)

    own, oracle = by_both(monkeypatch, solved)
    for a, b in zip(own, oracle, strict=True):
        np.testing.assert_allclose(a, b, rtol=0.0, atol=1e-8 * max(float(np.abs(b).max(initial=0.0)), 1e-300))


FLIGHTS: dict[str, Experiment] = {
    "paper's": Experiment(duration_s=14.0, sets=1),
    "translation, arm, steep field": Experiment(
        duration_s=14.0, sets=1, translation_rms_mps2=0.4, lever_arm_m=(0.05, 0.02, -0.03), dip_rad=1.1
    ),
    "bursts and lost samples": Experiment(
        duration_s=20.0, sets=2, magnetic_bursts=2, lost_share=0.003, vps_outlier_share=0.01
    ),
}


@pytest.mark.parametrize("use_vps", [False, True])
@pytest.mark.parametrize("name", FLIGHTS)
def test_a_flight_has_the_same_constants(name: str, use_vps: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    log = signals(simulate(FLIGHTS[name], seed=3))
    own = settings(FLIGHTS[name], method="joint", lever_arm_m=None, use_vps=use_vps)

    def compute() -> Any:
        return run_flight(log, own)["joint"].tables["calibration"].drop_nulls(["value", "sd"])

    c, numpy = by_both(monkeypatch, compute)
    assert len(c) > 10
    assert c["status"].to_list() == numpy["status"].to_list()
    same = OF_SD_BY_POSES if use_vps else OF_SD
    assert np.abs((c["value"] - numpy["value"]) / numpy["sd"]).max() < same
    np.testing.assert_allclose(c["sd"], numpy["sd"], rtol=same)


def test_a_singular_chain_is_refused() -> None:
    normal = Normal.empty(3, 1, 5)
    normal.diagonal[:] = np.eye(STATES)
    normal.diagonal[1, 4, 4] = -1.0
    with pytest.raises(EstimationError) as error:
        normal.eliminate()
    assert error.value.reason_code == "joint_singular"
