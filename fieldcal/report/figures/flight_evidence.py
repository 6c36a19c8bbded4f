"""What a flight's estimate rests on: residuals of every sensor over time, which moment told which constant, prior
against posterior, and the methods side by side."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import polars as pl

from fieldcal.estimation.gyroscope.output_error import propagate_stretches
from fieldcal.geometry import sensor_model
from fieldcal.geometry.rotation import Array, angle_between, body_from_inertial, conjugate, multiply
from fieldcal.names import SENSORS, Json, Sensor, Status, exactness
from fieldcal.report.flight_curves import counting, finite
from fieldcal.report.flight_data import FigureSettings
from fieldcal.report.page import Plot
from fieldcal.report.plot import INK, XYZ, curve, headed, legend, panels, svg
from fieldcal.report.words import plain_name
from fieldcal.stages.attitude import sensor_attitude
from fieldcal.stages.tables import AXES, QUATERNION, constants, matrix, seconds, triad
from fieldcal.words.rows import standing

BLOCK_S = 1.0
CONTRADICTS = 3.0
"""Blocks whose residual is so many times the flight's rms are marked."""


@dataclass(frozen=True)
class Evidence:
    """Calibrated readings along the estimated attitude: `t` (n,) s, `segment` (n,), `q` (n, 4) of the sensor axes, and
    each sensor's readings (n, 3) by the method that counts, NaN where there is none."""

    t: Array
    segment: np.ndarray
    q: Array
    calibrated: Mapping[Sensor, Array]


def evidence(
    samples: pl.DataFrame, attitude: pl.DataFrame, calibration: pl.DataFrame, settings: FigureSettings
) -> Evidence | None:
    """None without a sensor that has constants."""
    calibrated = {}
    for sensor in SENSORS:
        rows = counting(calibration, sensor)
        found = None if rows.is_empty() else constants(rows, sensor, refused_too=True)
        if found is not None and finite(found):
            calibrated[sensor] = sensor_model.calibrate(matrix(samples, triad(sensor)), *found)
    if not calibrated:
        return None
    t = seconds(samples["t_ns"], int(samples["t_ns"][0]))
    q = sensor_attitude(matrix(attitude, QUATERNION), settings)
    return Evidence(t, samples["segment"].to_numpy(), q, calibrated)


def residuals(e: Evidence) -> Plot:
    """Each sensor's residual by second: the angle of field and gravity to their mean along the attitude, and of the
    integrated gyroscope to the attitude's own turn."""
    shown: dict[Sensor, Array] = {
        sensor: _vector_angle(e, z) for sensor, z in e.calibrated.items() if sensor != Sensor.GYROSCOPE
    }
    if Sensor.GYROSCOPE in e.calibrated:
        shown[Sensor.GYROSCOPE] = _turn_error(e, e.calibrated[Sensor.GYROSCOPE])
    figure, axes = panels(len(shown), 1, height_in=1.7 * len(shown) + 0.4)
    marked = 0
    for (axis,), (sensor, angle) in zip(axes, shown.items(), strict=True):
        at, block = _by_block(e.t, angle)
        curve(axis, at, block, INK["c1"], width=1.0)
        odd = block > CONTRADICTS * np.sqrt(np.mean(block**2))
        marked += int(odd.sum())
        axis.plot(at[odd], block[odd], "o", markersize=4, color=INK["c2"], linestyle="none")
        headed(axis, f"{sensor}, residual (°)")
    axes[-1][0].set_xlabel("time (s)")
    told = (
        f" {marked} seconds are more than {CONTRADICTS:.0f} times the rms: there the data contradict." if marked else ""
    )
    caption = (
        "Residuals by second with the constants that count: angle of field and gravity to their mean along the"
        f" estimated attitude, and of the integrated gyroscope to the turn of the attitude over the second.{told}"
    )
    return Plot(
        "evidence-residuals", svg(figure, "evidence-residuals", "Residuals by sensor over time", caption), caption
    )


def information(e: Evidence) -> Plot:
    """When each scale was told: the share of the information so far, axis by axis."""
    shown = {sensor: z for sensor, z in e.calibrated.items() if np.isfinite(z).any()}
    figure, axes = panels(1, len(shown), height_in=2.6)
    for axis, (sensor, z) in zip(axes[0], shown.items(), strict=True):
        # A scale's information is the square of what it multiplies, its mean apart, which the zero takes.
        square = np.nan_to_num((z - np.nanmean(z, axis=0)) ** 2)
        share = np.cumsum(square, axis=0) / np.maximum(square.sum(axis=0), 1e-300)
        for i, colour in enumerate(XYZ):
            curve(axis, e.t, 100.0 * share[:, i], colour, label=AXES[i], width=1.2)
        headed(axis, f"{sensor} (%)")
        axis.set_xlabel("time (s)")
        legend(axis)
    caption = (
        "Information about each axis' scale so far, in per cent of the flight's: steep where the motion told it, flat"
        " where it told nothing."
    )
    return Plot(
        "evidence-information", svg(figure, "evidence-information", "Information by axis over time", caption), caption
    )


def methods(calibration: pl.DataFrame) -> Plot | None:
    """Every method's scale beside the one that counts, with one sd."""
    shown = [sensor for sensor in SENSORS if not counting(calibration, sensor).filter(parameter="scale").is_empty()]
    if not shown:
        return None
    figure, axes = panels(1, len(shown), height_in=2.8)
    for axis, sensor in zip(axes[0], shown, strict=True):
        scales = calibration.filter(sensor=sensor, parameter="scale").filter(pl.col("axis").is_in(AXES))
        used = counting(calibration, sensor)["method"][0]
        reference = scales.filter(method=used).sort("axis")["value"].to_numpy()
        names = sorted(scales["method"].unique().to_list(), key=exactness)
        for number, name in enumerate(names):
            own = scales.filter(method=name).sort("axis")
            value, sd = own["value"].to_numpy(), own["sd"].to_numpy()
            worst = own.filter(pl.col("status") != Status.OK).head(1)
            why = "" if worst.is_empty() else f" ({standing('refused', worst['reason_code'][0]).partition(':')[0]})"
            axis.errorbar(
                np.arange(3) + 0.18 * (number - 0.5 * (len(names) - 1)),
                100.0 * (value / reference - 1.0),
                100.0 * sd / np.abs(reference),
                fmt="o" if not why else "x",
                color=INK[f"c{number % 4 + 1}"],
                label=plain_name(name) + why,
                markersize=4,
                capsize=2,
                linewidth=1.0,
            )
        axis.axhline(0.0, color=INK["muted"], linewidth=0.6)
        axis.set_xticks(range(3), AXES)
        headed(axis, f"{sensor}, scale (%)")
        low, high = axis.get_ylim()
        axis.set_ylim(low - 0.15 * len(names) * (high - low), high)
        legend(axis, 1, inside="lower left")
    caption = "Scales of all methods less those that count, in per cent, with one standard deviation."
    return Plot("evidence-methods", svg(figure, "evidence-methods", "Methods side by side", caption), caption)


def prior_and_posterior(calibration: pl.DataFrame, parameters: Mapping[str, Json]) -> Plot | None:
    """How much the flight added to what was known of each scale beforehand; None of counts, of which nothing was."""
    prior_sd, nominal = parameters.get("prior_scale_sd"), parameters.get("nominal_scale")
    if not isinstance(prior_sd, float) or not isinstance(nominal, Mapping):
        return None
    shown = []
    for sensor in (Sensor.GYROSCOPE, Sensor.ACCELEROMETER):
        own = counting(calibration, sensor).filter(parameter="scale").filter(pl.col("axis").is_in(AXES)).sort("axis")
        known = nominal.get(str(sensor))
        if isinstance(known, list) and own.height == 3 and own["sd"].null_count() == 0:
            shown.append((sensor, np.abs(np.array(known, dtype=float)), own))
    if not shown:
        return None
    figure, axes = panels(1, len(shown), height_in=2.5)
    for axis, (sensor, known_scale, own) in zip(axes[0], shown, strict=True):
        relative = 100.0 * (np.abs(own["value"].to_numpy()) / known_scale - 1.0)
        axis.errorbar(
            np.arange(3) - 0.1,
            np.zeros(3),
            np.full(3, 100.0 * prior_sd),
            fmt="s",
            color=INK["muted"],
            label="known before",
            capsize=3,
        )
        sd = 100.0 * own["sd"].to_numpy() / known_scale
        axis.errorbar(np.arange(3) + 0.1, relative, sd, fmt="o", color=INK["c1"], label="after the flight", capsize=3)
        axis.set_xticks(range(3), AXES)
        headed(axis, f"{sensor}, scale (% off nominal)")
        legend(axis, 2)
    caption = "What was known of each scale before the flight (one sd about the logged unit's) and after it."
    return Plot("evidence-prior", svg(figure, "evidence-prior", "Prior and posterior", caption), caption)


def _vector_angle(e: Evidence, z: Array) -> Array:
    """Angle (n,), °, of a sensed vector to its mean direction in the world of the attitude."""
    world = np.einsum("nij,ni->nj", body_from_inertial(e.q), z)
    direction = world / np.linalg.norm(world, axis=1, keepdims=True)
    mean = np.nanmean(direction, axis=0)
    cosine = direction @ mean / np.linalg.norm(mean)
    return np.asarray(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))


def _turn_error(e: Evidence, rate: Array) -> Array:
    """Angle (n,), °, that the integrated gyroscope departs from the attitude since the start of the second."""
    own = propagate_stretches(e.t, rate, e.segment)
    block = np.floor((e.t - e.t[0]) / BLOCK_S) + 1e6 * e.segment
    first = np.searchsorted(block, block)  # blocks ascend: each sample's first of its own
    turned = multiply(conjugate(own[first]), own)
    true = multiply(conjugate(e.q[first]), e.q)
    return np.asarray(np.degrees(angle_between(turned, true)))


def _by_block(t: Array, x: Array) -> tuple[Array, Array]:
    """Rms by BLOCK_S, at the blocks' middles."""
    number = np.floor((t - t[0]) / BLOCK_S).astype(int)
    valid = np.isfinite(x)
    count = np.bincount(number[valid], minlength=number[-1] + 1)
    square = np.bincount(number[valid], x[valid] ** 2, minlength=number[-1] + 1)
    filled = count > 0
    return (np.flatnonzero(filled) + 0.5) * BLOCK_S + t[0], np.sqrt(square[filled] / count[filled])
