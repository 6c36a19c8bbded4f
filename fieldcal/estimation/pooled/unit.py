"""The flights of one unit pooled: sessions in order of time, steps where they are, flights left out that contradict."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from fieldcal.estimation.normal_equations import Name, NormalEquations
from fieldcal.estimation.pooled.chain import Chain, Estimate, Known
from fieldcal.estimation.pooled.chance import log_beyond, log_beyond_either_way
from fieldcal.estimation.pooled.strengths import Series, Strengths, is_bent, strengths_of
from fieldcal.geometry.rotation import Array

SLOPED = ("gain", "zero")
"""Constants that depend on temperature."""
OF_SLOPE = {"zero_per_degc": "zero"}
"""Parameters of a flight that are slopes of a constant."""
BENDING = "zero"
"""The parameter that may depend on temperature by more than a straight line."""
FALSE_ALARMS = 0.003
"""Chance that a unit without any has a step, and that it has a flight left out."""
FEWEST_TO_CONTRADICT, FEWEST_BESIDE_A_STEP, FEWEST_TO_DRIFT, FEWEST_TO_BEND = 3, 2, 5, 5
"""Sessions that it takes to say of one flight that it contradicts; of either side of a step; of a constant that it
drifts; at different temperatures, that it bends with temperature."""
LARGEST_LEFT_OUT = 0.2
"""Share of flights: where more contradict, nobody knows which."""
UNTESTABLE = 1e4
"""Variance of what others expect along a direction over a flight's own: beyond it the flight cannot contradict."""
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
class Rate:
    """What all sessions say of a steady change of one constant, beside its walk: `per_day` with sd `sd`."""

    per_day: float
    sd: float

    @property
    def z(self) -> float:
        return self.per_day / self.sd


@dataclass(frozen=True)
class Bend:
    """What all sessions say of a zero's coefficient of the square of temperature: `per_degc2` with sd `sd`."""

    per_degc2: float
    sd: float

    @property
    def z(self) -> float:
        return self.per_degc2 / self.sd


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

    def rates(self) -> list[Rate | None]:
        """What is known of each constant's steady change: of those that drift by the state, of another as if it alone
        did; None where nothing is."""
        p, last, now = len(self.names), float(self.unit.day[-1]), self.at()
        out: list[Rate | None] = [None] * p
        for place, at in zip(self.drifting, self._rates, strict=True):
            if np.isfinite(now.covariance[at, at]) and now.covariance[at, at] > 0.0:
                out[place] = Rate(float(now.state[at]), float(np.sqrt(now.covariance[at, at])))
        others = [place for place in range(p) if place not in self.drifting]
        by_day = np.eye(len(self.scatter))[:, others]
        sessions = [
            _with_more(own, by_day * (day - last)) for day, own in zip(self.chain.day, self.chain.own, strict=True)
        ]
        for i, told in self._each_alone(sessions).items():
            out[others[i]] = Rate(*told)
        return out

    def bends(self) -> dict[int, Bend]:
        """What is known, by place, of the bend of each zero that is straight in the state, as if it alone were bent."""
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
        return {others[i]: Bend(*one) for i, one in told.items()}

    def _each_alone(self, sessions: Sequence[Known]) -> dict[int, tuple[float, float]]:
        """Of coefficients that stand behind the state in what sessions say: each by its number as if it alone were
        there, (value, sd), where anything is known."""
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
            int(i): (float(right[i] / information[i]), float(1.0 / np.sqrt(information[i])))
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


def pool(unit: Unit, kinds: Kinds, *, tested: bool = True) -> Pooled:
    """Smooth a unit's flights; `tested`: look for steps, steady drifts, bends with temperature and for flights that
    contradict the others, the surest first, until there is none."""
    freedom = np.array([kinds[name[:2]].freedom for name in unit.names])
    found = smoothed(unit, kinds, (), (), ())
    while tested:
        worst, step = _worst_flight(found, freedom), surest_step(found, freedom)
        drift, bend = surest_drift(found, freedom), surest_bend(found, freedom)
        surest = min((one[0] for one in (worst, step, drift, bend) if one is not None), default=None)
        if surest is None:
            break
        steps, left_out, drifting, bent = found.steps, found.left_out, found.drifting, found.bent
        if step is not None and step[0] == surest:
            steps = (*steps, step[1])
        elif drift is not None and drift[0] == surest:
            drifting = (*drifting, drift[1])
        elif bend is not None and bend[0] == surest:
            bent = (*bent, bend[1])
        elif worst is not None:
            left_out = (*left_out, worst[1])
        found = smoothed(unit, kinds, steps, left_out, drifting, bent)
    return found


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


def _worst_flight(found: Pooled, freedom: Array) -> tuple[float, LeftOut] | None:
    """The flight that contradicts the others most, if one does, and the logarithm of its chance."""
    flights = found.unit.flights
    out = {one.flight for one in found.left_out}
    left = [k for k in range(len(flights)) if k not in out]
    sessions = {flights[k].session for k in left}
    if len(sessions) < FEWEST_TO_CONTRADICT or len(out) + 1 > max(1.0, LARGEST_LEFT_OUT * len(flights)):
        return None
    tested = [(k, *contradiction(found.raw[k], found.expected(k))) for k in left]
    tested = [one for one in tested if one[2] > 0]
    if not tested:
        return None
    chi2, count = (np.array([one[i] for one in tested]) for i in (1, 2))
    chance = log_beyond(chi2 / count, count, float(np.median(freedom)))
    worst = int(np.argmin(chance))
    certain = chance[worst] < np.log(FALSE_ALARMS / len(flights))
    return (float(chance[worst]), LeftOut(*tested[worst])) if certain else None


def contradiction(own: Known, expected: Known) -> tuple[float, int]:
    """χ² of what a flight says against what is expected, and of how many combinations: those that both know."""
    scale = np.where(np.diagonal(own.information) > 0.0, 1.0, 0.0)
    size = np.sqrt(np.maximum(np.diagonal(own.information), 1e-300))
    value, vector = np.linalg.eigh(own.information / np.outer(size, size) * np.outer(scale, scale))
    seen = value > 1e-9
    if not seen.any():
        return 0.0, 0
    # Unit-variance readings A x of the flight; what is expected gives them a covariance, vague where nothing is known.
    reading = (vector[:, seen] * np.sqrt(value[seen])).T * size
    said = (vector[:, seen].T @ (own.right / size)) / np.sqrt(value[seen])
    vague = expected.information + np.diag(size**2 / UNTESTABLE**2)
    covariance = reading @ np.linalg.solve(vague, reading.T)
    error = said - reading @ np.linalg.solve(vague, expected.right)
    spread, axes = np.linalg.eigh(0.5 * (covariance + covariance.T))
    testable = spread < UNTESTABLE
    if not testable.any():
        return 0.0, 0
    z2 = (axes[:, testable].T @ error) ** 2 / (1.0 + np.maximum(spread[testable], 0.0))
    return float(z2.sum()), int(testable.sum())


def surest_step(found: Pooled, freedom: Array) -> tuple[float, Step] | None:
    """The surest step of a constant between two sessions, if there is one, and the logarithm of its chance."""
    chain, p = found.chain, len(found.names)
    boundaries = range(FEWEST_BESIDE_A_STEP, len(chain.day) - FEWEST_BESIDE_A_STEP + 1)
    if len(boundaries) == 0:
        return None
    size, information = np.zeros((2, len(boundaries), p))
    for row, k in enumerate(boundaries):
        variance = chain.walk * (chain.day[k] - chain.day[k - 1]) + chain.jump[k - 1]
        past = (chain.before[k - 1] + chain.own[k - 1]).loosened(variance)
        of_state = jumps(past, chain.after[k] + chain.own[k])
        size[row], information[row] = (x[:p] for x in of_state)
    z = size * np.sqrt(information)
    chance = log_beyond_either_way(z, freedom)
    row, i = (int(x) for x in np.unravel_index(int(np.argmin(chance)), chance.shape))
    if not chance[row, i] < np.log(FALSE_ALARMS / z.size):
        return None
    sd = float(1.0 / np.sqrt(information[row, i]))
    return float(chance[row, i]), Step(found.names[i], boundaries[row], float(size[row, i]), sd, float(z[row, i]))


def surest_drift(found: Pooled, freedom: Array) -> tuple[float, int] | None:
    """The constant whose steady change is the surest, if one's is and has moved it by more than a session scatters, and
    the logarithm of its chance."""
    informed = sum(bool(own.information.any()) for own in found.chain.own)
    if informed < FEWEST_TO_DRIFT:
        return None
    length = float(found.unit.day[-1] - found.unit.day[0])
    chances = [
        (float(log_beyond_either_way(rate.z, freedom[place])), place)
        for place, rate in enumerate(found.rates())
        if rate is not None and place not in found.drifting
        if abs(rate.per_day) * length > np.sqrt(found.scatter[place])
    ]
    surest = min(chances, default=None)
    return surest if surest is not None and surest[0] < np.log(FALSE_ALARMS / len(found.names)) else None


def surest_bend(found: Pooled, freedom: Array) -> tuple[float, int] | None:
    """The zero whose bend with temperature is the surest, if one's is and has it, amid the temperatures flown, further
    from the straight line between their ends than a session scatters, and the logarithm of its chance."""
    out = {one.flight for one in found.left_out}
    flown = [
        (flight.session, flight.warmth_degc)
        for k, flight in enumerate(found.unit.flights)
        if k not in out and flight.warmth_degc is not None and found.raw[k].information.any()
    ]
    if _different(dict(flown).values()) < FEWEST_TO_BEND:
        return None
    half = 0.5 * float(np.ptp([warmth for _, warmth in flown]))
    bends = found.bends()
    chances = [
        (float(log_beyond_either_way(bend.z, freedom[place])), place)
        for place, bend in bends.items()
        if abs(bend.per_degc2) * half**2 > np.sqrt(found.scatter[place])
    ]
    surest, zeros = min(chances, default=None), len(bends) + len(found.bent)
    return surest if surest is not None and surest[0] < np.log(FALSE_ALARMS / zeros) else None


def jumps(past: Known, future: Known) -> tuple[Array, Array]:
    """Of each element of the state alone: by how much it would have to be more in the future, (d,), and the information
    on that; what past and future do not share is no jump."""
    together = past + future
    size = np.sqrt(np.maximum(np.diagonal(together.information), 1e-300))
    inverse = np.linalg.pinv(together.information / np.outer(size, size), rcond=1e-10, hermitian=True)
    covariance = inverse / np.outer(size, size)
    n = future.information
    full = np.diagonal(n)
    information = full - np.einsum("ij,jk,ki->i", n, covariance, n)
    right = future.right - n @ covariance @ together.right
    information = np.where(information > 1e-9 * np.maximum(full, 1e-300), information, 0.0)
    return np.divide(right, information, out=np.zeros_like(right), where=information > 0.0), information


def strengths(units: Sequence[Unit], *, rounds: int = 2) -> dict[tuple[str, str], Strengths]:
    """How much each kind of constant moves, of all units: what sessions say of a constant, given what the others say
    of all others and less its bend, is a series of `strengths_of`. Coarse (`Strengths.coarse`)."""
    kinds = first_strengths(units)
    for _ in range(rounds):
        rows: dict[tuple[str, str], list[Array]] = {kind: [] for kind in kinds}
        within: dict[tuple[str, str], list[Array]] = {kind: [] for kind in kinds}
        for unit in units:
            found = pool(unit, kinds, tested=False)
            if bent := _bent_by_themselves(found):
                found = smoothed(unit, kinds, (), (), (), bent)
            for name, series, pairs in zip(found.names, series_of_sessions(found), within_sessions(found), strict=True):
                rows[name[:2]].append(series)
                within[name[:2]].append(pairs)
        kinds = {
            kind: strengths_of(
                Series.of([one for one in own if len(one)]),
                with_slope=kind[1] in SLOPED,
                within=np.concatenate(within[kind]),
            )
            for kind, own in rows.items()
        }
    return {kind: strengths.coarse() for kind, strengths in kinds.items()}


def first_strengths(units: Sequence[Unit]) -> dict[tuple[str, str], Strengths]:
    """To begin with: constants scatter as a flight alone sees them, and change by as much over a degree."""
    own: dict[tuple[str, str], list[float]] = {}
    for unit in units:
        for flight in unit.flights:
            for name, information in zip(
                flight.equations.names, np.diagonal(flight.equations.information), strict=True
            ):
                if name[1] not in OF_SLOPE and information > 0.0:
                    own.setdefault(name[:2], []).append(1.0 / float(information))
    kinds = {kind: Strengths(0.0, float(np.median(v)), float(np.median(v))) for kind, v in own.items()}
    return {name[:2]: kinds.get(name[:2], Strengths(0.0, 0.0, 0.0)) for unit in units for name in unit.names}


def _bent_by_themselves(found: Pooled) -> tuple[int, ...]:
    """Zeros that bend with temperature, whatever sessions scatter: a scatter that has the bends in it hides them."""
    series = series_of_sessions(found)
    return tuple(
        place
        for place in found.sloped
        if found.names[place][1] == BENDING
        and _different(series[place][:, 1]) >= FEWEST_TO_BEND
        and is_bent(series[place], float(found.scatter[place]))
    )


def _different(warmth_degc: Iterable[float]) -> int:
    """Temperatures that are different by whole degrees: several sessions at one tell one value of a curve."""
    return len({round(float(one)) for one in warmth_degc})


def series_of_sessions(found: Pooled) -> list[Array]:
    """Of each constant (sessions, 4): day, temperature less the reference, value there less its bend and its variance,
    as the session alone says where the other constants are what the other sessions say: what is known of the value with
    the session less what is without."""
    unit, bend = found.unit, found.bend_of()
    rows: list[list[tuple[float, ...]]] = [[] for _ in found.names]
    for session, day in enumerate(unit.day):
        at = [k for k, flight in enumerate(unit.flights) if flight.session == session]
        own = sum((found.raw[k] for k in at), Known.nothing(len(found.scatter)))
        warmth = [w for k in at if (w := unit.flights[k].warmth_degc) is not None]
        warmth_degc = float(np.mean(warmth)) if warmth else usual_warmth(unit)
        others = found.chain.others(session).loosened(found.scatter)
        before, together = others.estimate(), (others + own).estimate()
        for place in range(len(found.names)):
            if (said := said_beside(before, together, found.combination(place, warmth_degc))) is not None:
                rows[place].append((float(day), warmth_degc, said[0] - bend[place] * warmth_degc**2, said[1]))
    return [np.array(own).reshape(-1, 4) for own in rows]


def said_beside(before: Estimate, together: Estimate, combination: Array) -> tuple[float, float] | None:
    """(value, variance) that a part says of a combination of the state by itself, from what is known without it and
    with it; None where that is less than LEAST_SHARE of what is known."""
    (x, v), (x_others, v_others) = together.of(combination), before.of(combination)
    if not np.isfinite(v):
        return None
    known = 1.0 / v_others if np.isfinite(v_others) else 0.0
    information = 1.0 / v - known
    if information <= LEAST_SHARE / v:
        return None
    return (x / v - (x_others * known if known else 0.0)) / information, 1.0 / information


def within_sessions(found: Pooled) -> list[Array]:
    """Of each constant (k, 3): how two flights of a session, one after the other, differ in temperature and value less
    its bend, and the variance of that; the other constants as the other sessions and the one flight know them."""
    pairs: list[list[tuple[float, float, float]]] = [[] for _ in found.names]
    bend, last = found.bend_of(), dict[int, tuple[float, Array, Array]]()
    flown = [flight.session for flight in found.unit.flights]
    for k, flight in enumerate(found.unit.flights):
        if flight.warmth_degc is None or flown.count(flight.session) < 2:
            continue
        others = found.chain.others(flight.session).loosened(found.scatter)
        before, together = others.estimate(), (others + found.raw[k]).estimate()
        value, variance = np.full((2, len(found.names)), np.nan)
        for place in found.sloped:
            if (said := said_beside(before, together, found.combination(place, flight.warmth_degc))) is not None:
                value[place], variance[place] = said[0] - bend[place] * flight.warmth_degc**2, said[1]
        if flight.session in last:
            warmth, other, other_variance = last[flight.session]
            for at in np.flatnonzero(np.isfinite(value) & np.isfinite(other)):
                pairs[at].append(
                    (
                        flight.warmth_degc - warmth,
                        float(value[at] - other[at]),
                        float(variance[at] + other_variance[at]),
                    )
                )
        last[flight.session] = flight.warmth_degc, value, variance
    return [np.array(own).reshape(-1, 3) for own in pairs]
