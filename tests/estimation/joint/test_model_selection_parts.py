"""Optional terms: which are tried, the score by matrices written out, the gain by sums, what is done with either."""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numerics_support import angle, turning_rates
from small_record import VALUES, Small, mixed, small
from test_chain_solver import assembled
from test_fit_parts import made
from test_score_corrections import Flight, stamps
from test_vps_record import aligned, flight, with_vps

from fieldcal.errors import EstimationError
from fieldcal.estimation.joint import model_selection
from fieldcal.estimation.joint.chain_solver import GRADIENT, Probe
from fieldcal.estimation.joint.fit import JointFit, Options, fit_joint, linearised
from fieldcal.estimation.joint.measurement_model import layout_of
from fieldcal.estimation.joint.model_selection import TermTest, add_terms, candidates, summary, with_terms, with_zeros
from fieldcal.estimation.joint.problem import TERMS
from fieldcal.geometry.rotation import Array, from_rotation_vector, multiply
from fieldcal.reason_codes import ReasonCode

NEAR = 1e-3
SETTLED = 1e-5  # of residuals over their sd, where iterations end


def record(*, warmth: Array | None = None, force: Array | None = None, rate: float = 1.0, **how: Any) -> JointFit:
    fit = made(small(**how))
    readings = replace(fit.model.readings, warmth=warmth, force=force)
    path = replace(fit.path, rate=fit.path.rate * rate / np.sqrt(np.mean(np.sum(fit.path.rate**2, axis=1))))
    return replace(fit, model=replace(fit.model, readings=readings), path=path)


VECTORS = ("accelerometer", "magnetometer")
CROSSED = [f"{name}_cross" for name in VECTORS]
LATE = [f"{name}_delay" for name in VECTORS]


def test_terms_are_tried_of_what_a_record_shows() -> None:
    assert candidates(record()) == ["gyroscope_cross", *LATE, *CROSSED]
    alone = record(vectors=("magnetometer",))
    assert candidates(alone) == ["magnetometer_delay", "magnetometer_cross"]


@pytest.mark.parametrize(("range_degc", "tried"), [(1.0 + NEAR, True), (1.0 - NEAR, False), (1.0, False)])
def test_a_slope_with_temperature_is_tried_beyond_a_degree(range_degc: float, tried: bool) -> None:
    n = len(small().model.readings.t)
    warmth = np.linspace(0.0, range_degc, n)
    assert ("gyroscope_temperature" in candidates(record(warmth=warmth))) == tried


@pytest.mark.parametrize(("radps", "tried"), [(0.2 * (1.0 + NEAR), True), (0.2 * (1.0 - NEAR), False)])
def test_delays_are_tried_where_the_vehicle_turns(radps: float, tried: bool) -> None:
    assert [name for name in candidates(record(rate=radps)) if name.endswith("_delay")] == (LATE if tried else [])


@pytest.mark.parametrize(
    ("mps2", "walk_ratio", "vps", "tried"),
    [
        (2.0 * (1.0 + NEAR), 1.0, True, True),
        (2.0 * (1.0 - NEAR), 1.0, True, False),
        (3.0, 10.0, True, True),
        (3.0, 0.99, True, False),
        (3.0, 10.0, False, False),
    ],
)
def test_a_sensitivity_to_force_is_tried_where_a_vps_tells_and_gravity_turned(
    mps2: float, walk_ratio: float, vps: bool, tried: bool
) -> None:
    n = len(small().model.readings.t)
    force = np.tile(mps2 * np.array([0.6, 0.0, -0.8]), (n, 1))
    fit = replace(record(force=force), options=Options(walk_ratio=walk_ratio))
    fit = replace(fit, vps=SimpleNamespace() if vps else None)  # type: ignore[arg-type]
    assert ("gyroscope_g_sensitivity" in candidates(fit)) == tried


def test_new_terms_begin_at_zero() -> None:
    state = small().state
    found = with_zeros(state, list(TERMS))
    assert {name: found.values[name].tolist() for name in TERMS} == {name: [0.0] * size for name, size in TERMS.items()}
    assert found.values["dip"] is state.values["dip"]
    begun = {**found.values, "gyroscope_cross": np.ones(6)}
    assert with_zeros(replace(state, values=begun), list(TERMS)).values["gyroscope_cross"] is begun["gyroscope_cross"]


def test_a_first_step_moves_a_term_from_zero_and_what_follows_it() -> None:
    state = small().state
    moved = {"dip": np.array([0.5]), "magnetometer_delay": np.array([2e-3])}
    found = model_selection._stepped(state, "magnetometer_delay", moved)
    assert found.values["magnetometer_delay"].tolist() == [2e-3]
    assert found.values["dip"] == pytest.approx(state.values["dip"] + 0.5)
    assert found.values["gyroscope"] is state.values["gyroscope"]
    assert "magnetometer_delay" not in state.values


def disturbed(*, free_dip: bool = True) -> JointFit:
    """A fit of six seconds of every motion, whose magnetometer holds cross-axis terms that it does not know of."""
    t = stamps(6.0)
    flight = Flight.of(t, turning_rates(t, np.random.default_rng(1), peak=1.5))
    crossed = flight.model.triads["magnetometer"]
    mix = mixed("magnetometer", VALUES["magnetometer_cross"])
    crossed = replace(crossed, x=np.linalg.solve(mix, crossed.x.T).T)
    model = replace(flight.model, triads={**flight.model.triads, "magnetometer": crossed})
    fit = made(replace(flight, model=model))
    layout, p = layout_of(model, flight.state.values, dip=free_dip, lever_arm=True)
    return replace(fit, layout=layout, covariance=np.eye(p), information=np.eye(p))


@pytest.mark.parametrize("free_dip", [True, False])
def test_scores_are_those_of_the_whole_information_matrix(free_dip: bool) -> None:
    """χ² of each candidate's part of the step with all candidates free; what a candidate alone would move the other
    parameters by: by inverses of the matrix with every knot in it."""
    fit = disturbed(free_dip=free_dip)
    names = candidates(fit)
    model, state = fit.model, with_zeros(fit.state, names)
    layout, p = layout_of(model, state.values, dip=free_dip, lever_arm=True)
    probe = Probe.draw(model.knots, model.readings.t, model.at, 6)
    normal, _, _ = linearised(model, state, fit.path, layout, p, fit.weight, fit.levels, probe, None)
    matrix, right = assembled(normal)
    size = len(matrix)
    known = size - p
    knots, at = np.arange(known), {name: known + np.arange(p)[columns] for name, columns in layout.items()}
    tested = np.concatenate([at[name] for name in names])
    rest = np.setdiff1d(np.arange(size), tested)

    def left(of: Array, without: Array) -> tuple[Array, Array]:
        """Information of some unknowns, and their gradient, with others free."""
        gain = np.linalg.solve(matrix[np.ix_(without, without)], matrix[np.ix_(without, of)])
        return matrix[np.ix_(of, of)] - matrix[np.ix_(of, without)] @ gain, gain

    information, _ = left(tested, rest)
    # The others are at their optimum: of the gradient only the candidates' part, knots apart, is looked at.
    gradient = right[:, GRADIENT]
    own = gradient[tested] - matrix[np.ix_(tested, knots)] @ np.linalg.solve(
        matrix[np.ix_(knots, knots)], gradient[knots]
    )
    covariance = np.linalg.inv(information)
    step = covariance @ own
    scores, moved = model_selection._scores(fit, names)
    assert list(scores) == names
    begin = 0
    for name in names:
        these = slice(begin, begin + len(at[name]))
        begin = these.stop
        expected = step[these] @ np.linalg.inv(covariance[these, these]) @ step[these]
        assert scores[name] == pytest.approx(expected, rel=0.02), name
        alone, gain = left(at[name], rest)
        first = np.linalg.solve(alone, own[these])
        np.testing.assert_allclose(moved[name][name], first, atol=0.02 * np.abs(first).max())
        by = -gain @ first
        for other, columns in fit.layout.items():
            place = np.searchsorted(rest, known + np.arange(p)[layout[other]])
            assert len(moved[name][other]) == columns.stop - columns.start
            np.testing.assert_allclose(moved[name][other], by[place], atol=0.02 * np.abs(by[place]).max() + 1e-9)
    assert scores["magnetometer_cross"] > scores["accelerometer_cross"]


def test_what_a_left_out_term_would_move_is_in_the_covariance() -> None:
    fit = record()
    change = {"dip": np.array([0.5]), "magnetometer": np.arange(6.0), "gone": np.ones(3)}
    other = {"accelerometer": np.ones(6)}
    found = model_selection._doubted(fit, [change, other])
    by = np.zeros((2, len(fit.covariance)))
    by[0, fit.layout["dip"]], by[0, fit.layout["magnetometer"]] = 0.5, np.arange(6.0)
    by[1, fit.layout["accelerometer"]] = 1.0
    np.testing.assert_allclose(found.covariance, fit.covariance + by.T @ by)
    assert model_selection._doubted(fit, []) is fit


class Scripted:
    """Tests of terms with given scores and gains, and what is made of them."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, scores: dict[str, float], gains: dict[str, float]) -> None:
        self.fit, self.made, self.doubted, self.asked = record(), [], [], []
        self.fails = False
        moved = {name: {"dip": np.array([float(i)])} for i, name in enumerate(scores)}
        monkeypatch.setattr(model_selection, "_scores", lambda fit, names: (scores, moved))
        monkeypatch.setattr(model_selection, "_gains", self.gains_of(gains))
        monkeypatch.setattr(model_selection, "with_terms", self.with_terms)
        monkeypatch.setattr(model_selection, "_doubted", self.doubt)

    made: list[list[str]]
    asked: list[list[str]]
    doubted: list[float]

    def gains_of(self, gains: dict[str, float]) -> Any:
        def of(fit: JointFit, names: list[str]) -> dict[str, float]:
            self.asked.append(names)
            return gains

        return of

    def with_terms(self, fit: JointFit, names: list[str]) -> JointFit:
        self.made.append(names)
        if self.fails:
            raise EstimationError(ReasonCode.JOINT_DIVERGED, "no")
        return replace(fit, iterations=99)

    def doubt(self, fit: JointFit, moved: list[dict[str, Array]]) -> JointFit:
        self.doubted = [float(change["dip"][0]) for change in moved]
        return fit


SCORES = {"gyroscope_cross": 22.6, "accelerometer_cross": 16.2, "magnetometer_cross": 50.0, "magnetometer_delay": 10.9}
"""Limits: 22.5 of six, 16.3 of three, 10.8 of one."""


def test_a_term_passes_both_tests_or_is_doubted(monkeypatch: pytest.MonkeyPatch) -> None:
    script = Scripted(
        monkeypatch, SCORES, {"magnetometer_cross": 3.01, "gyroscope_cross": 2.99, "magnetometer_delay": 3.0}
    )
    fit, tests = add_terms(script.fit)
    # The most above its limit first.
    assert script.asked == [["magnetometer_cross", "magnetometer_delay", "gyroscope_cross"]]
    assert script.made == [["magnetometer_cross"]]
    assert script.doubted == [3.0, 0.0]
    assert fit.iterations == 99
    assert [(test.name, test.kept, test.gain) for test in tests] == [
        ("gyroscope_cross", False, 2.99),
        ("accelerometer_cross", False, None),
        ("magnetometer_cross", True, 3.01),
        ("magnetometer_delay", False, 3.0),
    ]
    assert [test.score for test in tests] == list(SCORES.values())


def test_terms_that_cannot_be_fitted_are_doubted(monkeypatch: pytest.MonkeyPatch) -> None:
    script = Scripted(monkeypatch, SCORES, {"magnetometer_cross": 9.0})
    script.fails = True
    fit, tests = add_terms(script.fit)
    assert fit is script.fit
    assert not any(test.kept for test in tests)
    assert script.made == [["magnetometer_cross"]]  # of the others nothing was found out
    assert script.doubted == [2.0, 3.0, 0.0]


def test_without_a_score_nothing_is_predicted(monkeypatch: pytest.MonkeyPatch) -> None:
    script = Scripted(monkeypatch, dict.fromkeys(SCORES, 1.0), {})
    fit, tests = add_terms(script.fit)
    assert fit is script.fit
    assert (script.asked, script.made, script.doubted) == ([], [], [])
    assert [test.gain for test in tests] == [None] * 4


def test_the_limits_are_exceeded_by_chance_once_in_a_thousand_and_not_met(monkeypatch: pytest.MonkeyPatch) -> None:
    at_limit = {"gyroscope_cross": 22.5, "accelerometer_cross": 16.3, "magnetometer_delay": 10.8}
    assert {size: model_selection.SCORE_CHI2[size] for size in (1, 3, 6, 9)} == {1: 10.8, 3: 16.3, 6: 22.5, 9: 27.9}
    script = Scripted(monkeypatch, at_limit, {})
    add_terms(script.fit)
    assert script.asked == []


def test_terms_are_fitted_as_the_fit_was(monkeypatch: pytest.MonkeyPatch) -> None:
    """Dip and lever arm where those were free, the walk's bound and what was known; iterations of both."""
    seen: list[dict[str, Any]] = []

    def fit_joint(model: Any, state: Any, **how: Any) -> JointFit:
        seen.append({"values": state.values, **how})
        return replace(fit, iterations=4)

    monkeypatch.setattr(model_selection, "fit_joint", fit_joint)
    for dip, arm in ((True, False), (False, True)):
        fit = record()
        layout, _ = layout_of(fit.model, fit.state.values, dip=dip, lever_arm=arm)
        fit = replace(fit, layout=layout, options=Options(walk_ratio=7.0), iterations=3)
        assert with_terms(fit, ["magnetometer_cross"]).iterations == 7
        how = seen.pop()
        assert (how["free_dip"], how["try_lever_arm"], how["largest_walk_ratio"]) == (dip, arm, 7.0)
        assert how["values"]["magnetometer_cross"].tolist() == [0.0] * 6
        assert how["levels"] is fit.levels


def prediction(model: Any, seed: int = 1) -> Any:
    rng = np.random.default_rng(seed)
    m, k = len(model.at), len(model.knots.index)
    return model_selection._Prediction(
        rng.normal(size=(m, 6)), rng.uniform(0.3, 1.0, size=(m, 6)), rng.normal(size=(k - 1, 12)), small().state
    )


def long_record(blocks: int, rows: int = 20) -> Small:
    """Intervals of a quarter of a second, eight a block of two."""
    own = small(missing=False)
    k = 8 * blocks + 1
    knots = replace(
        own.model.knots, index=rows * np.arange(k), of_sample=np.minimum(np.arange(rows * (k - 1) + 1) // rows, k - 1),
        interval_s=np.full(k - 1, 0.25), joined=np.ones(k - 1, dtype=bool),
    )  # fmt: skip
    return replace(own, model=replace(own.model, knots=knots, at=np.arange(rows * (k - 1))))


def test_a_gain_is_the_drop_over_its_sd_by_blocks() -> None:
    """d = Σ w (a² − b²); its sd from d − |Δ|² by blocks of 2 s, of readings and links, weights those without."""
    model = long_record(7).model
    a, b = prediction(model), prediction(model, 2)
    k = len(model.knots.index)
    drop, changed = np.zeros(7), np.zeros(7)
    for i, knot in enumerate(model.knots.of_sample[model.at]):
        block = min(int(knot) * 7 // k, 6)
        drop[block] += np.sum(a.weight[i] * (a.rows[i] ** 2 - b.rows[i] ** 2))
        changed[block] += np.sum(a.weight[i] * (a.rows[i] - b.rows[i]) ** 2)
    for i in range(k - 1):
        block = min(i * 7 // k, 6)
        drop[block] += np.sum(a.links[i] ** 2 - b.links[i] ** 2)
        changed[block] += np.sum((a.links[i] - b.links[i]) ** 2)
    expected = drop.sum() / np.sqrt(np.sum((drop - changed) ** 2))
    assert model_selection._gain(model, a, b) == pytest.approx(expected)
    assert model_selection._gain(model, a, a) == 0.0
    small_a, small_b = (replace(x, rows=1e-3 * x.rows, links=1e-3 * x.links) for x in (a, b))
    assert model_selection._gain(model, small_a, small_b) == pytest.approx(expected)


@pytest.mark.parametrize(("blocks", "told"), [(6, True), (5, False)])
def test_six_blocks_are_enough_for_a_gain(blocks: int, told: bool) -> None:
    model = long_record(blocks).model
    assert (model_selection._gain(model, prediction(model), prediction(model, 2)) != 0.0) == told


def test_a_right_term_gains_as_much_as_it_changes() -> None:
    """Residuals of unit noise with a change of 0.3 everywhere, which the term takes away."""
    model = long_record(50).model
    noise = prediction(model)
    noise = replace(noise, weight=np.ones_like(noise.weight))
    without = replace(noise, rows=noise.rows + 0.3)
    gain = model_selection._gain(model, without, noise)
    n = noise.rows.size
    assert gain == pytest.approx(0.3 * np.sqrt(n) / 2.0, rel=0.35)  # |Δ|² over 2 |Δ|


def test_parts_of_the_record_begin_where_the_fit_is() -> None:
    fit = record()
    n = len(fit.model.readings.t)
    for a, b in ((0, 70), (70, n)):
        model, state, vps = model_selection._part(fit, a, b)
        assert vps is None
        assert (model.readings.t == fit.model.readings.t[a:b]).all()
        at = a + model.knots.index
        assert angle(state.q, fit.path.q[at]).max() < 1e-12
        assert (state.motion == fit.state.motion[fit.model.knots.of_sample[at]]).all()
        assert state.values is fit.state.values
    # As far apart as the fit's: cut at its knots, a part has its knots.
    index = fit.model.knots.index
    model, _, _ = model_selection._part(fit, 0, int(index[5]) + 1)
    assert model.knots.index.tolist() == index[:6].tolist()


@dataclass(frozen=True)
class Told:
    """What stands for a fit, its state, or a prediction by it: the terms in it, and those after one step only."""

    names: tuple[str, ...] = ()
    step: str = ""
    levels: None = None

    @property
    def state(self) -> Told:
        return self


class Split:
    """Fits of the first part, and steps of them, that predict the rest by given numbers."""

    def __init__(
        self,
        monkeypatch: pytest.MonkeyPatch,
        steps: dict[tuple[tuple[str, ...], str], float],
        fits: dict[tuple[str, ...], float] | None = None,
    ) -> None:
        self.fit, self.parts, self.compared, self.scored = record(), [], [], []
        self.steps, self.fits, self.fails = steps, fits or {}, ""
        monkeypatch.setattr(model_selection, "_part", self.part)
        monkeypatch.setattr(model_selection, "_refitted", self.refitted)
        monkeypatch.setattr(model_selection, "_scores", self.scores)
        monkeypatch.setattr(model_selection, "_stepped", lambda state, name, moved: replace(state, step=name))
        monkeypatch.setattr(model_selection, "replace", lambda fit, **new: new.get("state", fit))
        monkeypatch.setattr(model_selection, "_predicted", self.predicted)
        monkeypatch.setattr(model_selection, "_gain", self.gain)

    parts: list[tuple[int, int]]
    compared: list[Any]
    scored: list[Any]

    def part(self, fit: JointFit, a: int, b: int) -> Any:
        self.parts.append((a, b))
        return f"from {a}", Told(), None

    def scores(self, fit: Told, names: list[str]) -> Any:
        self.scored.append((fit.names, names))
        return {}, {name: {} for name in names}

    def refitted(self, model: Any, state: Any, levels: Any, like: Any, names: list[str], vps: Any) -> Any:
        assert model == "from 0"
        assert names == ([state.step] if state.step else [])
        if self.fails and self.fails in names:
            raise EstimationError(ReasonCode.JOINT_DIVERGED, "no")
        return Told((*state.names, *names))

    def predicted(self, model: Any, state: Any, vps: Any, constants: Told, noise: Told, **iterations: int) -> Told:
        assert iterations == ({"iterations": 2} if constants.step else {})
        assert isinstance(state, Told)
        return constants

    def gain(self, model: Any, without: Told, term: Told) -> float:
        assert model == f"from {self.parts[1][0]}"
        self.compared.append((without.names, term.names, term.step))
        return self.steps[term.names, term.step] if term.step else self.fits[term.names]


def test_terms_are_selected_forwards_beside_those_accepted(monkeypatch: pytest.MonkeyPatch) -> None:
    """On the first six tenths, to the knot after. A plain gain needs no fit, unless others are tried beside it."""
    split = Split(monkeypatch, {((), "a"): 9.0, (("a",), "b"): 1.0, (("a",), "c"): 5.0})
    assert model_selection._gains(split.fit, ["a", "b", "c"]) == {"a": 9.0, "b": 1.0, "c": 5.0}
    assert split.compared == [((), (), "a"), (("a",), ("a",), "b"), (("a",), ("a",), "c")]
    assert split.scored == [((), ["a", "b", "c"]), (("a",), ["b", "c"])]
    n, index = len(split.fit.model.readings.t), split.fit.model.knots.index
    knot = int(index[index >= int(0.6 * n)][0])
    assert split.parts == [(0, knot + 1), (knot, n)]


@pytest.mark.parametrize(("by_step", "by_fit", "kept"), [(4.9, 3.0, False), (1.6, 3.1, True)])
def test_near_the_limit_the_fit_decides(
    by_step: float, by_fit: float, kept: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    beside = ("a",) if kept else ()
    split = Split(monkeypatch, {((), "a"): by_step, (beside, "b"): 1.5}, {("a",): by_fit})
    assert model_selection._gains(split.fit, ["a", "b"]) == {"a": by_fit, "b": 1.5}
    assert split.compared == [((), (), "a"), ((), ("a",), ""), (beside, beside, "b")]


def test_a_term_that_cannot_be_fitted_ends_the_selection(monkeypatch: pytest.MonkeyPatch) -> None:
    split = Split(monkeypatch, {((), "a"): 1.0, ((), "b"): 2.0})
    split.fails = "b"
    assert model_selection._gains(split.fit, ["a", "b", "c"]) == {"a": 1.0}


def test_a_step_predicts_nearly_as_a_fit_does() -> None:
    """Cross-axis terms that are there are found by a step as plainly as by the fit; their constants are near."""
    fit = fit_joint(disturbed().model, disturbed().state, try_lever_arm=False)
    names = ["magnetometer_cross"]
    moved = model_selection._scores(fit, names)[1]["magnetometer_cross"]
    stepped = model_selection._stepped(fit.state, "magnetometer_cross", moved)
    exact = with_terms(fit, names)
    found, expected = (x.values["magnetometer_cross"] for x in (stepped, exact.state))
    assert np.abs(found - expected).max() < 0.2 * np.abs(expected).max()


def test_the_first_part_gives_what_the_whole_does_within_its_sd() -> None:
    given = disturbed()
    fit = fit_joint(given.model, given.state, try_lever_arm=False)
    split = int(0.7 * len(given.model.readings.t))
    part = model_selection.first_part(fit, split)
    assert part is not None
    assert len(part.model.readings.t) == split
    (scale, _, sd), (whole, _, _) = (x.constants("gyroscope") for x in (part, fit))
    assert (np.abs(scale - whole) < 3.0 * np.sqrt(np.diagonal(sd)[:3])).all()
    assert not part.options.doubt_lever_arm


def test_a_prediction_finds_the_attitudes_and_the_translation_of_known_constants() -> None:
    """From attitudes that are off by some mrad: what is left are residuals over the levels' sd."""
    flight = small(missing=False)
    fit = made(flight)
    rng = np.random.default_rng(6)
    turn = 3e-3 * rng.normal(size=(len(flight.state.q), 3))
    off = replace(
        flight.state, q=multiply(from_rotation_vector(turn), flight.state.q), motion=0.0 * flight.state.motion
    )
    steady = replace(fit, levels=replace(fit.levels, strength=0.7, walk=1e-4))
    found = model_selection._predicted(flight.model, off, None, steady, steady)
    same = model_selection._predicted(flight.model, flight.state, None, steady, steady)
    np.testing.assert_allclose(found.rows, same.rows, atol=SETTLED)
    np.testing.assert_allclose(found.links, same.links, atol=SETTLED)
    assert found.weight.min() == 1.0
    assert np.sqrt(np.mean(found.rows**2)) < 0.3
    levels = steady.levels
    white = replace(levels, variance=levels.variance * levels.colour, colour=np.ones(6))
    assert (levels.colour[1:] > 1.0).all()
    as_dense = model_selection._predicted(flight.model, off, None, steady, replace(steady, levels=white))
    np.testing.assert_allclose(as_dense.rows, found.rows, atol=SETTLED)
    louder = replace(steady, levels=replace(steady.levels, variance=4.0 * steady.levels.variance))
    quarter = model_selection._predicted(flight.model, flight.state, None, steady, louder)
    assert np.sqrt(np.mean(quarter.rows**2)) < np.sqrt(np.mean(same.rows**2))


def test_a_prediction_holds_the_poses_too() -> None:
    """Their residuals over the noise of the fit that gives the levels, of poses that are used in the part; the last
    knot begins no interval."""
    own = flight(translation_mps2=0.0)
    vps = aligned(own)
    given = with_vps(own, vps)
    sharp = replace(own.levels, variance=np.full(6, 1e-8), colour=np.ones(6), strength=1e-2)
    fit = replace(made(given), vps=vps, levels=sharp)
    loud = replace(fit, vps=replace(vps, sigma_rad=2e-3))
    left_out = replace(vps, used=vps.used & (np.arange(len(vps.used)) != 5))
    poses = multiply(from_rotation_vector([3e-4, 0.0, 0.0]), vps.q)
    off = replace(fit, vps=replace(vps, q=poses))
    k = len(vps.used)
    found = model_selection._predicted(given.model, given.state, left_out, off, loud)
    assert found.links.shape == (k - 1, 12 + 3)
    own_links = found.links[:, 12:]
    assert not own_links[5].any()
    # Vectors hold the attitude where poses of 2 mrad hardly count.
    others = np.delete(own_links, 5, axis=0)
    np.testing.assert_allclose(others, np.tile([0.15, 0.0, 0.0], (k - 2, 1)), atol=0.08)
    without = model_selection._predicted(given.model, given.state, None, fit, fit)
    assert without.links.shape == (k - 1, 12)
    bare = replace(fit, vps=None)
    for constants, noise in ((bare, fit), (fit, bare)):
        assert model_selection._predicted(given.model, given.state, vps, constants, noise).links.shape[1] == 12


def test_numbers_of_the_tests_are_told_plainly() -> None:
    fit = made(small(("magnetometer_delay",)))
    tests = [TermTest("magnetometer_delay", 50.0, 4.0, True), TermTest("gyroscope_cross", 2.0, None, False)]
    told = summary(tests, fit)
    columns = fit.layout["magnetometer_delay"]
    assert told == {
        "magnetometer_delay": {
            "kept": True, "score": 50.0, "held_out_gain": 4.0, "value": [-0.003],
            "sd": [pytest.approx(float(np.sqrt(fit.covariance[columns, columns][0, 0])))],
        },
        "gyroscope_cross": {"kept": False, "score": 2.0, "held_out_gain": None},
    }  # fmt: skip
