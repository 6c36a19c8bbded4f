"""The flights of one unit pooled: sessions in order of time, with steps, drifts and bends that are known, without the
flights that are left out."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from fieldcal.estimation.normal_equations import Name, NormalEquations
from fieldcal.estimation.pooled.chain import Chain, Estimate, Known
from fieldcal.estimation.pooled.strengths import Strengths
from fieldcal.geometry.rotation import Array

SLOPED = ("gain", "zero")
"""Constants that depend on temperature."""
OF_SLOPE = {"zero_per_degc": "zero"}
"""Parameters of a flight that are slopes of a constant."""
BENDING = "zero"
"""The parameter that may depend on temperature by more than a straight line."""
LEAST_SHARE = 1e-4
"""Of the information on a constant: a session that adds less of it says nothing."""


@dataclass(frozen=True)
class Flight:
    """`equations` of a flight, in coordinates that its siblings share; `session` counts from 0 in order of time;
    `warmth_degc` its temperature less the reference, None where nobody knows it."""

    equations: NormalEquations
    session: int
    warmth_degc: float | None


@dataclass(frozen=True)
class Unit:
    """Flights of one unit and the `day` (m,) of their sessions."""

    flights: tuple[Flight, ...]
    day: Array

    @property
    def names(self) -> tuple[Name, ...]:
        """The constants of the unit."""
        seen = {name for flight in self.flights for name in flight.equations.names if name[1] not in OF_SLOPE}
        return tuple(sorted(seen))


@dataclass(frozen=True)
class Step:
    """One constant steps between session `after` − 1 and `after`, by `size` with sd `sd`; `z` before it was one."""

    name: Name
    after: int
    size: float
    sd: float
    z: float


@dataclass(frozen=True)
class Coefficient:
    """What all sessions say of how a constant changes beside the state: `value` with sd `sd`."""

    value: float
    sd: float

    @property
    def z(self) -> float:
        return self.value / self.sd


@dataclass(frozen=True)
class LeftOut:
    """A flight that contradicts the others: χ² of what it says against what they expect, of `freedom` combinations."""

    flight: int
    chi2: float
    freedom: int


@dataclass(frozen=True)
class Pooled:
    """What all flights of a unit say together; the state is constants at the reference temperature, then slopes, then
    rates of those that drift steadily, which are as of the last session, then coefficients of the square of temperature
    of those `bent`."""

    names: tuple[Name, ...]
    sloped: tuple[int, ...]
    drifting: tuple[int, ...]
    chain: Chain
    raw: tuple[Known, ...]
    """What each flight says, of the state."""
    unit: Unit
    scatter: Array
    steps: tuple[Step, ...] = ()
    left_out: tuple[LeftOut, ...] = field(default=())
    bent: tuple[int, ...] = ()

    def at(self, day: float | None = None) -> Estimate:
        """Constants and slopes, at the last session unless a day is given."""
        last = float(self.unit.day[-1])
        known = self.chain.at(last if day is None else day)
        if self.drifting and day is not None:
            back = np.eye(len(self.scatter))
            back[self.drifting, self._rates] = last - day
            known = Known(back.T @ known.information @ back, back.T @ known.right)
        return known.estimate()

    @property
    def _rates(self) -> np.ndarray:
        """Where the state has the rates of those that drift."""
        return len(self.names) + len(self.sloped) + np.arange(len(self.drifting))

    def bend_at(self, place: int) -> int | None:
        """Where the state has the bend of a constant; None of one that is straight."""
        return len(self.scatter) - len(self.bent) + self.bent.index(place) if place in self.bent else None

    def bend_of(self) -> Array:
        """Coefficient of the square of temperature of each constant (p,), 0 of one that is straight."""
        out, state = np.zeros(len(self.names)), self.at().state
        for place in self.bent:
            out[place] = np.nan_to_num(state[self.bend_at(place)])
        return out

    def rates(self) -> list[Coefficient | None]:
        """What is known of each constant's steady change a day, beside its walk: of those that drift by the state, of
        another as if it alone did; None where nothing is."""
        p, last, now = len(self.names), float(self.unit.day[-1]), self.at()
        out: list[Coefficient | None] = [None] * p
        for place, at in zip(self.drifting, self._rates, strict=True):
            if np.isfinite(now.covariance[at, at]) and now.covariance[at, at] > 0.0:
                out[place] = Coefficient(float(now.state[at]), float(np.sqrt(now.covariance[at, at])))
        others = [place for place in range(p) if place not in self.drifting]
        by_day = np.eye(len(self.scatter))[:, others]
        sessions = [
            _with_more(own, by_day * (day - last)) for day, own in zip(self.chain.day, self.chain.own, strict=True)
        ]
        for i, told in self._each_alone(sessions).items():
            out[others[i]] = told
        return out

    def bends(self) -> dict[int, Coefficient]:
        """What is known, by place, of the coefficient of the square of temperature of each zero that is straight in the
        state, as if it alone were bent."""
        others = [place for place in self.sloped if self.names[place][1] == BENDING and place not in self.bent]
        level = np.eye(len(self.scatter))[:, others]
        slope = np.eye(len(self.scatter))[:, [len(self.names) + self.sloped.index(place) for place in others]]
        scatter = np.r_[self.scatter, np.zeros(len(others))]
        out, usual = {one.flight for one in self.left_out}, usual_warmth(self.unit)
        sessions = [Known.nothing(len(scatter)) for _ in self.unit.day]
        for k, flight in enumerate(self.unit.flights):
            if k not in out:
                # The tangent of w²: 2 w more of slope, and w² less of what it is at the reference.
                w = usual if flight.warmth_degc is None else flight.warmth_degc
                own = _with_more(self.raw[k], 2.0 * w * slope - w**2 * level)
                sessions[flight.session] = sessions[flight.session] + own
        told = self._each_alone([known.loosened(scatter) for known in sessions])
        return {others[i]: one for i, one in told.items()}

    def _each_alone(self, sessions: Sequence[Known]) -> dict[int, Coefficient]:
        """Of coefficients that stand behind the state in what sessions say: each by its number as if it alone were
        there, where anything is known."""
        d = len(self.scatter)
        known, none = Known.nothing(len(sessions[0].right)), np.zeros(len(sessions[0].right) - d)
        known.information[:d, :d], known.right[:d] = self.chain.before[0].information, self.chain.before[0].right
        for k, own in enumerate(sessions):
            if k:
                gap = self.chain.walk * (self.chain.day[k] - self.chain.day[k - 1]) + self.chain.jump[k - 1]
                known = known.loosened(np.r_[gap, none])
            known = known + own
        n, g = known.information, known.right
        size = np.sqrt(np.maximum(np.diagonal(n)[:d], 1e-300))
        inverse = np.linalg.pinv(n[:d, :d] / np.outer(size, size), rcond=1e-10, hermitian=True)
        beside = n[d:, :d] / size
        alone = np.diagonal(n)[d:]
        information = alone - np.einsum("ij,jk,ik->i", beside, inverse, beside)
        right = g[d:] - beside @ inverse @ (g[:d] / size)
        return {
            int(i): Coefficient(float(right[i] / information[i]), float(1.0 / np.sqrt(information[i])))
            for i in np.flatnonzero(information > 1e-9 * alone)
        }

    def combination(self, place: int, warmth_degc: float = 0.0) -> Array:
        """That of the state (d,) which is constant `place` at a temperature."""
        out = np.zeros(len(self.scatter))
        out[place] = 1.0
        if place in self.sloped:
            out[len(self.names) + self.sloped.index(place)] = warmth_degc
        if (bend := self.bend_at(place)) is not None:
            out[bend] = warmth_degc**2
        return out

    def last_z(self) -> Array:
        """Of each constant (p,): the last session's distance from what all others say of it, in sd; NaN where either
        says nothing."""
        last = len(self.unit.day) - 1
        own = sum((k for k, f in zip(self.raw, self.unit.flights, strict=True) if f.session == last), self._nothing())
        others = self.chain.others(last).loosened(self.scatter)
        before, after = others.estimate(), (others + own).estimate()
        p = len(self.names)
        variance = np.diagonal(before.covariance)[:p]
        with np.errstate(invalid="ignore", divide="ignore"):
            gained = variance - np.diagonal(after.covariance)[:p]
            known = np.isfinite(gained) & (gained > LEAST_SHARE * variance)
            return np.where(known, (after.state - before.state)[:p] / np.sqrt(gained), np.nan)

    def _nothing(self) -> Known:
        return Known.nothing(len(self.scatter))

    def expected(self, flight: int) -> Known:
        """What all other flights say of the constants as this one met them."""
        session = self.unit.flights[flight].session
        known = self.chain.others(session).loosened(self.scatter)
        out = {one.flight for one in self.left_out}
        for k, other in enumerate(self.unit.flights):
            if other.session == session and k != flight and k not in out:
                known = known + self.raw[k]
        return known

    def contributions(self) -> Array:
        """Of each flight and constant (n, p): the share of what is known of it then that would not be known without."""
        share = np.zeros((len(self.raw), len(self.names)))
        for k, own in enumerate(self.raw):
            if k in {one.flight for one in self.left_out}:
                continue
            others = self.expected(k)
            before, together = (np.diagonal(x.estimate().covariance)[: len(self.names)] for x in (others, others + own))
            known = np.isfinite(together)
            share[k, known] = 1.0 - np.where(np.isfinite(before[known]), together[known] / before[known], 0.0)
        return share


Kinds = Mapping[tuple[str, str], Strengths]
"""Strengths by sensor and parameter."""


def usual_warmth(unit: Unit) -> float:
    """Of a flight whose temperature nobody knows."""
    known = [flight.warmth_degc for flight in unit.flights if flight.warmth_degc is not None]
    return float(np.mean(known)) if known else 0.0


def state_of(
    flight: Flight,
    names: tuple[Name, ...],
    sloped: tuple[int, ...],
    usual_degc: float,
    drifting: tuple[int, ...] = (),
    days: float = 0.0,
    bent: tuple[int, ...] = (),
) -> Known:
    """A flight's equations as those of the state: the constants at its temperature are constants plus slopes, those
    `bent` plus bends, and `days` after the last session those that drift plus rates."""
    own = flight.equations
    warmth = usual_degc if flight.warmth_degc is None else flight.warmth_degc
    p, s, d = len(names), len(sloped), len(drifting)
    design = np.zeros((len(own.names), p + s + d + len(bent)))
    for row, name in enumerate(own.names):
        of_slope = name[1] in OF_SLOPE
        place = names.index((name[0], OF_SLOPE.get(name[1], name[1]), name[2]))
        if place in sloped:
            design[row, p + sloped.index(place)] = 1.0 if of_slope else warmth
        if place in bent:
            design[row, p + s + d + bent.index(place)] = 2.0 * warmth if of_slope else warmth**2
        if not of_slope:
            design[row, place] = 1.0
            if place in drifting:
                design[row, p + s + drifting.index(place)] = days
    right = own.right + own.information @ own.reference
    return Known(design.T @ own.information @ design, design.T @ right)


def _with_more(known: Known, columns: Array) -> Known:
    """Of a state with coefficients more, each of which adds `columns` (d, n) of it."""
    design = np.hstack([np.eye(len(columns)), columns])
    return Known(design.T @ known.information @ design, design.T @ known.right)


def smoothed(
    unit: Unit,
    kinds: Kinds,
    steps: tuple[Step, ...],
    left_out: tuple[LeftOut, ...],
    drifting: tuple[int, ...],
    bent: tuple[int, ...] = (),
) -> Pooled:
    """A unit's flights with these steps, without those left out; constants `drifting` have rates in the state, those
    `bent` bends, of which nothing is known beforehand."""
    names, sloped = unit.names, tuple(k for k, name in enumerate(unit.names) if name[1] in SLOPED)
    usual, last = usual_warmth(unit), float(unit.day[-1])
    raw = tuple(
        state_of(flight, names, sloped, usual, drifting, float(unit.day[flight.session]) - last, bent)
        for flight in unit.flights
    )
    strengths = [kinds[name[:2]] for name in names]
    more = np.zeros(len(drifting) + len(bent))
    nothing = np.r_[np.zeros(len(sloped)), more]
    scatter = np.r_[[s.scatter for s in strengths], nothing]
    walk = np.r_[[s.walk for s in strengths], nothing]
    variance = np.array([strengths[k].slope for k in sloped])
    flat = np.divide(1.0, variance, out=np.zeros(len(sloped)), where=variance > 0.0)
    first = Known.nothing(len(scatter))
    np.fill_diagonal(first.information, np.r_[np.zeros(len(names)), flat, more])
    jump = np.zeros((len(unit.day) - 1, len(scatter)))
    for step in steps:
        jump[step.after - 1, names.index(step.name)] = np.inf
    out = {one.flight for one in left_out}
    sessions = [Known.nothing(len(scatter)) for _ in unit.day]
    for k, flight in enumerate(unit.flights):
        if k not in out:
            sessions[flight.session] = sessions[flight.session] + raw[k]
    own = [known.loosened(scatter) for known in sessions]
    chain = Chain.of(unit.day, own, walk, jump, first)
    return Pooled(names, sloped, drifting, chain, raw, unit, scatter, steps, left_out, bent)


def different_degrees(warmth_degc: Iterable[float]) -> int:
    """Temperatures that are different by whole degrees: several sessions at one tell one value of a curve."""
    return len({round(float(one)) for one in warmth_degc})
