"""Which rung is tried with what, and what is told of those that do not stand; the magnetometer's start exactly."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from test_initialise import BIAS, CONSTANTS, FIELD_NED, SCALE, flown

from fieldcal.errors import EstimationError, UnusableFlight
from fieldcal.estimation.joint import ladder
from fieldcal.estimation.joint.ladder import Outcome, fit_with_fallbacks, magnetometer_start
from fieldcal.estimation.joint.problem import PriorConstants, Readings
from fieldcal.geometry.rotation import Array, from_rotation_vector
from fieldcal.names import Rung
from fieldcal.reason_codes import ReasonCode

ARM = np.array([0.1, 0.2, 0.3])
EVERY = ("gyroscope", "accelerometer", "magnetometer")
HELD = 1e-5
COMMON = 1.7  # factor of the magnetometer's unit


class Climbed:
    """Preparations and fits that fail as told, and what they were asked for. Gravity moves by `tilt` g, rms."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, *, tilt: float = 0.5) -> None:
        self.asked: list[dict[str, Any]] = []
        self.prepared: list[dict[str, Any]] = []
        self.failing: tuple[int, ...] = ()
        self.unprepared: tuple[int, ...] = ()
        # A bank either way: the rms over three axes of how far gravity moves is sin β/√3.
        bank = np.arcsin(np.sqrt(3.0) * tilt)
        self.q = from_rotation_vector(np.column_stack([bank * np.r_[np.ones(50), -np.ones(50)], np.zeros((100, 2))]))
        monkeypatch.setattr(ladder.initialise, "prepare", self.prepare)
        monkeypatch.setattr(ladder, "fit_joint", self.fit)
        monkeypatch.setattr(ladder, "magnetometer_start", lambda readings, start: ("own start", tuple(start)))
        monkeypatch.setattr(ladder, "gyroscope_by_turning", lambda readings, start: f"by {start['magnetometer']}")

    def prepare(self, readings: Readings, start: Mapping[str, Any], *, lever_arm: Array | None = None) -> Any:
        self.prepared.append({"start": dict(start), "lever_arm": lever_arm})
        if len(self.prepared) in self.unprepared:
            raise UnusableFlight(ReasonCode.NO_START, f"unprepared {len(self.prepared)}")
        return len(self.prepared), SimpleNamespace(q=self.q)

    def fit(
        self,
        model: Any,
        state: Any,
        *,
        try_lever_arm: bool,
        priors: Mapping[str, PriorConstants],
        doubt_lever_arm: bool = True,
    ) -> Any:
        self.asked.append({"model": model, "arm": try_lever_arm, "priors": priors})
        if len(self.asked) in self.failing:
            raise EstimationError(ReasonCode.JOINT_DIVERGED, f"fit {len(self.asked)}")
        return f"fit {len(self.asked)}"

    def run(self, known: tuple[str, ...] = EVERY, *, lever_arm: Array | None = None, without: str = "") -> Outcome:
        readings, _ = flown(seconds=2.0)
        readings = replace(readings, **{without: None}) if without else readings
        return fit_with_fallbacks(readings, START, {name: PRIORS[name] for name in known}, lever_arm=lever_arm)


START: dict[str, Any] = {name: f"start of {name}" for name in EVERY}
PRIORS = {name: PriorConstants(np.ones(3), np.zeros(3), np.diag(np.arange(1.0, 7.0) ** 2)) for name in EVERY}


def sd(prior: PriorConstants) -> list[float]:
    return list(np.sqrt(np.diagonal(prior.covariance)))


FREE, SCALED = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0], [HELD, 2.0 * HELD, 3.0 * HELD, 4.0, 5.0, 6.0]
FIXED = [HELD * x for x in FREE]


def known_start(name: str) -> bool:
    """Whether a start is that of the constants known beforehand."""
    return not isinstance(name, str)


def test_the_first_rung_is_free_and_prepared_once(monkeypatch: pytest.MonkeyPatch) -> None:
    climbed = Climbed(monkeypatch)
    outcome = climbed.run()
    assert (outcome.rung, outcome.fit, outcome.failed) == (Rung.FREE, "fit 1", {})
    assert climbed.prepared == [{"start": START, "lever_arm": None}]
    ((asked),) = climbed.asked
    assert (asked["model"], asked["arm"]) == (1, True)
    assert [sd(asked["priors"][name]) for name in EVERY] == [pytest.approx(FREE)] * 3


def test_rung_by_rung_less_is_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    climbed = Climbed(monkeypatch)
    climbed.failing = (1, 2, 3)
    outcome = climbed.run()
    assert outcome.rung == Rung.ZEROS
    assert outcome.failed == {Rung.FREE: "fit 1", Rung.HELD: "fit 2", Rung.INERTIAL_START: "fit 3"}
    assert [asked["arm"] for asked in climbed.asked] == [True, False, True, False]
    of = {name: [pytest.approx(sd(asked["priors"][name])) for asked in climbed.asked] for name in EVERY}
    assert of == {
        "accelerometer": [FREE, FIXED, FREE, FIXED], "gyroscope": [FREE, FREE, FREE, SCALED], "magnetometer": [FREE] * 4
    }  # fmt: skip
    starts = [prepared["start"] for prepared in climbed.prepared]
    assert [known_start(start["gyroscope"]) for start in starts] == [False, True, True, True]
    assert [known_start(start["accelerometer"]) for start in starts] == [False, True, True, True]
    assert [start["magnetometer"] for start in starts] == [START["magnetometer"]] * 2 + [
        ("own start", EVERY), START["magnetometer"],
    ]  # fmt: skip


@pytest.mark.parametrize(("tilt", "level"), [(0.149, True), (0.151, False)])
def test_a_level_record_holds_the_accelerometer_from_the_first(
    monkeypatch: pytest.MonkeyPatch, tilt: float, level: bool
) -> None:
    climbed = Climbed(monkeypatch, tilt=tilt)
    outcome = climbed.run()
    assert outcome.rung == (Rung.HELD if level else Rung.FREE)
    climbed.failing = (2, 3)
    climbed.run()
    held = [sd(asked["priors"]["accelerometer"])[0] < 1e-3 for asked in climbed.asked]
    assert all(held) == level
    assert any(asked["arm"] for asked in climbed.asked) != level


def test_counts_start_from_the_field_where_attitudes_give_no_start(monkeypatch: pytest.MonkeyPatch) -> None:
    for failing, unprepared in (((1,), ()), ((), (1,))):
        climbed = Climbed(monkeypatch)
        climbed.failing, climbed.unprepared = failing, unprepared
        outcome = climbed.run(())
        assert outcome.rung == Rung.TURNING_START
        assert list(outcome.failed) == [Rung.FREE]
        own = {**START, "gyroscope": f"by {START['magnetometer']}"}
        assert climbed.prepared[-1] == {"start": own, "lever_arm": None}
        assert (climbed.asked[-1]["arm"], climbed.asked[-1]["priors"]) == (True, {})


def test_counts_whose_accelerometer_spoils_the_start_do_without_it(monkeypatch: pytest.MonkeyPatch) -> None:
    climbed = Climbed(monkeypatch)
    climbed.failing = (1, 2)
    outcome = climbed.run(())
    assert outcome.rung == Rung.FIELD_ALONE
    assert list(outcome.failed) == [Rung.FREE, Rung.TURNING_START]
    own = {**START, "gyroscope": f"by {START['magnetometer']}", "accelerometer": None}
    assert climbed.prepared[-1]["start"] == own
    assert not climbed.asked[-1]["arm"]


def test_what_is_not_known_beforehand_has_three_rungs(monkeypatch: pytest.MonkeyPatch) -> None:
    climbed = Climbed(monkeypatch)
    climbed.failing = (1, 2, 3)
    with pytest.raises(EstimationError, match="fit 1"):
        climbed.run(())
    assert len(climbed.asked) == 3
    with monkeypatch.context() as patch:
        patch.setitem(START, "magnetometer", None)
        climbed = Climbed(patch)
        climbed.failing = (1, 2, 3)
        with pytest.raises(EstimationError, match="fit 1"):
            climbed.run(())
        assert len(climbed.asked) == 2
    for known, rungs in ((("gyroscope",), 1), (("accelerometer",), 3), (("gyroscope", "magnetometer"), 1)):
        climbed = Climbed(monkeypatch)
        climbed.failing = tuple(range(1, 9))
        with pytest.raises(EstimationError, match="fit 1"):
            climbed.run(known)
        assert len(climbed.asked) == rungs, known
    climbed = Climbed(monkeypatch)
    climbed.failing = (1, 2)
    outcome = climbed.run(without="magnetometer")
    assert outcome.rung == Rung.ZEROS
    climbed = Climbed(monkeypatch)
    climbed.failing = (1, 2)
    assert climbed.run(("accelerometer", "gyroscope"), without="accelerometer").rung == Rung.INERTIAL_START


def test_a_lever_arm_that_was_measured_is_not_estimated(monkeypatch: pytest.MonkeyPatch) -> None:
    climbed = Climbed(monkeypatch)
    climbed.failing = (1, 2)
    climbed.run(lever_arm=ARM)
    assert not any(asked["arm"] for asked in climbed.asked)
    assert [prepared["lever_arm"] is ARM for prepared in climbed.prepared] == [True] * 3


def test_a_record_that_cannot_be_prepared_is_told_and_tried_on(monkeypatch: pytest.MonkeyPatch) -> None:
    climbed = Climbed(monkeypatch)
    climbed.unprepared = (1, 2)
    outcome = climbed.run()
    assert outcome.rung == Rung.HELD
    assert outcome.failed == {Rung.FREE: "unprepared 2"}
    climbed = Climbed(monkeypatch)
    climbed.unprepared = tuple(range(1, 9))
    with pytest.raises(UnusableFlight, match="unprepared 2"):
        climbed.run()


def test_a_magnetometer_s_bias_and_common_scale_are_those_of_attitudes() -> None:
    """Exact readings whose bias is far off and whose unit is: scales that are right among themselves."""
    r, _ = flown(seconds=30.0)
    off = (SCALE["magnetometer"] * COMMON, np.zeros(3))
    holed = r.magnetometer.copy()  # type: ignore[union-attr]
    holed[200:230, 1] = np.nan
    for given in (r, replace(r, magnetometer=holed)):
        scale, bias = magnetometer_start(given, {**CONSTANTS, "magnetometer": off})
        np.testing.assert_allclose(scale, SCALE["magnetometer"], rtol=0.01)
        np.testing.assert_allclose(bias, BIAS["magnetometer"], atol=0.02 * np.linalg.norm(FIELD_NED))
    for missing in (replace(r, magnetometer=None), r):
        with pytest.raises(UnusableFlight) as error:
            magnetometer_start(missing, {**CONSTANTS, "magnetometer": off if missing is not r else None})
        assert error.value.reason_code == "no_start"
