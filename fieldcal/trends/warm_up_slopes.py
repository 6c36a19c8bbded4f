"""What warm-up flights say of a zero's slope on temperature, brought to the series whose slope it is."""

from __future__ import annotations

import numpy as np
import polars as pl

from fieldcal.estimation.warm_up import SCALE_PER_DEGC_SD
from fieldcal.geometry.rotation import Array
from fieldcal.stages.beside.warm_up import METHOD, PARAMETER
from fieldcal.trends.regression import Trends, pooled
from fieldcal.trends.series import Histories

DISAGREE_SIGMAS = 3.0
"""Flights that warm up and flights at different temperatures are not combined when their slopes are further apart: a
warm-up's gradients inside the IMU are then part of its slope."""


def slopes_of_warm_ups(h: Histories, rows: pl.DataFrame, trends: Trends) -> tuple[Array, Array] | None:
    """(slope per °C, sd), each (g,), of the series `zero` and `zero_bias` from flights that warmed up; NaN elsewhere.

    `zero_per_degc` is pooled over flights with its scatter. It is the slope of `zero`; of `zero_bias` = −λ (zero − d0)
    it is −λ times, and the slope of the scale adds λ'/λ zero_bias, of which the usual size is in the sd. None where no
    flight warmed up.
    """
    told = ((rows["method"] == METHOD) & (rows["parameter"] == PARAMETER)).to_numpy()
    if not told.any():
        return None
    fitted = told[h.row]
    series, number = np.unique(h.row[fitted], return_inverse=True)
    mean, sd = pooled(
        Histories(
            number, h.session[fitted], h.time_day[fitted], h.temperature_degc[fitted], h.value[fitted], h.sd[fitted]
        )
    )
    key = ["unit_id", "sensor", "axis"]
    found = rows[series].select(key).with_columns(warm=pl.Series(mean), warm_sd=pl.Series(sd))
    table = rows.with_columns(value=pl.Series(trends.value))
    scale = table.filter(pl.col("parameter") == "scale").select(*key, "method", factor=-pl.col("value"))
    joined = (
        rows.join(found, on=key, how="left", maintain_order="left")
        .join(scale, on=[*key, "method"], how="left", maintain_order="left")
        .with_columns(
            factor=pl.when(pl.col("parameter") == "zero")
            .then(1.0)
            .when(pl.col("parameter") == "zero_bias")
            .then(pl.col("factor"))
        )
    )
    slope = (joined["warm"] * joined["factor"]).fill_null(np.nan).to_numpy()
    slope_sd = (joined["warm_sd"] * joined["factor"].abs()).fill_null(np.nan).to_numpy()
    of_scale = np.where(rows["parameter"] == "zero_bias", SCALE_PER_DEGC_SD * np.abs(trends.value), 0.0)
    slope_sd = np.hypot(slope_sd, of_scale)
    with np.errstate(invalid="ignore"):
        apart = np.abs(slope - trends.slope_per_degc) > DISAGREE_SIGMAS * np.hypot(slope_sd, trends.slope_per_degc_sd)
    return np.where(apart, np.nan, slope), np.where(apart, np.nan, slope_sd)
