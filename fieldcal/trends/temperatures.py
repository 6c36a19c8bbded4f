"""Temperatures of flights, judged before anything is regressed on them."""

from __future__ import annotations

import polars as pl

from fieldcal.schemas.reference import PLAUSIBLE_DEGC

LEAST_SESSIONS, STUCK_DEGC = 3, 0.005
"""So many sessions at one temperature, within so much, are no coincidence: the sensor is stuck."""


def judged(flights: pl.DataFrame) -> tuple[pl.DataFrame, dict[str, str]]:
    """(rows whose temperature is null where it is not to be believed, unit_id → sentence on what is not).

    `flights`: rows of whole units, as `history_in_groups` has them.
    """
    warm, unit = pl.col("temperature_degc"), "unit_id"
    low, high = PLAUSIBLE_DEGC
    possible = warm.is_between(low, high)
    by_unit = (
        flights.select(unit, "vehicle_id", "session_id", warm)
        .filter(warm.is_not_null())
        .group_by(unit, maintain_order=True)
        .agg(
            impossible=(~possible).mean(),
            sessions=pl.struct("vehicle_id", "session_id").n_unique(),
            lowest=warm.filter(possible).min(),
            highest=warm.filter(possible).max(),
        )
    )
    stuck = by_unit.filter((pl.col("highest") - pl.col("lowest") < STUCK_DEGC) & (pl.col("sessions") >= LEAST_SESSIONS))
    told = {
        unit_id: f"{100 * share:.2g} % of its temperatures are outside {low:g} to {high:g} °C and are not used."
        for unit_id, share in by_unit.filter(pl.col("impossible") > 0.0).select(unit, "impossible").iter_rows()
    }
    told |= {
        unit_id: f"Its temperature is {degc:g} °C in all {sessions} sessions: it is stuck, and not used."
        for unit_id, degc, sessions in stuck.select(unit, "lowest", "sessions").iter_rows()
    }
    believed = possible & ~pl.col(unit).is_in(stuck[unit].to_list())
    return flights.with_columns(temperature_degc=pl.when(believed).then(warm)), told


def with_notes(table: pl.DataFrame, told: dict[str, str]) -> pl.DataFrame:
    """The table `drift` with the sentences of `judged` in `reason`."""
    if not told:
        return table
    note = pl.col("unit_id").replace_strict(told, default=None, return_dtype=pl.String)
    return table.with_columns(
        reason=pl.concat_str(["reason", note], separator=" ", ignore_nulls=True).replace("", None)
    )
