"""Samples and rows of the joint estimate in C (`compiled/rows.c`): a model, its state and trajectory laid out for it.

What it computes, `measurement_model` and `covariance` define in NumPy; they call this where a kernel was compiled."""

from __future__ import annotations

import ctypes
from collections.abc import Mapping

import numpy as np

from fieldcal.compiled import flags, pointer, real, whole
from fieldcal.estimation.joint.chain_solver import RIGHTS, STATES, Normal, Probe
from fieldcal.estimation.joint.problem import (
    CROSS,
    OPTIONAL,
    Model,
    State,
    Trajectory,
    corrected,
    slow_rate,
    turning_at_rows,
)
from fieldcal.geometry.rotation import Array

MOST_PARAMETERS = 60  # of COLUMNS in rows.c, the residual and three columns of gyroscope noise beside them
Layout = Mapping[str, slice]


class _Triad(ctypes.Structure):
    _fields_ = [
        *[(name, ctypes.c_int64) for name in ("is_accelerometer", "column", "cross_column", "crosses")],
        *[(name, ctypes.c_int64) for name in ("delay_column", "dip_column", "arm_column")],
        *[(name, ctypes.c_void_p) for name in ("x", "raw", "valid", "cross", "constants", "delay", "slow_rate")],
        *[(name, ctypes.c_void_p) for name in ("field", "motion", "arm", "turning")],
        ("gravity", ctypes.c_double),
    ]


class _Record(ctypes.Structure):
    _fields_ = [
        *[(name, ctypes.c_int64) for name in ("samples", "rows", "knots", "vectors", "parameters", "gyroscope")],
        ("signals", ctypes.c_int64),
        *[(name, ctypes.c_void_p) for name in ("t", "q", "share", "index", "joined", "at", "signal", "which", "axis")],
        ("gain", ctypes.c_void_p),
        ("triad", _Triad * 2),
    ]


class _Laid:
    """A record for C, with the arrays that it points to kept alive."""

    def __init__(self, model: Model, p: int = 0) -> None:
        knots, n = model.knots, len(model.readings.t)
        if p > MOST_PARAMETERS:
            raise ValueError(f"The kernel has room for {MOST_PARAMETERS} parameters, not {p}.")
        self._kept: list[np.ndarray] = []
        self.record = _Record()
        self.record.samples, self.record.rows, self.record.knots = n, len(model.at), len(knots.index)
        self.record.vectors, self.record.parameters = len(model.vectors), p
        self.record.t = self.keep(real(model.readings.t, n))
        self.record.share = self.keep(real(knots.share, n))
        self.record.index = self.keep(whole(knots.index, len(knots.index)))
        self.record.joined = self.keep(flags(knots.joined, len(knots.index) - 1))
        self.record.at = self.keep(whole(model.at, len(model.at)))

    def keep(self, array: np.ndarray) -> ctypes.c_void_p:
        self._kept.append(array)
        return pointer(array)

    def __call__(self) -> ctypes.c_void_p:
        return ctypes.byref(self.record)  # type: ignore[return-value]


def trajectory(library: ctypes.CDLL, model: Model, state: State, rate: Array) -> tuple[Array, Array]:
    """Attitude (n, 4) and jumps (K−1, 3) from calibrated rates (n, 3), rad/s."""
    laid, n, k = _Laid(model), len(model.readings.t), len(model.knots.index)
    q, jump = np.empty((n, 4)), np.empty((k - 1, 3))
    given = real(rate, n, 3), real(state.q, k, 4)
    library.trajectory(laid(), *map(pointer, (*given, q, jump)))
    return q, jump


def residuals(library: ctypes.CDLL, model: Model, state: State, path: Trajectory) -> Array:
    """`measurement_model.residuals`."""
    laid = _laid_rows(model, state, path, {}, 0)
    out = np.empty((len(model.at), 3 * len(model.vectors)))
    library.residuals(laid(), pointer(out))
    return out


def normal_rows(
    library: ctypes.CDLL,
    normal: Normal,
    model: Model,
    state: State,
    path: Trajectory,
    layout: Layout,
    whitening: Array,
    probe: Probe,
    reaction: tuple[Array, Array],
    moved: Array,
) -> None:
    """Add every row to the normal equations, to `reaction` what reacts to the probes (`measurement_model.accumulate`),
    to `moved` (K, 3, p) the derivative of the integrated attitude at the end of each interval by θ."""
    p, m, k, r = len(normal.parameters), len(model.at), len(model.knots.index), 3 * len(model.vectors)
    laid = _laid_rows(model, state, path, layout, p)
    probed = real(reaction[0], k, 6, 2 * r + 3), real(reaction[1], p + 1, 2 * r + 3)
    ends = np.empty((k, 3, laid.record.gyroscope))
    given = real(whitening, m, r), real(probe.sensors, m, r), real(probe.bridge, m, 3), _room(laid, model)
    chain = (
        real(normal.diagonal, k, STATES, STATES), real(normal.below, k - 1, STATES, STATES),
        real(normal.right, k, STATES, p + len(RIGHTS)), real(normal.parameters, p, p),
        real(normal.parameters_right, p, len(RIGHTS)),
    )  # fmt: skip
    library.normal_rows(laid(), *map(pointer, (*given, *chain, *probed, ends)))
    moved[:, :, : laid.record.gyroscope] += ends


def covariance_rows(
    library: ctypes.CDLL,
    model: Model,
    state: State,
    path: Trajectory,
    layout: Layout,
    whitening: Array,
    response: Array,
) -> tuple[Array, Array, Array, Array]:
    """`covariance.sums_of_rows`: sensitivities (K, r + 3, p), residuals and counts (K, r + 3), scores (K, p)."""
    m, r, (k, _, p) = len(model.at), 3 * len(model.vectors), response.shape
    laid = _laid_rows(model, state, path, layout, p)
    out = np.zeros((k, r + 3, p)), np.zeros((k, r + 3)), np.zeros((k, r + 3)), np.zeros((k, p))
    ends = np.empty((3, laid.record.gyroscope))
    given = real(whitening, m, r), real(response, k, STATES, p), _room(laid, model), ends
    library.covariance_rows(laid(), *map(pointer, (*given, *out)))
    return out


def _room(laid: _Laid, model: Model) -> Array:
    """For the gyroscope's integrals at the rows of the interval that has most."""
    most = int(np.bincount(model.knots.of_sample[model.at]).max()) if len(model.at) else 1
    return np.empty((most, 3, laid.record.gyroscope))


def _laid_rows(model: Model, state: State, path: Trajectory, layout: Layout, p: int) -> _Laid:
    """A record with its rows; `layout` empty where no sensitivity is asked for."""
    laid = _Laid(model, p)
    record = laid.record
    record.q = laid.keep(real(path.q, record.samples, 4))
    if layout:
        _lay_gyroscope(laid, model, state, layout)
    for i, name in enumerate(model.vectors):
        _lay_triad(laid, record.triad[i], model, state, path, layout, name)
    return laid


def _lay_gyroscope(laid: _Laid, model: Model, state: State, layout: Layout) -> None:
    """The integrand of `_turned_by_gyroscope`: parameter j turns at gain_j signal_j about axis_j."""
    readings, record, scale = model.readings, laid.record, state.values["gyroscope"][:3]
    n = len(readings.t)
    signals = [corrected(model, state.values, "gyroscope"), np.ones((n, 1))]
    columns = [(i, i, 1.0) for i in range(3)] + [(i, 3, 1.0) for i in range(3)]  # axis, signal, gain
    at = 4
    for name in layout:  # the gyroscope's optional terms follow it, in this order
        if name == "gyroscope_cross":
            signals.append(model.triads["gyroscope"].x)
            columns += [(axis, at + other, scale[axis]) for axis, other in CROSS["gyroscope"]]
            at += 3
        elif name == "gyroscope_temperature":
            signals.append(np.zeros((n, 1)) if readings.warmth is None else readings.warmth[:, None])
            columns += [(axis, at, scale[axis]) for axis in range(3)]
            at += 1
        elif name == "gyroscope_g_sensitivity":
            signals.append(np.zeros((n, 3)) if readings.force is None else readings.force)
            columns += [(axis, at + other, scale[axis]) for axis in range(3) for other in range(3)]
            at += 3
    axis, which, gain = (np.array(x) for x in zip(*columns, strict=True))
    record.gyroscope, record.signals = len(columns), at
    record.signal = laid.keep(real(np.hstack(signals), n, at))
    record.axis, record.which = laid.keep(whole(axis, len(axis))), laid.keep(whole(which, len(which)))
    record.gain = laid.keep(real(gain, len(gain)))


def _lay_triad(
    laid: _Laid, out: _Triad, model: Model, state: State, path: Trajectory, layout: Layout, name: str
) -> None:
    m, values, triad = len(model.at), state.values, model.triads[name]

    def column(parameter: str) -> int:
        return layout[parameter].start if parameter in layout else -1

    out.is_accelerometer = name == "accelerometer"
    out.column, out.cross_column = column(name), column(f"{name}_cross")
    out.delay_column = column(f"{name}_delay")
    out.dip_column = -1 if out.is_accelerometer else column("dip")
    out.arm_column = column("lever_arm") if out.is_accelerometer else -1
    out.crosses = OPTIONAL[f"{name}_cross"]
    out.cross = laid.keep(whole(np.array(CROSS[name]), out.crosses, 2))
    out.x, out.raw = laid.keep(real(corrected(model, values, name), m, 3)), laid.keep(real(triad.x, m, 3))
    out.valid = laid.keep(flags(triad.valid, m))
    out.constants = laid.keep(real(values[name], 6))
    if f"{name}_delay" in values:
        out.delay = laid.keep(real(values[f"{name}_delay"], 1))
        out.slow_rate = laid.keep(real(slow_rate(model, path), m, 3))
    if not out.is_accelerometer:
        out.field = laid.keep(real(np.array(model.field(float(values["dip"][0]))), 2, 3))
        return
    out.gravity = model.readings.gravity_mps2
    out.motion = laid.keep(real(state.motion, len(model.knots.index), 9))
    out.arm = laid.keep(real(values["lever_arm"], 3))
    if values["lever_arm"].any() or out.arm_column >= 0:
        out.turning = laid.keep(real(np.stack(turning_at_rows(model, state)), 2, m, 3))
