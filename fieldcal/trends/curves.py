"""Curves of the gyroscope's zero over temperature: from warm-up flights and sessions to the series that they bend."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import polars as pl

from fieldcal.estimation.warm_up import SCALE_PER_DEGC_SD
from fieldcal.geometry.rotation import Array
from fieldcal.names import Status
from fieldcal.schemas.reference import REFERENCE_DEGC
from fieldcal.stages.beside.warm_up import CURVE, METHOD, PARAMETER
from fieldcal.trends.regression import Trends
from fieldcal.trends.series import Histories
from fieldcal.trends.temperature_curve import ORDER, Curve, about_reference, combined, of_sessions, together, widening
from fieldcal.warehouse import Warehouse
from fieldcal.warehouse.decisions.withdrawn import counting

Source = tuple[Array, Array]
"""Coefficients (3,) at 25 °C and their information (3, 3)."""
Bends = Mapping[tuple[str, str, str], Source]
"""What each warm-up flight says: (flight, unit, axis) → source, in logged units."""


@dataclass(frozen=True)
class Bent:
    """Histories with their bends taken off, what warm-up flights say of the slope at 25 °C then, (g,), NaN where
    nothing; coefficients of the square and the cube, (g, 2), and their sd, NaN where the line is straight; by how much
    that they are estimated widens the sd of the value and of the slope (g, 2)."""

    histories: Histories
    slope: Array
    slope_sd: Array
    bend: Array
    bend_sd: Array
    wider: Array

    def widened(self, trends: Trends) -> Trends:
        """Trends of `histories` with the uncertainty of the bends in their sd."""
        sd, slope_sd = trends.sd * self.wider[:, 0], trends.slope_per_degc_sd * self.wider[:, 1]
        return replace(trends, sd=sd, slope_per_degc_sd=slope_sd)


def bends_of(root: Path) -> Bends:
    """Every warm-up flight's curve, from the measured numbers of its run."""
    runs = (
        Warehouse(root)
        .scan("run")
        .filter(
            (pl.col("stage") == METHOD) & (pl.col("status") == Status.OK),
            counting(root),
        )
    )
    found: dict[tuple[str, str, str], Source] = {}
    for flight_id, unit_id, text in runs.select("flight_id", "unit_id", "measured").collect().iter_rows():
        curve = json.loads(text or "{}").get(CURVE)
        if curve is None:
            continue
        for i, axis in enumerate("xyz"):
            cubic = np.array(curve["coefficients"][i]), np.array(curve["covariance"][i])
            if np.linalg.matrix_rank(cubic[1], hermitian=True) == ORDER:
                found[flight_id, unit_id, axis] = about_reference(*cubic, curve["centre_degc"], curve["width_degc"])
    return found


def bent(h: Histories, rows: pl.DataFrame, trends: Trends, warm: Mapping[tuple[str, str], Source]) -> Bent | None:
    """The bends of `zero` and `zero_bias`, where warm-up flights, or they and the sessions together, show one.

    `warm`: as `warm_up_flights`. A unit that stepped is judged by its warm-up flights alone. None where no series is
    bent.
    """
    if not warm:
        return None
    place = {key: i for i, key in enumerate(rows.select("unit_id", "method", "parameter", "axis").iter_rows())}
    gyroscope = (rows["sensor"] == "gyroscope").to_numpy()
    value = h.value.copy()
    slope, slope_sd = np.full(len(rows), np.nan), np.full(len(rows), np.nan)
    bend, bend_sd, wider = np.full((len(rows), 2), np.nan), np.full((len(rows), 2), np.nan), np.ones((len(rows), 2))
    for (unit_id, method, parameter, axis), i in place.items():
        if parameter != "zero" or not gyroscope[i] or (unit_id, axis) not in warm:
            continue
        curve = combined(warm[unit_id, axis], _sessions(h, i, trends))
        if curve is None:
            continue
        warm_slope = _slope_given(curve, warm[unit_id, axis]) if curve.agrees is not False else (np.nan, np.nan)
        lever = {"zero": 1.0}
        if (scale := place.get((unit_id, method, "scale", axis))) is not None:
            lever["zero_bias"] = -float(trends.value[scale])
        for name, factor in lever.items():
            j = place.get((unit_id, method, name, axis))
            if j is None or not np.isfinite(factor):
                continue
            members = _members(h, j)
            warmer = np.nan_to_num(h.temperature_degc[members] - REFERENCE_DEGC)
            value[members] -= factor * (curve.coefficients[1] * warmer**2 + curve.coefficients[2] * warmer**3)
            of_scale = SCALE_PER_DEGC_SD * abs(float(trends.value[j])) if name == "zero_bias" else 0.0
            slope[j], slope_sd[j] = factor * warm_slope[0], np.hypot(factor * warm_slope[1], of_scale)
            members, variance = _flights(h, j, trends)
            by_warm_up = None if curve.agrees is False else warm[unit_id, axis][1] / factor**2
            wider[j] = widening(h.temperature_degc[members], h.time_day[members], variance, by_warm_up)
            bend[j], bend_sd[j] = factor * curve.coefficients[1:], abs(factor) * curve.sd[1:]
    if np.isnan(bend).all():
        return None
    return Bent(replace(h, value=value), slope, slope_sd, bend, bend_sd, wider)


def warm_up_flights(flights: pl.DataFrame, bends: Bends) -> dict[tuple[str, str], Source]:
    """Of rows of flights, (unit, axis) → its warm-up flights' cubics combined; their scatter about the mean widens the
    sd."""
    fitted = flights.filter(sensor="gyroscope", method=METHOD, parameter=PARAMETER)
    sources: dict[tuple[str, str], list[Source]] = {}
    for unit_id, flight_id, axis in fitted.select("unit_id", "flight_id", "axis").iter_rows():
        if (flight_id, unit_id, axis) in bends:
            sources.setdefault((unit_id, axis), []).append(bends[flight_id, unit_id, axis])
    result = {}
    for key, several in sources.items():
        cubics = np.stack([c for c, _ in several]), np.stack([n for _, n in several])
        c, information, squares, freedom = together(*cubics)
        result[key] = c, information / max(1.0, squares / freedom if freedom else 1.0)
    return result


def _sessions(h: Histories, row: int, trends: Trends) -> Source | None:
    """The cubic of flights at different temperatures; None where it cannot be fitted."""
    members, variance = _flights(h, row, trends)
    if np.isfinite(trends.change_size[row]) or not (variance > 0.0).all():
        return None
    return of_sessions(h.temperature_degc[members], h.time_day[members], h.value[members], variance)


def _flights(h: Histories, row: int, trends: Trends) -> tuple[np.ndarray, Array]:
    """Flights of a row that count, and their variance with the scatter between sessions."""
    members = _members(h, row)
    complete = np.isfinite(h.temperature_degc[members]) & np.isfinite(h.sd[members]) & np.isfinite(h.time_day[members])
    members = members[trends.kept[members] & complete]
    scatter = np.nan_to_num(trends.session_sd[row]) ** 2 + np.nan_to_num(trends.flight_sd[row]) ** 2
    return members, np.maximum(h.sd[members] ** 2 + scatter, 1e-300)


def _members(h: Histories, row: int) -> np.ndarray:
    return np.arange(*np.searchsorted(h.row, (row, row + 1)))


def _slope_given(curve: Curve, warm: Source) -> tuple[float, float]:
    """(c1, sd) of the warm-up flights alone, given square and cube; the sessions' is in the regression."""
    c, information = warm
    first = float(information[0, 0])
    return float((information[0] @ c - information[0, 1:] @ curve.coefficients[1:]) / first), 1.0 / np.sqrt(first)
