"""Charts of a flight's page: readings as logged and calibrated, temperature, attitude; thinned for the eye."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import polars as pl

from fieldcal.geometry import rotation, sensor_model
from fieldcal.geometry.rotation import Array
from fieldcal.names import INERTIAL_FIRST, Sensor
from fieldcal.report.flight_curves import counting, finite
from fieldcal.report.flight_data import FlightData
from fieldcal.report.page import Notice, Part, Plot, Section, Text
from fieldcal.report.words import logged_unit
from fieldcal.site.charts import Chart, Charts, Curve, Panel, View
from fieldcal.stages.tables import AXES, QUATERNION, constants, matrix, seconds, triad

SHARES = 300
STEPS_OF_A_RANGE = 1e4
"""Values of a thinned curve are rounded to no coarser than this part of what it spans: finer than a screen shows."""
TABLE_OF = {Sensor.GYROSCOPE: "imu", Sensor.ACCELEROMETER: "imu", Sensor.MAGNETOMETER: "magnetometer"}
SIGNALS = ("imu", "magnetometer", "temperature")
ATTITUDES = ("joint.trajectory", "attitude_pass2.attitude")
THINNED = (
    f"Curves: the least and the greatest of each of {SHARES} shares of the flight, to a {STEPS_OF_A_RANGE:,.0f}th of"
    " what they span."
)
X_NAME = "time since the first reading (s)"


def sections(data: FlightData, charts: Charts) -> list[Section]:
    """The figures of a flight, drawn into `charts`."""
    imu = data.tables.get("ingest.imu")
    if imu is None or imu.is_empty():
        return [Section("figures", "Readings", [Text("The readings are not stored: there is nothing to draw.")])]
    origin = int(imu["t_ns"][0])
    parts: list[Part] = [_readings(data, sensor, origin, charts) for sensor in INERTIAL_FIRST]
    parts.append(_temperature(data, origin, charts))
    if data.gone:
        parts.append(Notice(f"The stored tables of {', '.join(data.gone)} are gone: the next night makes them anew."))
    told = Text(f"{THINNED} fieldcal report --flight {data.flight['flight_id']} draws Figures 5–10 of the paper.")
    return [
        Section("figures", "Readings", [told, *parts]),
        Section("attitude", "Attitude", [_attitude(data, origin, charts)]),
    ]


def _readings(data: FlightData, sensor: Sensor, origin: int, charts: Charts) -> Plot | Text:
    table = data.tables.get(f"ingest.{TABLE_OF[sensor]}")
    logged = None if table is None else matrix(table, triad(sensor))
    if table is None or logged is None or not np.isfinite(logged).any():
        return Text(f"The log has no readings of the {sensor}.")
    t = seconds(table["t_ns"], origin)
    views = [_view("as logged", t, logged, logged_unit(data.units.get(sensor)))]
    own = _calibration(data, sensor)
    if own is not None:
        views.insert(0, _view("calibrated", t, sensor_model.calibrate(logged, *own[0]), own[1]))
    caption = f"{sensor.capitalize()}, sensor axes as logged, not smoothed." + (
        " Calibrated by the constants of this flight that count." if own else " The flight has no constants of it."
    )
    return charts.plot(Chart(f"readings-{sensor}", sensor.capitalize(), views), caption)


def _calibration(data: FlightData, sensor: Sensor) -> tuple[tuple[Array, Array], str] | None:
    """Scale, bias and unit of what they give; None without constants of every axis."""
    rows = counting(data.calibration, sensor)
    if rows["value"].null_count():
        rows = rows.filter(pl.col("value").is_not_null())
    unit = {(p, a): unit for p, a, unit in rows.select("parameter", "axis", "unit").iter_rows()}
    if not unit.keys() >= {(p, a) for p in ("scale", "bias") for a in AXES}:
        return None
    own = constants(rows, sensor, refused_too=True)
    return None if own is None or not finite(own) else (own, logged_unit(unit["bias", "x"]))


def _view(name: str, t: Array, values: Array, own_unit: str) -> View:
    x, y = envelope(t, values)
    curves = [Curve(axis, "line", x, y[:, i]) for i, axis in enumerate(AXES)]
    return View(name, X_NAME, [Panel("", own_unit, curves)])


def _temperature(data: FlightData, origin: int, charts: Charts) -> Plot | Text:
    table = data.tables.get("ingest.temperature")
    if table is None or table.is_empty():
        return Text("The log has no temperature.")
    x, y = envelope(seconds(table["t_ns"], origin), matrix(table, ["temperature_degc"]))
    view = View("as logged", X_NAME, [Panel("", "°C", [Curve("temperature", "line", x, y[:, 0])])])
    return charts.plot(Chart("temperature", "Temperature", [view]), "Temperature of the IMU, as logged.")


def _attitude(data: FlightData, origin: int, charts: Charts) -> Plot | Text:
    name = next((one for one in ATTITUDES if one in data.tables and not data.tables[one].is_empty()), None)
    if name is None:
        return Text("No attitude was estimated; refusals above say why.")
    table = data.tables[name]
    angles = np.degrees(rotation.euler_angles(matrix(table, QUATERNION)))
    x, y = envelope(seconds(table["t_ns"], origin), angles)
    panels = [Panel(axis, "°", [Curve(axis, "line", x, y[:, i])]) for i, axis in enumerate(("roll", "pitch", "yaw"))]
    how = "of the joint estimate" if name == ATTITUDES[0] else "from the two vectors"
    caption = f"Attitude {how}, NED to body, in the stretches that were used."
    return charts.plot(Chart("attitude-angles", "Attitude", [View("angles", X_NAME, panels)]), caption)


def envelope(t: Array, values: Array, shares: int = SHARES) -> tuple[Array, Array]:
    """Least and greatest of (n, m) values in each of `shares` parts of (n,) stamps, in the order of their occurrence,
    (≤ 2·shares + gaps,) and (…, m), rounded for the eye. NaN stands where samples are missing for more than a share
    and 10 intervals."""
    keep = np.isfinite(values).any(axis=1)
    t, values = t[keep], values[keep]
    if len(t) > 2 * shares:
        edges = np.linspace(t[0], t[-1], shares + 1)
        starts = np.unique(np.searchsorted(t, edges[:-1], side="left"))
        sizes = np.diff(np.append(starts, len(t)))
        share = np.repeat(np.arange(len(starts)), sizes)
        out = np.empty((len(starts), 2, values.shape[1]))
        for column in range(values.shape[1]):
            out[:, :, column] = _extremes(values[:, column], starts, share)
        quarter = starts + sizes // 4
        x = np.column_stack([t[quarter], t[np.minimum(starts + 3 * sizes // 4, starts + sizes - 1)]]).ravel()
        x[1::2] = np.maximum(x[1::2], x[::2])
        t, values = rounded(x), rounded(out.reshape(-1, values.shape[1]))
    if len(t) < 3:
        return t, values
    step = np.diff(t)
    after = np.flatnonzero(step > max(10.0 * float(np.median(step)), (t[-1] - t[0]) / shares)) + 1
    return np.insert(t, after, t[after - 1]), np.insert(values, after, np.nan, axis=0)


def rounded(values: Array) -> Array:
    """(…) values of (n,) or columns of (n, m), each to a power of ten that is at most a `STEPS_OF_A_RANGE`th of what it
    spans; NaN stays."""
    span = np.nanmax(values, axis=0, initial=-np.inf) - np.nanmin(values, axis=0, initial=np.inf)
    fine = np.where(np.isfinite(span) & (span > 0.0), span, 1.0) / STEPS_OF_A_RANGE
    per_unit = 10.0 ** -np.floor(np.log10(fine))
    return np.asarray(np.round(values * per_unit) / per_unit)


def _extremes(x: Array, starts: np.ndarray, share: np.ndarray) -> Array:
    """(k, 2) least and greatest of each share, the earlier first."""
    low = np.fmin.reduceat(x, starts)
    high = np.fmax.reduceat(x, starts)
    n = len(x)
    order = np.arange(n)
    at_low = np.minimum.reduceat(np.where(x == low[share], order, n), starts)
    at_high = np.minimum.reduceat(np.where(x == high[share], order, n), starts)
    first = at_low <= at_high
    return np.column_stack([np.where(first, low, high), np.where(first, high, low)])


def wanted(stages: Sequence[str]) -> tuple[str, ...]:
    """The table of a flight's stages that its page needs: the attitude that is there."""
    return next(((name,) for name in ATTITUDES if name.split(".")[0] in stages), ())
