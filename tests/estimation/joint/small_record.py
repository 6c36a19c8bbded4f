"""A record of two short stretches with everything in it (cross-axis terms, delays, temperature, specific force, lever
arm, translation, readings missing) made in closed form, and the joint estimate's model and true state of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fieldcal.estimation.joint.chain_solver import place_knots
from fieldcal.estimation.joint.problem import OPTIONAL, TRIADS, Centred, Model, Readings, State
from fieldcal.estimation.joint.variance_components import Levels
from fieldcal.geometry.rotation import Array, body_from_inertial, from_rotation_vector, multiply, skew

G = 9.81
ARM = np.array([0.05, 0.02, -0.03])
FIELD_NED = 0.5 * np.array([0.6, 0.2, 0.75])
VALUES = {
    "gyroscope": np.array([0.4, -0.5, 0.3, 0.02, -0.01, 0.03]),
    "accelerometer": np.array([5.0, 4.0, -6.0, 0.3, -0.5, 0.2]),
    "magnetometer": np.array([0.3, -0.2, 0.25, 0.05, -0.02, 0.03]),
    "gyroscope_cross": 0.03 * np.array([1.0, -1.0, 0.5, 0.7, -0.4, 0.9]),
    "gyroscope_temperature": np.array([0.01, -0.02, 0.03]),
    "gyroscope_g_sensitivity": 0.004 * np.arange(-4.0, 5.0),
    "accelerometer_delay": np.array([0.004]),
    "magnetometer_delay": np.array([-0.003]),
    "accelerometer_cross": 0.02 * np.array([1.0, -0.6, 0.8]),
    "magnetometer_cross": 0.02 * np.array([-1.0, 0.6, 0.8, 0.3, -0.7, 0.5]),
}
"""True constants, of x."""
PLACES = {
    "gyroscope": ((0, 1), (0, 2), (1, 0), (1, 2), (2, 0), (2, 1)),
    "accelerometer": ((1, 0), (2, 0), (2, 1)),
    "magnetometer": ((0, 1), (0, 2), (1, 0), (1, 2), (2, 0), (2, 1)),
}
CENTRE = {"gyroscope": np.array([3.0, -2.0, 1.0]), "accelerometer": np.zeros(3), "magnetometer": np.ones(3)}
SPREAD = {"gyroscope": np.array([0.5, 2.0, 4.0]), "accelerometer": np.ones(3), "magnetometer": np.full(3, 2.0)}
AXES = np.array([[0.6, 0.64, 0.48], [0.48, -0.6, 0.64]])  # of turning, sensor axes, in either stretch
START = np.array([[0.3, -0.4, 0.5], [-0.6, 0.2, 1.0]])  # rotation vectors


def attitude(stretch: int, t: Array) -> Array:
    return multiply(
        from_rotation_vector(START[stretch]), from_rotation_vector(np.sin(1.9 * t)[:, None] * AXES[stretch])
    )


def mixed(name: str, cross: Array) -> Array:
    """I + E."""
    out = np.eye(3)
    for value, place in zip(cross, PLACES[name], strict=True):
        out[place] = value
    return out


@dataclass(frozen=True)
class Small:
    """`q`, `rate` (n, ·) are the truth at every sample."""

    model: Model
    state: State
    levels: Levels
    q: Array
    rate: Array


def small(
    terms: Sequence[str] = (),
    *,
    sign: float = 1.0,
    lever_arm: Array | None = ARM,
    translation_mps2: float = 0.5,
    vectors: Sequence[str] = TRIADS[1:],
    rate_hz: float = 200.0,
    spacing_s: float = 0.08,
    missing: bool = True,
) -> Small:
    """With these optional terms. `sign` of gravity; two stretches of 0.63 s and 0.41 s, half a second apart."""
    lengths = round(0.63 * rate_hz), round(0.41 * rate_hz)
    segment = np.repeat([0, 1], lengths)
    t = (np.arange(len(segment)) + 0.2 * np.sin(np.arange(len(segment)))) / rate_hz + 0.5 * segment
    knots = place_knots(t, segment, spacing_s)
    k = len(knots.index)
    rng = np.random.default_rng(5)
    motion = translation_mps2 * rng.normal(size=(k, 9))
    values = {name: VALUES[name].copy() for name in ("gyroscope", *vectors, *terms)}
    values["dip"] = np.arctan2([FIELD_NED[2]], [np.hypot(*FIELD_NED[:2])])
    values["lever_arm"] = np.zeros(3) if lever_arm is None else lever_arm
    q = np.concatenate([attitude(s, t[segment == s]) for s in (0, 1)])
    swing = 1.9 * np.cos(1.9 * t)[:, None]
    rate, change = swing * AXES[segment], -(1.9**2) * np.sin(1.9 * t)[:, None] * AXES[segment]
    warmth, force = np.linspace(-2.0, 3.0, len(t)), np.sin(np.outer(t, [3.0, 4.0, 5.0]))

    def at(late_s: float) -> Array:
        return body_from_inertial(np.concatenate([attitude(s, t[segment == s] - late_s) for s in (0, 1)]))

    moved = np.empty((len(t), 3))
    for s in (0, 1):
        own, here = knots.index[segment[knots.index] == s], segment == s
        which = np.isin(knots.index, own)
        moved[here] = np.stack([np.interp(t[here], t[own], a[which]) for a in motion[:, 3:6].T], axis=1)

    def late(name: str) -> float:
        return float(values.get(f"{name}_delay", np.zeros(1))[0])

    about = np.einsum("nij,j->ni", skew(change) + skew(rate) @ skew(rate), values["lever_arm"])
    down = np.einsum("nij,nj->ni", at(late("accelerometer")), np.array([0.0, 0.0, G]) - moved)
    sensed = {
        "gyroscope": rate,
        "accelerometer": sign * (down - about),
        "magnetometer": at(late("magnetometer")) @ FIELD_NED,
    }
    triads = {}
    for name in ("gyroscope", *vectors):
        x = (sensed[name] - values[name][3:]) / values[name][:3]
        if f"{name}_temperature" in values:
            x = x - warmth[:, None] * values[f"{name}_temperature"]
        if f"{name}_g_sensitivity" in values:
            x = x - force @ values[f"{name}_g_sensitivity"].reshape(3, 3).T
        if f"{name}_cross" in values:
            x = np.linalg.solve(mixed(name, values[f"{name}_cross"]), x.T).T
        valid = np.ones(len(t), dtype=bool)
        if missing and name != "gyroscope":
            valid[{"accelerometer": [5, 6, 40], "magnetometer": [90, *range(140, 145)]}[name]] = False
        triads[name] = Centred(np.where(valid[:, None], x, 0.0), valid, CENTRE[name], SPREAD[name])
    logged = {name: CENTRE[name] + SPREAD[name] * own.x for name, own in triads.items()}
    spread = SPREAD["gyroscope"] / VALUES["gyroscope"][:3]
    turning = np.stack([CENTRE["gyroscope"] + spread * (rate - VALUES["gyroscope"][3:]), spread * change])
    readings = Readings(
        t=t, segment=segment, gyroscope=logged["gyroscope"], accelerometer=logged.get("accelerometer"),
        magnetometer=logged.get("magnetometer"), gravity_mps2=sign * G, field_ned=FIELD_NED, turning=turning,
        warmth=warmth, force=force,
    )  # fmt: skip
    model = Model(readings, triads, knots, tuple(vectors), np.arange(len(t)))
    r = 3 * len(vectors)
    levels = Levels(np.linspace(0.5, 1.5, r) * 1e-2, np.linspace(1.0, 2.0, r), np.ones(r), 2e-4, 0.7)
    return Small(model, State(q[knots.index], motion, values), levels, q, rate)


def moved(state: State, name: str, by: Array) -> State:
    """One parameter changed."""
    return replace(state, values={**state.values, name: state.values[name] + by})


def size_of(name: str) -> int:
    return {"dip": 1, "lever_arm": 3, **OPTIONAL}.get(name, 6)
