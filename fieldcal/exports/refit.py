"""Constants by many flights at once, from the moments that each left in the history, or that a board has dumped.

No log is read: moments about one point are those about another, exactly, and add up. The one place that combines them.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import polars as pl

from fieldcal.errors import FieldcalError
from fieldcal.geometry.rotation import Array
from fieldcal.names import SENSORS, Method, Sensor, Status, Triple
from fieldcal.onboard.dumps import State
from fieldcal.onboard.ellipsoid import Limits, MomentsFit, fit_moments
from fieldcal.onboard.moments import AXIS_ALIGNED, FULL, translate
from fieldcal.onboard.rates import WEIGHT, RatesFit, fit_rates, noise_kept, recentred
from fieldcal.onboard.streams import Moments
from fieldcal.reason_codes import ReasonCode
from fieldcal.schemas.columns import FLOWN_ORDER
from fieldcal.schemas.rows import MomentsRow
from fieldcal.stages.results import triad_rows
from fieldcal.stages.tables import CalibrationRow, calibration_rows
from fieldcal.warehouse.decisions.withdrawn import as_decided, decisions
from fieldcal.warehouse.questions import existing, known_vehicle, nearest
from fieldcal.words.rows import rows_of, typed

if TYPE_CHECKING:
    from fieldcal.onboard.board import BoardSettings

SAME_MAGNITUDE = 0.002
"""Flights that were fitted to lengths further apart (another place, another unit) are not one fit."""
DISTURBANCE_S = 0.3
DUMPED_UNIT = "dump"


@dataclass(frozen=True)
class Collected:
    """What one flight, or one dump, has of one sensor of a unit."""

    unit_id: str
    sensor: Sensor
    magnitude: float | None
    unit: str
    logged_unit: str | None
    temperature_degc: float | None
    rate_hz: float
    block_samples: int
    n_samples: int
    n_differences: int
    polarity: Triple
    centre: Array
    noise: Array
    sums: Array


@dataclass(frozen=True)
class Refit:
    """Constants of one sensor by flights together.

    Attributes
    ----------
    unit_id : str
    sensor : Sensor
    n_flights, n_samples : int
    fit : MomentsFit or RatesFit
        What was found, and why it is refused.
    rows : list of dict
        The same as rows of `calibration`, method "moments".

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> import fieldcal
    >>> from fieldcal.onboard import Moments, dump
    >>> moments = Moments()
    >>> moments.feed(fieldcal.simulate(seed=1).counts["magnetometer"])
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     board = Path(folder, "board.bin")
    ...     _ = board.write_bytes(dump("magnetometer", moments))
    ...     [one] = fieldcal.Warehouse(folder).refit(dumps=[board])
    >>> str(one.sensor), one.n_flights, one.n_samples, str(one.rows[0]["method"])
    ('magnetometer', 1, 7400, 'moments')
    """

    unit_id: str
    sensor: Sensor
    n_flights: int
    n_samples: int
    fit: MomentsFit | RatesFit
    rows: list[CalibrationRow]


def refit(
    root: Path,
    vehicle: str | None,
    *,
    sessions: str | None,
    dumped: Sequence[tuple[Sensor, State]],
    board: BoardSettings,
    full: bool,
) -> list[Refit]:
    """Solve for the constants of every sensor from a vehicle's flights and from dumps.

    Parameters
    ----------
    root : Path
        The warehouse.
    vehicle : str, optional
        Whose flights; None: dumps alone.
    sessions : str, optional
        "A..B": from the first flight of session A to the last of session B, in the order in which they were flown;
        either may be left out, and "A" is that session.
    dumped : sequence of (Sensor, Moments or RateEquations)
        What boards have collected. They are taken for flights of the unit that flew last.
    board : BoardSettings
        What such a board knew of its vehicle; of flights only its limits of refusals count, their magnitudes and
        polarities are their own.
    full : bool
        Symmetric scale matrices.

    Raises
    ------
    FieldcalError
        `not_found`: no such vehicle or session, or no moments; `not_one_fit`: flights of other fields, units or
        polarities.
    """
    collected = [] if vehicle is None else _of_flights(root, vehicle, sessions)
    last = {one.sensor: one for one in collected}
    collected += [_of_dump(sensor, state, board, last) for sensor, state in dumped]
    if not collected:
        raise FieldcalError(ReasonCode.NOT_FOUND, "No flight that is meant left moments; a night publishes them.")
    keys = sorted({(SENSORS.index(one.sensor), one.unit_id) for one in collected})
    return [
        _refit_one([one for one in collected if (SENSORS.index(one.sensor), one.unit_id) == key], board, full)
        for key in keys
    ]


def frame_of(refits: Sequence[Refit]) -> pl.DataFrame:
    """Their rows, each with its unit and how many flights it is made of."""
    frames = [
        calibration_rows(one.rows).select(
            pl.lit(one.unit_id).alias("unit_id"), pl.lit(one.n_flights).alias("n_flights"), pl.all()
        )
        for one in refits
    ]
    return pl.concat(frames)


def _of_flights(root: Path, vehicle: str, sessions: str | None) -> list[Collected]:
    """What a vehicle's flights left, in the order in which they were flown, primary units first; what was withdrawn
    does not count."""
    warehouse = existing(root)
    rows = warehouse.scan("moments", vehicle_id=vehicle).filter("is_primary").collect()
    if rows.is_empty():
        known_vehicle(warehouse, vehicle)
    rows = rows.sort(FLOWN_ORDER, nulls_last=False)
    if sessions is not None:
        rows = _in_sessions(rows, sessions, vehicle)
    counting = as_decided("moments", rows.with_columns(status=pl.lit(str(Status.OK))), decisions(root))
    rows = counting.filter(pl.col("status") == Status.OK).drop("status")
    return [_of_row(row) for row in typed(rows_of(rows), MomentsRow)]


def _in_sessions(rows: pl.DataFrame, sessions: str, vehicle: str) -> pl.DataFrame:
    first, dots, last = sessions.partition("..")
    flown = rows["session_id"].to_list()
    for name in (first, last):
        if name and name not in flown:
            told = f"{vehicle} has no session {name!r} with moments; {nearest(name, set(flown))}."
            raise FieldcalError(ReasonCode.NOT_FOUND, told)
    start = flown.index(first) if first else 0
    until = last if dots else first
    end = len(flown) - flown[::-1].index(until) if until else len(flown)
    return rows[start:end]


def _of_row(row: MomentsRow) -> Collected:
    collected = json.loads(row["sums"])
    x, y, z = collected["polarity"]
    return Collected(
        unit_id=row["unit_id"],
        sensor=Sensor(row["sensor"]),
        magnitude=row["magnitude"],
        unit=row["unit"],
        logged_unit=row["logged_unit"],
        temperature_degc=row["temperature_degc"],
        rate_hz=row["reading_rate_hz"],
        block_samples=row["block_samples"],
        n_samples=row["n_samples"],
        n_differences=row["n_differences"],
        polarity=(x, y, z),
        centre=np.array(collected["centre"]),
        noise=np.array(collected["noise"]),
        sums=np.array(collected["sums"]),
    )


def _of_dump(sensor: Sensor, state: State, board: BoardSettings, last: dict[Sensor, Collected]) -> Collected:
    flown = last.get(sensor)
    polarities = (board.magnetometer_polarity, board.accelerometer_polarity, board.gyroscope_polarity)
    configured_hz = board.magnetometer_rate_hz if sensor == Sensor.MAGNETOMETER else board.imu_rate_hz
    of_moments = isinstance(state, Moments)
    units = {Sensor.MAGNETOMETER: board.field_unit, Sensor.ACCELEROMETER: "m/s^2", Sensor.GYROSCOPE: "rad/s"}
    return Collected(
        unit_id=DUMPED_UNIT if flown is None else flown.unit_id,
        sensor=sensor,
        magnitude=board.limits(sensor).magnitude if of_moments else None,
        unit=units[sensor],
        logged_unit=None,
        temperature_degc=None,
        rate_hz=configured_hz if flown is None else flown.rate_hz,
        block_samples=0 if isinstance(state, Moments) else state.block_samples,
        n_samples=state.n_samples,
        n_differences=state.noise.n_differences,
        polarity=polarities[SENSORS.index(sensor)],
        centre=np.zeros(3) if state.centre is None else state.centre.astype(float),
        noise=state.noise.squares,
        sums=state.values[1 : 1 + state.sums] if isinstance(state, Moments) else state.values,
    )


def _refit_one(flights: list[Collected], board: BoardSettings, full: bool) -> Refit:
    """One sensor of one unit."""
    first = flights[0]
    logged_unit = next((one.logged_unit for one in flights if one.logged_unit is not None), None)
    _require_one(flights, logged_unit)
    warm = [(one.temperature_degc, one.n_samples) for one in flights if one.temperature_degc is not None]
    fit: MomentsFit | RatesFit
    cross_sd: Array | None = None
    if first.sensor == Sensor.GYROSCOPE:
        fit = _rates(flights, board.gyroscope_max_scale_sd)
        scale, covariance, codes = np.diag(fit.scale), _by_axis(fit), fit.reason_code
    else:
        fit = _ellipsoid(flights, full, board.limits(first.sensor))
        scale, covariance, cross_sd = fit.scale, fit.covariance, fit.scale_sd
        codes = (fit.reason_code, fit.reason_code, fit.reason_code)
    rows = triad_rows(
        first.sensor,
        Method.MOMENTS,
        scale,
        fit.bias,
        covariance,
        unit=first.unit,
        logged_unit=logged_unit or "logged",
        reference_reading=np.zeros(3),
        temperature_degc=float(np.average([t for t, _ in warm], weights=[n for _, n in warm])) if warm else None,
        reason_code=codes,
        cross_sd=cross_sd,
    )
    return Refit(first.unit_id, first.sensor, len(flights), fit.n_samples, fit, rows)


def _require_one(flights: list[Collected], logged_unit: str | None) -> None:
    """Raise unless no constants of the sensor alone could tell these flights apart."""
    first = flights[0]
    for one in flights:
        length, other = one.magnitude or 0.0, first.magnitude or 0.0
        differ = abs(length - other) > SAME_MAGNITUDE * other
        if differ or one.unit != first.unit or one.logged_unit not in (None, logged_unit):
            lengths = [f"{x.magnitude or ''} {x.unit} from {x.logged_unit}".strip() for x in (first, one)]
            raise _not_one(first.sensor, f"they are fitted to {' and '.join(lengths)}")
        if one.polarity != first.polarity:
            raise _not_one(first.sensor, f"polarities are {first.polarity} and {one.polarity}")


def _noise(flights: list[Collected]) -> tuple[Array, int]:
    return np.sum([one.noise for one in flights], axis=0), sum(one.n_differences for one in flights)


def _ellipsoid(flights: list[Collected], full: bool, limits: Limits) -> MomentsFit:
    """Of a vector triad, about the first flight's centre."""
    first = flights[0]
    lacking = min(len(one.sums) for one in flights) < FULL
    if full and lacking:
        raise _not_one(first.sensor, "a dump has no moments for a full scale matrix")
    moments = np.stack([np.pad(one.sums, (1, FULL - len(one.sums))) for one in flights])
    moments[:, 0] = [one.n_samples for one in flights]
    together = translate(moments, first.centre - np.stack([one.centre for one in flights])).sum(axis=0)
    if lacking:
        together[1 + AXIS_ALIGNED :] = 0.0
    shares = moments[:, 0] / max(float(moments[:, 0].sum()), 1.0)
    own = replace(
        limits,
        magnitude=float(shares @ [one.magnitude or 0.0 for one in flights]) or float(first.magnitude or 1.0),
        polarity=first.polarity,
        full=full,
        correlated_samples=DISTURBANCE_S * float(shares @ [one.rate_hz for one in flights]),
    )
    return fit_moments(together, first.centre, *_noise(flights), own)


def _rates(flights: list[Collected], max_scale_sd: float) -> RatesFit:
    """Of the gyroscope, about the first flight's centre."""
    first = flights[0]
    sums = np.stack([one.sums for one in flights])
    by = np.stack([one.centre for one in flights]) - first.centre
    weights = np.maximum(sums[:, WEIGHT], 1e-9)
    return fit_rates(
        recentred(sums, by).sum(axis=0),
        first.centre,
        *_noise(flights),
        noise_kept=float(np.average([noise_kept(one.block_samples) for one in flights], weights=weights)),
        n_samples=sum(one.n_samples for one in flights),
        polarity=first.polarity,
        max_scale_sd=max_scale_sd,
    )


def _by_axis(fit: RatesFit) -> Array:
    """Covariance (6, 6) of scales and biases, of which only those of one axis go together."""
    out = np.diag(np.concatenate([fit.scale_sd, fit.bias_sd]) ** 2)
    for i in range(3):
        out[i, 3 + i] = out[3 + i, i] = fit.covariance[i]
    return out


def _not_one(sensor: Sensor, why: str) -> FieldcalError:
    told = (
        f"These flights are not one fit of the {sensor}: {why}. Name sessions that belong together (--sessions A..B)."
    )
    return FieldcalError(ReasonCode.NOT_ONE_FIT, told)
