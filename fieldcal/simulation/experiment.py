"""The paper's experiment with known truth, and what may go wrong in it: arrays in, arrays out (files: `archive`).

Three sets of one doublet per axis, MEMS triads behind a two-pole 50 Hz band limit and 16-bit converters at 185 Hz
(Table 1), Tables 2–4's constants with their signs put right, a VPS at 350 Hz on a clock of its own.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.random import Generator

from fieldcal.geometry.rotation import Array, body_from_inertial, from_rotation_vector, multiply, normalise
from fieldcal.names import SENSORS
from fieldcal.simulation.flown import Flown, FlownMotion
from fieldcal.simulation.motion import Kinematics, sinusoids, total

TICK_S = 25.6e-6
BAND_LIMIT_HZ = 50.0
DAMPING = np.sqrt(0.5)
# Table 1: variances (norm², (m/s²)², (rad/s)², rad²)
NOISE_VARIANCE = {"magnetometer": 34.043e-6, "accelerometer": 2.4594e-3, "gyroscope": 0.0183}
VPS_VARIANCE = 0.8781e-9
# Tables 2–4, signs put right: λ_hz, λ_az and λ_ωx are negative
SCALE = {
    "magnetometer": (0.1603e-3, 0.1433e-3, -0.1633e-3),
    "accelerometer": (4.9070e-3, 3.3580e-3, -3.5924e-3),
    "gyroscope": (-0.2221e-3, 0.2899e-3, 0.3794e-3),
}
BIAS = {
    "magnetometer": (-6.1665, -5.1183, 5.4719),
    "accelerometer": (-153.3, -114.5, 120.7),
    "gyroscope": (7.0283, -9.6219, -11.728),
}
MID_SCALE = 32768.0
RANGE = {"magnetometer": 8.0, "accelerometer": 160.0, "gyroscope": 35.0}
"""Of what logs units, in them: 16 g and 2000 °/s."""
BLOCK = 65_536
"""Samples of the motion evaluated at once: a record of an hour has thousands of doublets, of which each meets few."""


@dataclass(frozen=True)
class Experiment:
    """What to simulate. Every default is the paper's experiment; units are in the names.

    `motion`: what is flown. `logged`: counts of 16-bit converters, or units (rad/s, m/s², norm) in steps of a signed
    one with the ranges of RANGE. `scale` and `bias` map a sensor to its constants at 25 °C. Temperature: λ(T) =
    λ (1 + c_s ΔT), and the value at mid-scale (32768 counts; 0 of a unit) moves by c_b ΔT, ΔT = T − 25 °C.

    A satellite receiver of `gnss_rate_hz` (0: none) tells the velocity of its antenna at `gnss_arm_m` from the sensor,
    body axes, as it was `gnss_lag_s` before the stamp, with errors of `gnss_sd_mps` level and vertical, the share
    `gnss_colour` of their variance correlated over `gnss_colour_s`.

    Examples
    --------
    >>> Experiment(duration_s=20.0, dip_rad=1.1).rate_hz
    185.0
    """

    seed: int = 0
    motion: Flown = Flown.MANOEUVRE
    logged: Literal["counts", "si"] = "counts"
    duration_s: float = 40.0
    sets: int = 3
    rate_hz: float = 185.0
    peak_rad: tuple[float, float] = (0.7, 1.1)
    doublet_s: tuple[float, float] = (2.2, 3.0)
    cross_coupling: float = 0.12
    turned: tuple[float, float, float] = (1.0, 1.0, 1.0)  # share of bank, pitch and heading that is flown
    tremor_rad: float = 0.01
    gravity_mps2: float = 9.81
    dip_rad: float = 0.0
    scale: dict[str, tuple[float, float, float]] = field(default_factory=lambda: dict(SCALE))
    bias: dict[str, tuple[float, float, float]] = field(default_factory=lambda: dict(BIAS))
    translation_rms_mps2: float = 0.0
    lever_arm_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    temperature_degc: tuple[float, float] = (25.0, 25.0)
    bias_per_degc: dict[str, tuple[float, float, float]] = field(default_factory=dict)
    scale_per_degc: dict[str, tuple[float, float, float]] = field(default_factory=dict)
    gyro_random_walk: float = 0.0  # rad/s/√s
    lost_share: float = 0.0
    jitter_s: float = 0.0
    magnetic_bursts: int = 0
    burst_norm: float = 0.4
    noise: bool = True
    noise_variance: dict[str, float] = field(default_factory=lambda: dict(NOISE_VARIANCE))
    quantisation: bool = True
    band_limit: bool = True
    vps: bool = True
    vps_rate_hz: float = 350.0
    vps_offset_s: float = 0.37
    vps_skew_ppm: float = 20.0
    vps_dropout_share: float = 0.0
    vps_outlier_share: float = 0.0
    vps_misalignment_rad: float = 0.0
    gnss_rate_hz: float = 0.0
    gnss_lag_s: float = 0.12
    gnss_arm_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    gnss_sd_mps: tuple[float, float] = (0.10, 0.15)
    gnss_colour: float = 0.0
    gnss_colour_s: float = 2.0
    gnss_outlier_share: float = 0.0


@dataclass(frozen=True)
class SimulatedFlight:
    """A simulated log and its truth.

    Logged: `t` (n,) IMU stamps, s; `counts` sensor → (n, 3); `temperature` (n,) °C; `vps_t` (m,) s on the VPS clock;
    `vps_q` (m, 4) body to NED world; `vps_position` (m, 3) m; `current_a` (n,) A of the motors, or None.
    Truth: `q` (n, 4) and `rate` (n, 3) at t as the sensors saw them, i.e. `delay_s` late by the sensor filter; the two
    constant VPS rotations. `gnss_t` (g,) s on the IMU's clock, `gnss_velocity` (g, 3) m/s NED, `gnss_sd` (g,) as the
    receiver claims it: without one all are empty.

    Examples
    --------
    >>> flight = simulate(seed=1, duration_s=20.0)
    >>> flight.t.shape, flight.vps_q.shape, sorted(flight.experiment.scale) == sorted(flight.counts)
    ((3700,), (7000, 4), True)
    """

    experiment: Experiment
    t: Array
    counts: dict[str, Array]
    temperature: Array
    vps_t: Array
    vps_q: Array
    vps_position: Array
    q: Array
    rate: Array
    delay_s: float
    vps_world_rotation: Array
    vps_body_rotation: Array
    gnss_t: Array
    gnss_velocity: Array
    gnss_sd: Array
    current_a: Array | None = None

    def lag_at(self, imu_time_s: float) -> float:
        """VPS clock + lag = IMU clock, s, at an IMU time; the sensors' delay is in it."""
        skew = 1e-6 * self.experiment.vps_skew_ppm
        return float(imu_time_s - ((imu_time_s - self.delay_s) * (1 + skew) + self.experiment.vps_offset_s))

    @property
    def gnss_lag_s(self) -> float:
        """By how much the receiver's velocity is later than the readings with its stamp: they are late too."""
        return self.experiment.gnss_lag_s - self.delay_s

    @property
    def lag_s(self) -> float:
        """Lag at the first IMU sample."""
        return self.lag_at(self.t[0])


class Motion(Kinematics):
    """Attitude, rate and translation in closed form: sums of doublets and sinusoids, evaluated at any time."""

    def __init__(self, experiment: Experiment, rng: Generator) -> None:
        e = experiment
        self.experiment = e
        starts, lengths, amplitudes = [], [], []
        clock = 0.0
        for _ in range(e.sets):
            for axis in range(3):
                length = rng.uniform(*e.doublet_s)
                peak = rng.uniform(*e.peak_rad) * rng.choice([-1.0, 1.0])
                mix = e.cross_coupling * rng.choice([-1.0, 1.0], size=3)
                mix[axis] = 1.0
                starts.append(clock)
                lengths.append(length)
                amplitudes.append(peak * mix * e.turned)
                clock += length + rng.uniform(0.2, 0.6)
            clock += rng.uniform(0.5, 1.5)
        # Centred in the record; a longer record repeats nothing, a shorter one is scaled to fit.
        room = 0.95 * e.duration_s
        squeeze = min(1.0, room / clock)
        self.starts = np.array(starts) * squeeze + 0.5 * (e.duration_s - clock * squeeze)
        self.lengths = np.array(lengths) * squeeze
        self.amplitudes = np.array(amplitudes)
        self.tremor = sinusoids(rng, e.tremor_rad / np.sqrt(3.0), (0.3, 1.5), lines=8)
        self.translation = sinusoids(rng, e.translation_rms_mps2 / np.sqrt(3.0), (0.3, 2.0), lines=6)

    def euler(self, t: Array) -> tuple[Array, Array]:
        """Bank, pitch, heading (n, 3) and their derivatives at times t (n,)."""
        if len(t) <= BLOCK:
            return self._euler(t, np.ones(len(self.starts), dtype=bool))
        parts = [t[at : at + BLOCK] for at in range(0, len(t), BLOCK)]
        blocks = [self._euler(p, (self.starts < p.max()) & (self.starts + self.lengths > p.min())) for p in parts]
        return np.concatenate([angle for angle, _ in blocks]), np.concatenate([dot for _, dot in blocks])

    def _euler(self, t: Array, flown: Array) -> tuple[Array, Array]:
        """The same, of those doublets that are `flown` meanwhile."""
        starts, lengths, amplitudes = self.starts[flown], self.lengths[flown], self.amplitudes[flown]
        x = 2 * np.pi * (t[:, None] - starts) / lengths
        inside = (x > 0) & (x < 2 * np.pi)
        x = np.where(inside, x, 0.0)
        peak = 1.299038105676658  # of sin x − ½ sin 2x, at 2π/3
        shape = (np.sin(x) - 0.5 * np.sin(2 * x)) / peak
        slope = np.where(inside, (np.cos(x) - np.cos(2 * x)) / peak, 0.0) * 2 * np.pi / lengths
        angle, angle_dot = total(self.tremor, t, 0), total(self.tremor, t, 1)
        return shape @ amplitudes + angle, slope @ amplitudes + angle_dot

    def acceleration(self, t: Array) -> Array:
        """Translational acceleration of the centre of mass, m/s², NED."""
        return total(self.translation, t, 0) if np.any(self.translation[0]) else np.zeros((len(t), 3))

    def velocity(self, t: Array) -> Array:
        """Velocity of the centre of mass, m/s, NED: the acceleration integrated."""
        return total(self.translation, t, -1) if np.any(self.translation[0]) else np.zeros((len(t), 3))

    def position(self, t: Array) -> Array:
        """Position, m, NED: the acceleration integrated twice."""
        return total(self.translation, t, -2) if np.any(self.translation[0]) else np.zeros((len(t), 3))


def simulate(experiment: Experiment | None = None, **changes: object) -> SimulatedFlight:
    """Fly one experiment in memory: arrays of what is logged, and the truth.

    Parameters
    ----------
    experiment : Experiment, optional
        Default: the paper's.
    **changes
        Replace fields of it.

    Returns
    -------
    SimulatedFlight
        `t` (n,) s, `counts` (sensor → (n, 3)), `vps_t`, `vps_q`, …, and the truth beside them.

    Raises
    ------
    TypeError
        `Experiment` has no such field.

    References
    ----------
    Grauer et al., AIAA 2009-2064, Tables 1–4.

    Examples
    --------
    >>> import fieldcal
    >>> flight = fieldcal.simulate(seed=1, duration_s=20.0, noise=False)
    >>> flight.counts["gyroscope"].shape, flight.q.shape, round(flight.lag_s, 2)
    ((3700, 3), (3700, 4), -0.37)
    """
    e = replace(experiment or Experiment(), **changes)  # type: ignore[arg-type]
    # Separate streams: switching one effect on or off leaves the others' draws alone.
    streams = dict(
        zip(
            ("motion", "noise", "stamps", "bursts", "walk", "vps", "gnss"),
            (np.random.default_rng(s) for s in np.random.SeedSequence(e.seed).spawn(7)),
            strict=True,
        )
    )
    drawn = streams["motion"]
    by_hand = e.motion == Flown.MANOEUVRE
    motion = Motion(e, drawn) if by_hand else FlownMotion(e.motion, e.duration_s, drawn)
    t = _stamps(e, streams["stamps"])
    delay_s = 2 * DAMPING / (2 * np.pi * BAND_LIMIT_HZ) if e.band_limit else 0.0
    temperature = np.interp(t, [0.0, e.duration_s], e.temperature_degc)
    sensed = _sensed(e, motion, t, streams)
    counts: dict[str, Array] = {name: _counts(e, name, sensed[name], temperature) for name in SENSORS}
    world, body = (
        from_rotation_vector(e.vps_misalignment_rad * _unit(streams["vps"])),
        from_rotation_vector(e.vps_misalignment_rad * _unit(streams["vps"])),
    )
    vps_t, vps_q, vps_position = _vps(e, motion, streams["vps"], world, body)
    q, rate = motion.attitude_and_rate(t - delay_s)
    gnss_t, gnss_velocity, gnss_sd = _gnss(e, motion, streams["gnss"])
    return SimulatedFlight(
        experiment=e,
        t=t,
        counts=counts,
        temperature=temperature,
        vps_t=vps_t,
        vps_q=vps_q,
        vps_position=vps_position,
        q=q,
        rate=rate,
        delay_s=delay_s,
        vps_world_rotation=world,
        vps_body_rotation=body,
        gnss_t=gnss_t,
        gnss_velocity=gnss_velocity,
        gnss_sd=gnss_sd,
    )


def _unit(rng: Generator) -> Array:
    v = rng.normal(size=3)
    return np.asarray(v / np.linalg.norm(v))


def _stamps(e: Experiment, rng: Generator) -> Array:
    """Sampling times, s, on the oscillator's ticks; jitter moves them and losses thin them."""
    n = int(np.floor(e.duration_s * e.rate_hz))
    t = np.arange(n) / e.rate_hz
    t = t + np.clip(e.jitter_s * rng.normal(size=n), -0.3 / e.rate_hz, 0.3 / e.rate_hz)
    t -= t[0]
    if e.lost_share > 0:
        keep = rng.uniform(size=n) >= e.lost_share
        keep[[0, -1]] = True
        t = t[keep]
    # The interval of 185 Hz is no whole number of ticks: stamps are rounded only where there is a converter.
    return np.round(t / TICK_S) * TICK_S if e.quantisation else t


def _sensed(e: Experiment, motion: Kinematics, t: Array, streams: dict[str, Generator]) -> dict[str, Array]:
    """What the triads sense at stamps t, SI, gravity-signed, after the band limit and with noise."""
    oversampling = 8
    fine = t
    if e.band_limit:
        step = 1.0 / (oversampling * e.rate_hz)
        fine = np.arange(-0.3, e.duration_s + 0.1, step)
    field_n = np.array([np.cos(e.dip_rad), 0.0, np.sin(e.dip_rad)])
    attitude, rate = motion.attitude_and_rate(fine)
    a_bn = body_from_inertial(attitude)
    arm = np.array(e.lever_arm_m)
    rotation = np.cross(motion.rate_dot(fine), arm) + np.cross(rate, np.cross(rate, arm)) if arm.any() else 0.0
    gravity = np.array([0.0, 0.0, e.gravity_mps2])
    acceleration = np.einsum("nij,nj->ni", a_bn, gravity - motion.acceleration(fine)) - rotation
    magnetic = a_bn @ field_n
    for _ in range(e.magnetic_bursts):
        rng = streams["bursts"]
        centre, width = rng.uniform(0.1, 0.9) * e.duration_s, rng.uniform(0.3, 0.8)
        magnetic = magnetic + np.exp(-0.5 * ((fine[:, None] - centre) / width) ** 2) * e.burst_norm * _unit(rng)
    if e.gyro_random_walk > 0:
        rng = streams["walk"]
        steps = rng.normal(size=(len(fine), 3)) * np.sqrt(np.gradient(fine))[:, None]
        rate = rate + e.gyro_random_walk * (
            np.cumsum(steps, axis=0) - np.cumsum(steps, axis=0)[np.searchsorted(fine, 0.0)]
        )
    out = {"magnetometer": magnetic, "accelerometer": acceleration, "gyroscope": rate}
    for name in SENSORS:
        noise = streams["noise"].normal(size=out[name].shape) if e.noise else None
        if e.band_limit:
            out[name] = _band_limited(out[name], step)
            if noise is not None:
                noise = _band_limited(noise, step)
                noise /= np.sqrt(np.mean(noise[500:] ** 2))
        if noise is not None:
            out[name] = out[name] + np.sqrt(e.noise_variance[name]) * noise
        if e.band_limit:
            from scipy.interpolate import CubicSpline

            out[name] = CubicSpline(fine, out[name])(t)
    return out


def _band_limited(x: Array, step: float) -> Array:
    """Two-pole 50 Hz low-pass (Butterworth), exact for input linear between fine samples; starts settled."""
    from scipy import signal

    w = 2 * np.pi * BAND_LIMIT_HZ
    b, a, _ = signal.cont2discrete(([w * w], [1.0, 2 * DAMPING * w, w * w]), step, method="foh")
    b = np.atleast_1d(np.squeeze(b))
    start = signal.lfilter_zi(b, a)[:, None] * x[:1]
    return np.asarray(signal.lfilter(b, a, x, axis=0, zi=start)[0])


def constants_at(e: Experiment, sensor: str, temperature: Array | float) -> tuple[Array, Array]:
    """True (scale, bias), each (…, 3), of a sensor at a temperature, °C."""
    warm = np.asarray(temperature, dtype=float)[..., None] - 25.0
    scale0, bias0 = np.array(e.scale[sensor]), np.array(e.bias[sensor])
    scale = scale0 * (1.0 + np.array(e.scale_per_degc.get(sensor, (0.0, 0.0, 0.0))) * warm)
    middle_reading = MID_SCALE if e.logged == "counts" else 0.0
    middle = scale0 * middle_reading + bias0 + np.array(e.bias_per_degc.get(sensor, (0.0, 0.0, 0.0))) * warm
    return scale, middle - scale * middle_reading


def _counts(e: Experiment, sensor: str, sensed: Array, temperature: Array) -> Array:
    """Invert Eq. 5 and, unless switched off, round to 16-bit words."""
    scale, bias = constants_at(e, sensor, temperature)
    counts = (sensed - bias) / scale
    if e.logged == "si":
        step = RANGE[sensor] / MID_SCALE
        return np.clip(step * np.rint(counts / step), -RANGE[sensor], RANGE[sensor]) if e.quantisation else counts
    return np.clip(np.rint(counts), 0, 65535) if e.quantisation else counts


def _vps(e: Experiment, motion: Kinematics, rng: Generator, world: Array, body: Array) -> tuple[Array, Array, Array]:
    """VPS stamps (own clock), attitudes (body to its world) and positions (m, NED)."""
    if not e.vps:
        return np.empty(0), np.empty((0, 4)), np.empty((0, 3))
    t = np.arange(0.0, e.duration_s, 1.0 / e.vps_rate_hz)
    q = multiply(multiply(world, motion.attitude(t)), body)
    position = motion.position(t)
    if e.noise:
        q = normalise(multiply(q, from_rotation_vector(np.sqrt(VPS_VARIANCE) * rng.normal(size=(len(t), 3)))))
        position = position + 1e-4 * rng.normal(size=position.shape)
    if e.vps_outlier_share > 0:
        wrong = rng.uniform(size=len(t)) < e.vps_outlier_share
        q[wrong] = multiply(q[wrong], from_rotation_vector(rng.normal(size=(int(wrong.sum()), 3)) * 0.5))
    keep = np.ones(len(t), dtype=bool)
    while keep.mean() > 1.0 - e.vps_dropout_share:
        start = rng.uniform(0, e.duration_s)
        keep[(t >= start) & (t < start + rng.uniform(0.05, 0.5))] = False
    stamps = t * (1 + 1e-6 * e.vps_skew_ppm) + e.vps_offset_s
    return stamps[keep], q[keep], position[keep]


def _gnss(e: Experiment, motion: Kinematics, rng: Generator) -> tuple[Array, Array, Array]:
    """Stamps, velocities (g, 3) and claimed accuracies (g,) of the receiver."""
    if e.gnss_rate_hz == 0.0:
        return np.empty(0), np.empty((0, 3)), np.empty(0)
    t = np.arange(rng.uniform(0.0, 1.0 / e.gnss_rate_hz), e.duration_s, 1.0 / e.gnss_rate_hz)
    then = t - e.gnss_lag_s
    turned = np.cross(motion.rate(then), np.array(e.lever_arm_m) + np.array(e.gnss_arm_m))
    velocity = motion.velocity(then) + np.einsum("nji,nj->ni", body_from_inertial(motion.attitude(then)), turned)
    sd = np.array([e.gnss_sd_mps[0], e.gnss_sd_mps[0], e.gnss_sd_mps[1]])
    if e.noise:
        white, slow = rng.normal(size=(2, len(t), 3))
        keep = np.exp(-1.0 / (e.gnss_rate_hz * e.gnss_colour_s))
        for k in range(1, len(t)):
            slow[k] = keep * slow[k - 1] + np.sqrt(1.0 - keep**2) * slow[k]
        velocity += sd * (np.sqrt(1.0 - e.gnss_colour) * white + np.sqrt(e.gnss_colour) * slow)
    wrong = rng.uniform(size=len(t)) < e.gnss_outlier_share
    velocity[wrong] += rng.normal(size=(int(wrong.sum()), 3)) * 5.0
    return t, velocity, np.full(len(t), float(np.sqrt(np.mean(sd**2))))
