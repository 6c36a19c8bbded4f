"""How much constants of a kind move, told by all units together: their sessions as the series of `strengths`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fieldcal.estimation.pooled.chain import Estimate, Known
from fieldcal.estimation.pooled.changes import FEWEST_TO_BEND, pool
from fieldcal.estimation.pooled.strengths import Series, Strengths, is_bent, strengths_of
from fieldcal.estimation.pooled.unit import (
    BENDING,
    LEAST_SHARE,
    OF_SLOPE,
    SLOPED,
    Pooled,
    Unit,
    different_degrees,
    smoothed,
    usual_warmth,
)
from fieldcal.geometry.rotation import Array


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
        and different_degrees(series[place][:, 1]) >= FEWEST_TO_BEND
        and is_bent(series[place], float(found.scatter[place]))
    )


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
