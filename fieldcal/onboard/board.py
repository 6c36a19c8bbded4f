"""The duty of a board: everything of one IMU, by its vehicle's configuration, as `fieldcal_feed` and its kin in C."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from fieldcal.estimation import wahba
from fieldcal.geometry.rotation import Array
from fieldcal.names import Sensor, Triple
from fieldcal.onboard.dumps import dump
from fieldcal.onboard.ellipsoid import Limits, MomentsFit
from fieldcal.onboard.moments import AXIS_ALIGNED, FULL
from fieldcal.onboard.noise import readings_in_mean
from fieldcal.onboard.rates import RatesFit
from fieldcal.onboard.streams import Moments, RateEquations

FEWEST_IN_BLOCK, MOST_IN_BLOCK = 3, 256
MAX_LENGTH_EXCESS = 0.05


@dataclass(frozen=True, kw_only=True)
class BoardSettings:
    """What a board must know of its vehicle.

    Attributes
    ----------
    field_norm, gravity_mps2 : float
        Lengths of the local field, in `field_unit`, and of gravity.
    field_unit : str
        Wanted for the magnetometer.
    field_ned : (3,)
        Direction of the field: north, east, down.
    gravity_sign : {1.0, -1.0}
        Sign of what the accelerometer reads on the down axis at rest.
    magnetometer_polarity, accelerometer_polarity, gyroscope_polarity : (3,) of ±1
    direction_sd : (2,)
        Rad, of the sensed field and gravity: weights of the attitude.
    imu_rate_hz, magnetometer_rate_hz : float
        Readings a second.
    full : bool
        Symmetric scale matrices.
    block_s, disturbance_s : float
        Over how long an attitude's derivative is formed, and over how long a disturbance stays alike.
    forgetting : float
        Factor a block of the gyroscope's equations; 1: nothing is forgotten.
    max_condition, max_scale_sd, max_residual, gyroscope_max_scale_sd : float
        Refused beyond.
    max_length_excess : float
        A sample whose calibrated field or gravity is further from its length, relative, makes no attitude.

    Examples
    --------
    >>> BoardSettings(imu_rate_hz=400.0, magnetometer_rate_hz=400.0).block_samples
    40
    """

    field_norm: float = 1.0
    field_unit: str = "norm"
    gravity_mps2: float = 9.80665
    field_ned: Triple = (1.0, 0.0, 0.0)
    gravity_sign: float = 1.0
    magnetometer_polarity: Triple = (1.0, 1.0, 1.0)
    accelerometer_polarity: Triple = (1.0, 1.0, 1.0)
    gyroscope_polarity: Triple = (1.0, 1.0, 1.0)
    direction_sd: tuple[float, float] = (0.01, 0.01)
    imu_rate_hz: float = 100.0
    magnetometer_rate_hz: float = 100.0
    full: bool = False
    block_s: float = 0.1
    disturbance_s: float = 0.3
    forgetting: float = 1.0
    max_condition: float = 50.0
    max_scale_sd: float = 0.05
    max_residual: float = 0.1
    max_length_excess: float = MAX_LENGTH_EXCESS
    gyroscope_max_scale_sd: float = 0.05

    @property
    def block_samples(self) -> int:
        """Attitudes of a block: one each time that the magnetometer has a new reading."""
        return block_samples_at(min(self.imu_rate_hz, self.magnetometer_rate_hz), self.block_s)

    @property
    def max_gap_us(self) -> int:
        """After so long without an attitude a new block begins: five of its intervals, µs."""
        return round(5e6 / min(self.imu_rate_hz, self.magnetometer_rate_hz))

    def limits(self, sensor: Sensor | str) -> Limits:
        """What is asked of the magnetometer or the accelerometer."""
        own = Sensor(sensor) == Sensor.MAGNETOMETER
        return Limits(
            magnitude=self.field_norm if own else self.gravity_mps2,
            polarity=self.magnetometer_polarity if own else self.accelerometer_polarity,
            full=self.full,
            correlated_samples=(self.magnetometer_rate_hz if own else self.imu_rate_hz) * self.disturbance_s,
            max_condition=self.max_condition,
            max_scale_sd=self.max_scale_sd,
            max_residual=self.max_residual,
        )


def undisturbed(vectors: Array, lengths: tuple[float, float], most: float = MAX_LENGTH_EXCESS) -> np.ndarray:
    """Which samples (n,) of calibrated field and gravity (n, 2, 3) are as long as those are, but for a share."""
    return np.asarray((np.abs(np.linalg.norm(vectors, axis=2) / lengths - 1.0) <= most).all(axis=1))


def block_samples_at(rate_hz: float, block_s: float = 0.1) -> int:
    """Samples of a block at a rate: 3 to 256."""
    return int(np.clip(round(rate_hz * block_s), FEWEST_IN_BLOCK, MOST_IN_BLOCK))


@dataclass(frozen=True)
class BoardResult:
    """What a board has found of its three triads, each judged.

    Examples
    --------
    >>> from fieldcal.onboard import Board, BoardSettings
    >>> result = Board(BoardSettings()).solve()
    >>> str(result.magnetometer.reason_code)
    'too_few_samples'
    """

    magnetometer: MomentsFit
    accelerometer: MomentsFit
    gyroscope: RatesFit


class Board:
    """One IMU's duty: start, feed, solve, reset.

    Vector triads come first: the gyroscope's equations need attitudes, which are made with their constants. They are
    fed from when `solve` has found both, or `set_vectors` has given earlier ones.

    Parameters
    ----------
    settings : BoardSettings
    single : bool
        Rounded to floats, as on board.

    Examples
    --------
    >>> import numpy as np
    >>> import fieldcal
    >>> from fieldcal.onboard import Board, BoardSettings
    >>> flight = fieldcal.simulate(seed=1)
    >>> board = Board(
    ...     BoardSettings(
    ...         gravity_mps2=9.81,
    ...         magnetometer_polarity=(1, 1, -1),
    ...         accelerometer_polarity=(1, 1, -1),
    ...         gyroscope_polarity=(-1, 1, 1),
    ...         imu_rate_hz=185.0,
    ...         magnetometer_rate_hz=185.0,
    ...     )
    ... )
    >>> sample = np.rint(flight.t * 1e6), *(flight.counts[s] for s in ("gyroscope", "accelerometer", "magnetometer"))
    >>> board.feed(*sample)
    >>> board.solve().gyroscope.reason_code[0]
    <ReasonCode.TOO_FEW_SAMPLES: 'too_few_samples'>
    >>> board.feed(*sample)  # the vectors are known now
    >>> board.solve().gyroscope.reason_code
    (None, None, None)
    """

    def __init__(self, settings: BoardSettings, *, single: bool = False) -> None:
        self.settings, self.single = settings, single
        self.reset()

    def reset(self) -> None:
        """Everything is forgotten."""
        s = self.settings
        sums = FULL if s.full else AXIS_ALIGNED
        field, inertial = (readings_in_mean(rate_hz) for rate_hz in (s.magnetometer_rate_hz, s.imu_rate_hz))
        self.magnetometer = Moments(sums=sums, in_mean=field, single=self.single)
        self.accelerometer = Moments(sums=sums, in_mean=inertial, single=self.single)
        self.gyroscope = RateEquations(
            s.block_samples, s.forgetting, in_mean=field, single=self.single, max_gap_us=s.max_gap_us
        )
        self.vectors: tuple[tuple[Array, Array], tuple[Array, Array]] | None = None

    def set_vectors(self, magnetometer: tuple[Array, Array], accelerometer: tuple[Array, Array]) -> None:
        """Scale (3, 3) and bias (3,) of both, to make attitudes with."""
        self.vectors = (magnetometer, accelerometer)

    def feed(
        self, t_us: ArrayLike, gyroscope: ArrayLike, accelerometer: ArrayLike, magnetometer: ArrayLike | None = None
    ) -> None:
        """Samples of the IMU: stamps (n,), µs, and readings (n, 3); the magnetometer's NaN where it has no new one."""
        t = np.atleast_1d(np.asarray(t_us, dtype=float))
        w, a = (np.atleast_2d(np.asarray(x, dtype=float)) for x in (gyroscope, accelerometer))
        self.accelerometer.feed(a)
        if magnetometer is None:
            return
        h = np.atleast_2d(np.asarray(magnetometer, dtype=float))
        new = np.isfinite(h).all(axis=1)
        self.magnetometer.feed(h[new])
        both = new & np.isfinite(a).all(axis=1)
        if self.vectors is not None and both.any():
            self.gyroscope.feed(t[both], self.attitudes(h[both], a[both]), w[both])

    def attitudes(self, magnetometer: Array, accelerometer: Array) -> Array:
        """Attitudes (n, 4) of the sensors' axes from readings (n, 3) of both triads (Eq. 9); NaN where one is too long
        or too short."""
        assert self.vectors is not None, "the vector triads are not known"
        (scale_h, bias_h), (scale_a, bias_a) = self.vectors
        s = self.settings
        seen = np.stack([magnetometer @ scale_h.T + bias_h, accelerometer @ scale_a.T + bias_a], axis=1)
        known = np.array([s.field_ned, (0.0, 0.0, s.gravity_sign)])
        q = wahba.attitudes(seen, known, s.direction_sd).q
        return np.where(undisturbed(seen, (s.field_norm, s.gravity_mps2), s.max_length_excess)[:, None], q, np.nan)

    def solve(self) -> BoardResult:
        """Constants of the three triads by what has been fed so far."""
        s = self.settings
        field = self.magnetometer.solve(s.limits(Sensor.MAGNETOMETER))
        gravity = self.accelerometer.solve(s.limits(Sensor.ACCELEROMETER))
        gyroscope = self.gyroscope.solve(s.gyroscope_polarity, s.gyroscope_max_scale_sd)
        if self.vectors is None and field.reason_code is None and gravity.reason_code is None:
            self.set_vectors((field.scale, field.bias), (gravity.scale, gravity.bias))
        return BoardResult(field, gravity, gyroscope)

    def dump(self) -> bytes:
        """What has been collected, to be merged elsewhere (`read_dumps`)."""
        return (
            dump(Sensor.MAGNETOMETER, self.magnetometer)
            + dump(Sensor.ACCELEROMETER, self.accelerometer)
            + dump(Sensor.GYROSCOPE, self.gyroscope)
        )
