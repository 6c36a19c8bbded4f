"""`fieldcal.fit_joint`: three triads and the attitude in one likelihood, from arrays."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from fieldcal.api.sensor import SensorCalibration, not_calibrated, sensor_calibration
from fieldcal.estimation.joint import fit as joint_fit
from fieldcal.estimation.joint import initialise, model_selection
from fieldcal.estimation.joint.fit import JointFit
from fieldcal.estimation.joint.problem import TERMS, TRIADS, Readings
from fieldcal.geometry import sensor_model
from fieldcal.geometry.rotation import Array
from fieldcal.names import Method, Sensor
from fieldcal.reason_codes import ReasonCode
from fieldcal.stages.joint.judgement import judged, triad_of
from fieldcal.stages.results import triad_rows
from fieldcal.stages.tables import calibration_rows

if TYPE_CHECKING:
    from matplotlib.axes import Axes

LOGGED_UNIT = "logged"


@dataclass(frozen=True)
class JointEstimate:
    """What the joint estimate found. A sensor's refused axes raise `Refused` when their value is asked for.

    Attributes
    ----------
    magnetometer, accelerometer, gyroscope : SensorCalibration
        Constants; logged units are called "logged".
    t : (n,) array
        Stamps, s.
    attitude : (n, 4) array
        NED to sensor axes, scalar last.
    dip_rad, dip_sd_rad : float
        Dip of the local field below the horizon and its standard deviation, rad; NaN without a magnetometer.
    lever_arm_m, lever_arm_sd_m : (3,) array
        Centre of mass to sensor, sensor axes, m; zeros and NaN where none was found.
    terms : tuple of str
        Optional terms that held-out data asked for: cross-axis terms, delays.
    fit : JointFit
        All of it: state, noise levels, full covariance.

    Examples
    --------
    >>> import fieldcal
    >>> flight = fieldcal.simulate(seed=1, duration_s=20.0)
    >>> signs = {"magnetometer": (1, 1, -1), "accelerometer": (1, 1, -1), "gyroscope": (-1, 1, 1)}
    >>> joint = fieldcal.fit_joint(flight.t, **flight.counts, polarity=signs, gravity_mps2=9.81)
    >>> joint.attitude.shape, joint.terms
    ((3700, 4), ())
    >>> joint.gyroscope.bias.unit, joint.gyroscope.scale.unit
    ('rad/s', 'rad/s/logged')
    """

    t: Array = field(repr=False)
    attitude: Array = field(repr=False)
    dip_rad: float
    dip_sd_rad: float
    lever_arm_m: Array
    lever_arm_sd_m: Array
    terms: tuple[str, ...]
    fit: JointFit = field(repr=False)
    _sensors: Mapping[str, SensorCalibration] = field(repr=False)

    @property
    def magnetometer(self) -> SensorCalibration:
        """The magnetometer's constants."""
        return self._sensors["magnetometer"]

    @property
    def accelerometer(self) -> SensorCalibration:
        """The accelerometer's constants."""
        return self._sensors["accelerometer"]

    @property
    def gyroscope(self) -> SensorCalibration:
        """The gyroscope's constants."""
        return self._sensors["gyroscope"]

    def plot(self) -> list[Axes]:
        """The attitude, and the calibrated lengths of the vector triads beside what they should be."""
        from fieldcal.plots.attitude import plot_joint

        readings = self.fit.model.readings
        wanted = _lengths(readings)
        shown = {}
        for name in self.fit.model.vectors:
            logged = getattr(readings, name)
            matrix, bias, _, _ = triad_of(self.fit, name)
            length = np.linalg.norm(sensor_model.calibrate(logged, matrix, bias), axis=1)
            known = np.isfinite(length)
            shown[name] = (self.t[known], length[known], wanted[name], self._sensors[name].bias.unit)
        return plot_joint(self.t, self.attitude, shown, f"Joint estimate, {len(self.t)} samples")


def fit_joint(
    t: ArrayLike,
    gyroscope: ArrayLike,
    accelerometer: ArrayLike | None = None,
    magnetometer: ArrayLike | None = None,
    *,
    gravity_mps2: float = 9.80665,
    gravity_sign: str = "gravity",
    field_ned: ArrayLike = (1.0, 0.0, 0.0),
    field_unit: str = "norm",
    polarity: Mapping[str, ArrayLike] | None = None,
    start: Mapping[str, tuple[ArrayLike, ArrayLike]] | None = None,
    segment: ArrayLike | None = None,
    temperature_degc: ArrayLike | None = None,
    lever_arm_m: ArrayLike | None = None,
    max_scale_sd: float = 0.05,
    max_residual: float = 0.1,
) -> JointEstimate:
    """Estimate all triads and the attitude at once, by maximum likelihood.

    "The method is serial in nature, so good estimates must be determined at each step or the error will compound." Here
    nothing is handed on: the gyroscope is integrated between knots (Eq. 10), every accelerometer and magnetometer
    reading is predicted in its own logged unit (Eq. 3, 5), and Gauss–Newton moves attitudes, constants, dip and lever
    arm together. Noise levels are estimated beside them; optional terms are let in only where they predict held-out
    data better.

    Parameters
    ----------
    t : (n,) array
        Real stamps, s, rising.
    gyroscope : (n, 3) array
        As logged, any unit, finite.
    accelerometer, magnetometer : (n, 3) array, optional
        As logged at the same stamps and in the same sensor axes, any unit; NaN where there is no reading. One may be
        left out when `start` has the gyroscope's constants.
    gravity_mps2 : float
        Local gravity, m/s².
    gravity_sign : {"gravity", "specific_force"}
        Whether the accelerometer reads +g on the down axis at rest, or −g.
    field_ned : (3,) array
        Local magnetic field, north, east, down; its length counts, its dip is where the estimate starts.
    field_unit : str
        Its unit: that of the magnetometer's bias.
    polarity : mapping, optional
        Sensor → signs of its scales (3,), +1 unless given.
    start : mapping, optional
        Sensor → (scale (3,), bias (3,)) to start from; else ellipsoids, and equation error for the gyroscope.
    segment : (n,) array, optional
        Numbers of contiguous stretches.
    temperature_degc : (n,) array, optional
        °C: lets the gyroscope's slope with temperature be tried.
    lever_arm_m : (3,) array, optional
        Centre of mass to sensor, sensor axes, m; else it is estimated where the flight shows it.
    max_scale_sd : float
        Axes whose scale has a greater relative standard deviation are refused.
    max_residual : float
        A vector triad whose length varies by more than this share, rms, is refused.

    Returns
    -------
    JointEstimate

    Raises
    ------
    ValueError
        Wrong shapes, or non-finite gyroscope readings: the caller's error.
    UnusableFlight
        `no_start`: no vector triad has a start, or the gyroscope has none and one vector alone cannot give it.
    EstimationError
        `joint_singular`, `joint_diverged`, `axis_not_turned`: no minimum was reached.

    Notes
    -----
    It cannot see what moves all triads together with the body: a common rotation of the axes, or a field that turns
    with the vehicle other than hard iron. Numbers are not those of the pipeline to the last digit: there the serial
    chain's constants are the start.

    References
    ----------
    Grauer et al., AIAA 2009-2064, for the models.

    Examples
    --------
    >>> import fieldcal
    >>> flight = fieldcal.simulate(seed=1, duration_s=20.0)
    >>> signs = {"magnetometer": (1, 1, -1), "accelerometer": (1, 1, -1), "gyroscope": (-1, 1, 1)}
    >>> joint = fieldcal.fit_joint(flight.t, **flight.counts, polarity=signs, gravity_mps2=9.81)
    >>> (joint.magnetometer.scale.value / flight.experiment.scale["magnetometer"]).round(2)
    array([1., 1., 1.])
    """
    stamps = np.asarray(t, dtype=float)
    given = {"gyroscope": gyroscope, "accelerometer": accelerometer, "magnetometer": magnetometer}
    logged = {name: None if x is None else np.asarray(x, dtype=float) for name, x in given.items()}
    turned = _checked(stamps, logged)
    own = np.zeros(len(stamps), dtype=np.int64) if segment is None else np.asarray(segment)
    if gravity_sign not in sensor_model.GRAVITY_SIGNS:
        raise ValueError(f"gravity_sign is one of {', '.join(sensor_model.GRAVITY_SIGNS)}, not {gravity_sign!r}")
    field_vector = np.asarray(field_ned, dtype=float)
    signs = {name: np.asarray((polarity or {}).get(name, (1.0, 1.0, 1.0)), dtype=float) for name in TRIADS}
    warm = None if temperature_degc is None else np.asarray(temperature_degc, dtype=float)
    readings = Readings(
        t=stamps,
        segment=own,
        gyroscope=turned,
        accelerometer=logged["accelerometer"],
        magnetometer=logged["magnetometer"],
        gravity_mps2=sensor_model.GRAVITY_SIGNS[gravity_sign] * gravity_mps2,
        field_ned=field_vector,
        turning=initialise.turning(stamps, own, turned),
        warmth=None if warm is None else warm - warm.mean(),
    )
    arm = None if lever_arm_m is None else np.asarray(lever_arm_m, dtype=float)
    begin = _starts(start or {}, readings, signs)
    model, state = initialise.prepare(readings, begin, lever_arm=arm)
    fit = joint_fit.fit_joint(model, state, try_lever_arm=arm is None)
    fit, _ = model_selection.add_terms(fit)
    units = {"gyroscope": "rad/s", "accelerometer": "m/s^2", "magnetometer": field_unit}
    sensors = {}
    for name in TRIADS:
        if name not in fit.layout:
            sensors[name] = not_calibrated(name, f"no_{name}", f"No {name} readings with a start were given.")
            continue
        codes = judged(
            Sensor(name),
            fit,
            *_diagonal_constants(fit, name),
            polarity=signs[name],
            nominal_scale=None,
            max_scale_sd=max_scale_sd,
            max_residual=max_residual,
        )
        sensors[name] = _sensor(fit, name, units[name], codes, None if warm is None else float(warm.mean()))
    dip, dip_sd = _parameter(fit, "dip")
    arm_found, arm_sd = _parameter(fit, "lever_arm")
    return JointEstimate(
        t=stamps,
        attitude=fit.path.q,
        dip_rad=float(dip[0]) if "magnetometer" in fit.layout else float("nan"),
        dip_sd_rad=float(dip_sd[0]),
        lever_arm_m=arm_found,
        lever_arm_sd_m=arm_sd,
        terms=tuple(name for name in TERMS if name in fit.layout),
        fit=fit,
        _sensors=sensors,
    )


def _checked(t: Array, logged: Mapping[str, Array | None]) -> Array:
    """The gyroscope's readings, when all shapes agree."""
    for name, x in logged.items():
        if x is not None and x.shape != (len(t), 3):
            raise ValueError(f"{name} must be ({len(t)}, 3) as t is ({len(t)},), got {x.shape}")
    turned = logged["gyroscope"]
    if turned is None or not np.isfinite(turned).all():
        raise ValueError("gyroscope holds non-finite readings: leave such samples out and number the segments")
    return turned


def _lengths(readings: Readings) -> dict[str, float]:
    """Length of what each vector triad senses, in its calibrated unit."""
    return {
        "accelerometer": abs(readings.gravity_mps2),
        "magnetometer": float(np.linalg.norm(readings.field_ned)),
    }


def _starts(
    start: Mapping[str, tuple[ArrayLike, ArrayLike]], readings: Readings, signs: Mapping[str, Array]
) -> dict[str, tuple[Array, Array] | None]:
    """Constants to begin with: those given, else ellipsoids of the vector triads."""
    lengths = _lengths(readings)
    out: dict[str, tuple[Array, Array] | None] = {}
    for name in TRIADS:
        logged = getattr(readings, name)
        if name in start:
            scale, bias = start[name]
            out[name] = np.asarray(scale, dtype=float), np.asarray(bias, dtype=float)
        elif name in lengths and logged is not None:
            out[name] = initialise.start_of_triad(logged, lengths[name], signs[name])
        else:
            out[name] = None
    return out


def _diagonal_constants(fit: JointFit, name: str) -> tuple[Array, Array]:
    """Scales (3,) and the covariance (6, 6) of scales and biases."""
    matrix, _, covariance, _ = triad_of(fit, name)
    return np.diagonal(matrix), covariance


def _sensor(
    fit: JointFit, name: str, unit: str, codes: Sequence[ReasonCode | None], temperature_degc: float | None
) -> SensorCalibration:
    """A triad's constants; `codes` of the axes (3,): why one is refused."""
    matrix, bias, covariance, cross_sd = triad_of(fit, name)
    rows = triad_rows(
        Sensor(name),
        Method.JOINT,
        matrix,
        bias,
        covariance,
        unit=unit,
        logged_unit=LOGGED_UNIT,
        reference_reading=np.zeros(3),
        temperature_degc=temperature_degc,
        reason_code=codes,
        cross_sd=cross_sd,
    )
    bad = ", ".join(f"{axis}: {code}" for axis, code in zip("xyz", codes, strict=True) if code)
    return sensor_calibration(calibration_rows(rows), name, "joint", f"{bad}." if bad else None)


def _parameter(fit: JointFit, name: str) -> tuple[Array, Array]:
    """A parameter beside the triads' constants and its sd, NaN where it was not estimated."""
    value = fit.state.values[name]
    if name not in fit.layout:
        return value, np.full(len(value), np.nan)
    return value, np.sqrt(np.diagonal(fit.covariance)[fit.layout[name]])
