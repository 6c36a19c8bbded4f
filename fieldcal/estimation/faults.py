"""Faults that the readings of a triad show without a fit: dead, stuck, clipped or random channels, a wrong unit.

Every check is a number against a limit. Limits are wide: what passes here may still be refused by the fits, but what
fails here is not worth a fit. Readings are as logged, (n, 3); stamps in seconds, increasing.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fieldcal.estimation.segments import run_starts
from fieldcal.geometry.rotation import Array
from fieldcal.names import Json
from fieldcal.reason_codes import ReasonCode

AXES = "xyz"
FEWEST_SAMPLES = 10
"""Fewer readings are not checked."""

STUCK_S = 1.0
"""A working channel changes within a second."""

STUCK_RATIO = 50.0
"""A stuck channel holds a value so many times longer than it does otherwise (99th percentile of holding times …"""

HOLDS_LEFT_OUT = 10
"""… without so many of the longest, which may be those of a stuck channel)."""

COARSE_SHARE = 0.1
"""Largest step of a channel's resolution, as a share of its standard deviation: errors of one per cent."""

DITHERED_SHARE = 0.3
"""Share of successive readings that differ where noise spreads them over steps."""

ROUNDING_SHARE = 1e-9
"""Steps below this share of a channel's largest value are rounding of floating point."""

STILL_STEPS = 2.0
"""Steps of its resolution that an axis may take while the sensor lies still."""

STUCK_SHARE = 0.02
"""Share of the recording that may be stuck."""

CLIPPED_RATIO = 3.0
"""A rail holds so many times the samples of the three levels before it together; a smooth peak holds as many."""

CLIPPED_SAMPLES = 10
"""Fewer samples at an extreme value show no rail."""

CLIPPED_SHARE = 1e-3
"""Share of samples at a rail beyond which a fit is biased."""

CLIPPED_LEVELS = 20
"""Fewer different values show no rail."""

WHITE_RATIO = 0.8
"""Successive readings of a moving body resemble each other: variance of their differences over twice the variance."""

LARGEST_NOISE_SI = {"gyroscope": 5.0, "accelerometer": 20.0}
"""Standard deviation, rad/s and m/s², beyond which noise is no sensor's."""

MPS2_UNITS = {"m/s^2": 1.0, "g": 9.80665, "mg": 9.80665e-3, "cm/s^2": 0.01}
"""Units that an accelerometer's readings may be in, in m/s²."""

GRAVITY_RATIO = (0.5, 2.0)
"""Median length of specific force over gravity in any flight that is not a fall or a launch."""

FIELD_RATIO = (0.1, 8.0)
"""Median length of the logged field over the local one: hard iron may be several times the field."""

EARTH_FIELD_T = 45e-6
FASTEST_RADPS = 70.0
"""Twice the widest range of common gyroscopes (2000 °/s)."""

RATE_WINDOW_S, RATE_WINDOW_SAMPLES = 5.0, 10
RATE_CHANGE_RATIO = 1.3
"""Fastest over slowest sampling rate, each the median of a window with so many samples at least."""

DROPOUT_INTERVALS, LONGEST_DROPOUT_S = 1.5, 1.0
"""Samples are missing where stamps are further apart; longer ones are pauses, which ingest reports."""

DROPOUT_SHARE = 1e-3
"""Share of missing samples beyond which dropouts are reported."""


@dataclass(frozen=True)
class Fault:
    """One thing that is wrong with a channel or triad: `value` against `limit`. `fatal`: no fit may use the triad."""

    sensor: str
    axis: str
    code: ReasonCode
    value: float
    limit: float
    fatal: bool
    sentence: str

    def plain(self) -> dict[str, Json]:
        """Plain JSON."""
        return asdict(self)


def channel_faults(sensor: str, t: ArrayLike, logged: ArrayLike, unit: str, si_scale: float | None) -> list[Fault]:
    """Dead, stuck, clipped and random channels of one triad.

    Parameters
    ----------
    sensor : str
        "gyroscope", "accelerometer" or "magnetometer".
    t : (n,) array
        Stamps, s.
    logged : (n, 3) array
        Readings; n ≥ FEWEST_SAMPLES.
    unit : str
        Unit of the readings, for sentences.
    si_scale : float or None
        From the logged unit to rad/s or m/s²; None for counts and magnetometers.
    """
    t, x = np.asarray(t, dtype=float), np.asarray(logged, dtype=float)
    faults = []
    for i, axis in enumerate(AXES):
        dead = _dead(sensor, axis, x[:, i], unit)
        if dead is not None:
            faults.append(dead)
            continue
        beside = np.delete(x, i, axis=1)
        found = _stuck(sensor, axis, t, x[:, i], beside, unit), _clipped(sensor, axis, x[:, i], unit)
        faults += [fault for fault in found if fault is not None]
        if si_scale is not None and sensor in LARGEST_NOISE_SI:
            random = _random(sensor, axis, x[:, i] * si_scale, LARGEST_NOISE_SI[sensor])
            faults += [random] if random else []
    return faults


def _dead(sensor: str, axis: str, x: Array, unit: str) -> Fault | None:
    if np.ptp(x) > 0:
        return None
    code = ReasonCode.ALL_ZERO if x[0] == 0 else ReasonCode.STUCK
    sentence = f"The {sensor}'s {axis} reads {x[0]:.6g} {unit} in all {len(x)} samples: it is dead or not connected."
    return Fault(sensor, axis, code, 1.0, STUCK_SHARE, True, sentence)


def _stuck(sensor: str, axis: str, t: Array, x: Array, beside: Array, unit: str) -> Fault | None:
    """A value that is held for far longer than the channel holds values otherwise, unless the axes `beside` (n, 2) show
    a coarse sensor that lies still."""
    start = _unbroken_starts(t, x)
    end = np.r_[start[1:], len(x)] - 1
    held = t[end] - t[start]
    usual = float(np.quantile(np.sort(held)[: max(1, len(held) - HOLDS_LEFT_OUT)], 0.99))
    limit = max(STUCK_S, STUCK_RATIO * usual)
    stuck = held > limit
    step = np.array([resolution(column) for column in beside.T])
    for k in np.flatnonzero(stuck):
        moved = np.ptp(beside[start[k] : end[k] + 1], axis=0)
        # All axes without any change at all: the logger froze.
        stuck[k] = bool(np.any(moved > STILL_STEPS * step) or not moved.any())
    if not stuck.any():
        return None
    share, longest = float(held[stuck].sum() / (t[-1] - t[0])), int(np.argmax(held * stuck))
    sentence = (
        f"The {sensor}'s {axis} stands at {x[start[longest]]:.6g} {unit} for {held[longest]:.1f} s"
        f" ({100 * share:.1f} % of the recording in all) where it else changes within {usual:.3g} s: it was stuck."
    )
    return Fault(sensor, axis, ReasonCode.STUCK, share, STUCK_SHARE, share > STUCK_SHARE, sentence)


def _unbroken_starts(t: Array, x: Array) -> np.ndarray:
    """Where runs of one value begin; none runs on through a pause: nobody knows what was there meanwhile."""
    interval = np.diff(t)
    pause = interval > max(STUCK_S, DROPOUT_INTERVALS * float(np.median(interval)))
    begins = np.zeros(len(x), dtype=bool)
    begins[run_starts(x)] = True
    begins[1:] |= pause
    return np.flatnonzero(begins)


def resolution(x: Array) -> float:
    """Least step between different values of a channel (n,), rounding of floating point apart; 0 with one value."""
    levels = np.unique(x)
    steps = np.diff(levels)
    steps = steps[steps > ROUNDING_SHARE * np.max(np.abs(levels), initial=0.0)]
    return float(steps.min(initial=np.inf)) if len(steps) else 0.0


def coarse_faults(sensor: str, logged: ArrayLike, unit: str) -> list[Fault]:
    """Axes of readings (n, 3) so coarse that their rounding, which goes with the motion, is no noise."""
    faults = []
    for axis, x in zip(AXES, np.asarray(logged, dtype=float).T, strict=True):
        step, spread = resolution(x), float(np.std(x))
        # Noise of a step or so makes rounding white: then it is noise like any other.
        dithered = float(np.mean(np.diff(x) != 0.0)) > DITHERED_SHARE
        if step > COARSE_SHARE * spread > 0.0 and not dithered:
            sentence = (
                f"The {sensor}'s {axis} is logged in steps of {step:.3g} {unit} where it varies by {spread:.3g} {unit}"
                " rms: rounding of a tenth and more goes with the motion and is no noise."
            )
            faults.append(Fault(sensor, axis, ReasonCode.COARSE, step / spread, COARSE_SHARE, True, sentence))
    return faults


def _clipped(sensor: str, axis: str, x: Array, unit: str) -> Fault | None:
    """A rail: an extreme value that is met far more often than the values just before it."""
    levels, counts = np.unique(x, return_counts=True)
    if len(levels) < CLIPPED_LEVELS:
        return None
    ends = ((levels[-1], counts[-1], counts[-4:-1]), (levels[0], counts[0], counts[1:4]))
    rails = [(level, n) for level, n, before in ends if n >= CLIPPED_SAMPLES and n > CLIPPED_RATIO * before.sum()]
    if not rails:
        return None
    at = int(sum(n for _, n in rails))
    share = at / len(x)
    where = " and ".join(f"{level:.6g} {unit}" for level, _ in rails)
    sentence = f"The {sensor}'s {axis} is clipped at {where}: {at} of {len(x)} samples ({100 * share:.2f} %)."
    return Fault(sensor, axis, ReasonCode.SATURATED, share, CLIPPED_SHARE, share > CLIPPED_SHARE, sentence)


def _random(sensor: str, axis: str, x: Array, loud: float) -> Fault | None:
    """Successive readings that are uncorrelated and scatter far more than any sensor's noise."""
    spread = float(np.std(x))
    ratio = float(np.mean(np.diff(x) ** 2) / (2.0 * spread**2))
    if spread < loud or ratio < WHITE_RATIO:
        return None
    sentence = (
        f"The {sensor}'s {axis} is noise: its readings scatter by {spread:.3g} (SI) and successive ones are unrelated"
        f" (ratio {ratio:.2f}; a moving body shows below {WHITE_RATIO})."
    )
    return Fault(sensor, axis, ReasonCode.RANDOM, ratio, WHITE_RATIO, True, sentence)


def accelerometer_unit(logged: ArrayLike, unit: str, in_mps2: float, gravity_mps2: float) -> Fault | None:
    """Whether the length of specific force, (n, 3) readings in `unit` (`in_mps2` m/s²), can be gravity's."""
    length = float(np.median(np.linalg.norm(np.asarray(logged, dtype=float), axis=1)))
    ratio = length * in_mps2 / gravity_mps2
    if GRAVITY_RATIO[0] <= ratio <= GRAVITY_RATIO[1]:
        return None
    return _unit_fault("accelerometer", unit, length, ratio, GRAVITY_RATIO, MPS2_UNITS, gravity_mps2, "gravity")


def magnetometer_unit(logged: ArrayLike, unit: str, in_tesla: float, field_t: float | None) -> Fault | None:
    """Whether the length of the field, (n, 3) readings in `unit` (`in_tesla` T), can be the local one (T) or the
    Earth's."""
    length = float(np.median(np.linalg.norm(np.asarray(logged, dtype=float), axis=1)))
    expected = field_t or EARTH_FIELD_T
    ratio = length * in_tesla / expected
    if FIELD_RATIO[0] <= ratio <= FIELD_RATIO[1]:
        return None
    units = {"T": 1.0, "G": 1e-4, "mG": 1e-7, "uT": 1e-6, "nT": 1e-9}
    return _unit_fault("magnetometer", unit, length, ratio, FIELD_RATIO, units, expected, "the local field")


def gyroscope_unit(logged: ArrayLike, unit: str, in_radps: float) -> Fault | None:
    """Whether rates, (n, 3) readings in `unit` (`in_radps` rad/s), are within what gyroscopes can measure."""
    fastest = float(np.quantile(np.abs(np.asarray(logged, dtype=float)), 0.999)) * in_radps
    if fastest <= FASTEST_RADPS:
        return None
    sentence = (
        f"The gyroscope reads up to {fastest:.4g} rad/s (99.9 % of samples lie below) when its unit is {unit}; none"
        f" measures more than {FASTEST_RADPS:.0f}. The readings look like "
        + ("deg/s" if np.degrees(1.0) * FASTEST_RADPS >= fastest else "counts")
        + ". Correct units.gyroscope."
    )
    return Fault("gyroscope", "", ReasonCode.WRONG_UNIT, fastest, FASTEST_RADPS, True, sentence)


def _unit_fault(
    sensor: str,
    unit: str,
    length: float,
    ratio: float,
    allowed: tuple[float, float],
    units: dict[str, float],
    expected: float,
    what: str,
) -> Fault:
    distance = {name: abs(np.log(max(length, 1e-300) * scale / expected)) for name, scale in units.items()}
    nearest = min(distance, key=lambda name: distance[name])
    hint = f"; in {nearest} they would be {length * units[nearest] / expected:.2f}" if distance[nearest] < 1 else ""
    sentence = (
        f"The {sensor}'s readings are {ratio:.3g} times as long as {what} when their unit is {unit}{hint}. Correct"
        f" units.{sensor}."
    )
    return Fault(sensor, "", ReasonCode.WRONG_UNIT, ratio, allowed[ratio > 1], True, sentence)


def sampling_faults(sensor: str, t: ArrayLike) -> list[Fault]:
    """Samples that are missing, and a rate that changes, from stamps (n,), s. Neither is fatal: fits use the stamps."""
    t = np.asarray(t, dtype=float)
    step = np.diff(t)
    interval = float(np.median(step))
    faults = []
    lost = (step > DROPOUT_INTERVALS * interval) & (step <= LONGEST_DROPOUT_S)
    missing = float(np.rint(step[lost] / interval - 1.0).sum())
    share = missing / (len(t) + missing)
    if share > DROPOUT_SHARE:
        sentence = (
            f"The {sensor} lost about {missing:.0f} samples ({100 * share:.2f} %) in {int(lost.sum())} dropouts, the"
            f" longest {step[lost].max():.3f} s."
        )
        faults.append(Fault(sensor, "", ReasonCode.DROPOUTS, share, DROPOUT_SHARE, False, sentence))
    rates = _windowed_rates(t)
    if len(rates) > 1 and rates.max() > RATE_CHANGE_RATIO * rates.min():
        sentence = f"The {sensor}'s rate changes between {rates.min():.4g} and {rates.max():.4g} Hz."
        faults.append(
            Fault(
                sensor,
                "",
                ReasonCode.RATE_CHANGES,
                float(rates.max() / rates.min()),
                RATE_CHANGE_RATIO,
                False,
                sentence,
            )
        )
    return faults


def _windowed_rates(t: Array) -> NDArray[np.float64]:
    """Median rate, Hz, in each window of RATE_WINDOW_S with RATE_WINDOW_SAMPLES or more."""
    window = np.floor((t[1:] - t[0]) / RATE_WINDOW_S).astype(np.int64)
    step = np.diff(t)
    start = run_starts(window)
    pieces = [piece for piece in np.split(step, start[1:]) if len(piece) >= RATE_WINDOW_SAMPLES]
    return np.array([1.0 / np.median(piece) for piece in pieces])
