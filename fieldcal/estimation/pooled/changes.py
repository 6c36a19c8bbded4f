"""What is looked for beside the smoother: steps, steady drifts, bends with temperature, flights that contradict."""

from __future__ import annotations

import numpy as np

from fieldcal.estimation.pooled.chain import Known
from fieldcal.estimation.pooled.chance import log_beyond, log_beyond_either_way
from fieldcal.estimation.pooled.unit import (
    Kinds,
    LeftOut,
    Pooled,
    Step,
    Unit,
    different_degrees,
    smoothed,
)
from fieldcal.geometry.rotation import Array

FALSE_ALARMS = 0.002
"""Chance that a unit without any has a step; the same of a steady drift, of a bend, and of a flight left out: of the
four together below one per cent."""
FEWEST_TO_CONTRADICT, FEWEST_BESIDE_A_STEP, FEWEST_TO_DRIFT, FEWEST_TO_BEND = 3, 2, 5, 5
"""Sessions that it takes to say of one flight that it contradicts; of either side of a step; of a constant that it
drifts; at different temperatures, that it bends with temperature."""
LARGEST_LEFT_OUT = 0.2
"""Share of flights: where more contradict, nobody knows which."""
UNTESTABLE = 1e4
"""Variance of what others expect along a direction over a flight's own: beyond it the flight cannot contradict."""


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
        if abs(rate.value) * length > np.sqrt(found.scatter[place])
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
    if different_degrees(dict(flown).values()) < FEWEST_TO_BEND:
        return None
    half = 0.5 * float(np.ptp([warmth for _, warmth in flown]))
    bends = found.bends()
    chances = [
        (float(log_beyond_either_way(bend.z, freedom[place])), place)
        for place, bend in bends.items()
        if abs(bend.value) * half**2 > np.sqrt(found.scatter[place])
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
