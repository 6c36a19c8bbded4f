"""Flights of one unit that are of another sensor: it was exchanged, and nobody told.

A sensor is known by its scales. They hold to a fraction of a per cent over temperature and years, and are several per
cent apart from part to part, while a zero may step by itself. Where two axes or more have another scale, and another
flight has the same on all, another sensor was on board: a flight that is like no other was spoiled, or is the first of
its sensor, and is for the regression to judge. Trends are of the sensor that flew last; what flew besides is told and
not averaged with it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime

import numpy as np
import polars as pl

from fieldcal.geometry.rotation import Array
from fieldcal.names import DriftStatus, Sensor, exactness
from fieldcal.schemas.columns import FLOWN_ORDER
from fieldcal.stages.tables import AXES

RECOGNISED = (Sensor.GYROSCOPE, Sensor.ACCELEROMETER)
"""A magnetometer's scale goes with the field that is configured."""
OTHER_SHARE, OTHER_SD = 0.015, 6.0
"""A scale is another one's from this share of it on (temperature moves it by less), and from so many sd on."""
LEAST_AXES = 2
"""Axes whose scales are another's: one alone may be spoiled."""
SAME_SD = 3.0
"""A scale is the same from so few sd on, or less than `OTHER_SHARE` of it."""


@dataclass(frozen=True)
class Exchange:
    """What flew of a unit beside the sensor that flew last. `since`: start of that one's latest run of flights;
    `others`, `flights`: flights with others, and all; `back_and_forth`: it had flown before others did; `share`: how
    far apart the scales are at most."""

    since: datetime | None
    others: int
    flights: int
    back_and_forth: bool
    share: float

    @property
    def sentence(self) -> str:
        """For `reason`."""
        alternate = "Two sensors alternate under this id" if self.back_and_forth else "The sensor was exchanged"
        since = "" if self.since is None else f" before the flight of {self.since:%Y-%m-%d %H:%M} UTC"
        return (
            f"{alternate}{since}: scales of {self.others} of {self.flights} flights are up to {100 * self.share:.2g} % "
            "away. Only flights of the one that flew last count. Give each an imu_id and the date from which it holds."
        )


Exchanges = dict[tuple[str, str], Exchange]
"""By unit and sensor."""


def of_present_sensor(flights: pl.DataFrame) -> tuple[pl.DataFrame, Exchanges]:
    """(rows without those of flights with another sensor, (unit_id, sensor) → what was exchanged).

    `flights`: rows of whole units, as `history_in_groups` has them.
    """
    exchanged: Exchanges = {}
    dropped = []
    for (unit_id, sensor), own in _suspects(flights).group_by("unit_id", "sensor", maintain_order=True):
        scales, sd = (own.select(f"{name}_{axis}" for axis in AXES).to_numpy() for name in ("value", "sd"))
        which = _grouped(scales, sd)
        of_sensor = _confirmed(scales, sd, which)
        if not of_sensor.any():
            continue
        present = ~of_sensor | (which == which[of_sensor][-1])
        if present.all():
            continue
        since = int(np.flatnonzero(~present)[-1]) + 1
        reference = scales[present & of_sensor].mean(axis=0)
        exchanged[str(unit_id), str(sensor)] = Exchange(
            own["started_at"][since],
            int(np.sum(~present)),
            len(own),
            bool((present & of_sensor)[:since].any()),
            float(np.max(np.abs(scales[~present] / reference - 1.0))),
        )
        dropped.append(own.filter(pl.Series(~present)).select("unit_id", "sensor", "flight_id"))
    if dropped:
        flights = flights.join(
            pl.concat(dropped), on=["unit_id", "sensor", "flight_id"], how="anti", maintain_order="left"
        )
    return flights, exchanged


def told(
    table: pl.DataFrame,
    exchanged: Exchanges,
    steady: Sequence[str] = (DriftStatus.STABLE, DriftStatus.INSUFFICIENT),
) -> pl.DataFrame:
    """The table `drift` or `pooled` with what was exchanged: a unit of which one sensor flew after another has stepped,
    where its status was one of `steady`."""
    if not exchanged:
        return table
    rows = [
        {"unit_id": unit_id, "sensor": sensor, "since": one.since, "exchange": one.sentence}
        for (unit_id, sensor), one in exchanged.items()
    ]
    schema = pl.Schema(
        {"unit_id": pl.String(), "sensor": pl.String(), "since": table.schema["change_at"], "exchange": pl.String()}
    )
    both = table.join(pl.DataFrame(rows, schema=schema), on=["unit_id", "sensor"], how="left", maintain_order="left")
    other = pl.col("exchange").is_not_null()
    return both.with_columns(
        status=pl.when(other & pl.col("status").is_in([str(status) for status in steady]))
        .then(pl.lit(str(DriftStatus.STEP)))
        .otherwise("status"),
        change_at=pl.when(other).then(pl.coalesce("change_at", "since")).otherwise("change_at"),
        reason=pl.when(other)
        .then(pl.concat_str(["exchange", "reason"], separator=" ", ignore_nulls=True))
        .otherwise("reason"),
    ).select(table.columns)


def _suspects(flights: pl.DataFrame) -> pl.DataFrame:
    """Scales of each flight's most exact method, value_x … sd_z, in order of time, of units whose scales spread."""
    scales = flights.filter(
        pl.col("sensor").is_in([str(sensor) for sensor in RECOGNISED]),
        pl.col("parameter") == "scale",
        pl.col("axis").is_in(AXES),
        pl.col("sd") > 0.0,
    )
    unit = ["unit_id", "sensor"]
    spread = (
        scales.group_by(*unit, "axis")
        .agg(spread=(pl.col("value").max() - pl.col("value").min()) / pl.col("value").median().abs())
        .group_by(unit)
        .agg(wide=(pl.col("spread") > OTHER_SHARE).sum())
        .filter(pl.col("wide") >= LEAST_AXES)
    )
    if spread.is_empty():
        return _wide(scales.clear())
    own = scales.join(spread, on=unit, how="semi")
    ranks = {method: exactness(method) for method in own["method"].unique()}
    return _wide(own.with_columns(rank=pl.col("method").replace_strict(ranks, return_dtype=pl.Int64)))


def _wide(scales: pl.DataFrame) -> pl.DataFrame:
    place = ["unit_id", "sensor", *FLOWN_ORDER]
    if scales.is_empty():
        names = [f"{name}_{axis}" for name in ("value", "sd") for axis in AXES]
        return scales.select(place).with_columns(pl.lit(None, pl.Float64).alias(name) for name in names)
    columns = [
        pl.col(name).filter(pl.col("axis") == axis).first().alias(f"{name}_{axis}")
        for name in ("value", "sd")
        for axis in AXES
    ]
    whole = scales.group_by(*place, "rank").agg(columns).drop_nulls([f"value_{axis}" for axis in AXES])
    return whole.sort(*place, "rank", nulls_last=False).unique(place, keep="first", maintain_order=True)


def _grouped(scales: Array, sd: Array) -> np.ndarray:
    """Number (n,) of the sensor that each flight is of, by its scales (n, 3): the nearest known one, or a new one."""
    which = np.zeros(len(scales), dtype=int)
    if _all_alike(scales, sd):
        return which
    known: list[list[int]] = []
    for flight in range(len(scales)):
        distances = [_distance(scales, sd, flight, members) for members in known]
        alike = [number for number, distance in enumerate(distances) if np.isfinite(distance)]
        if alike:
            which[flight] = min(alike, key=distances.__getitem__)
            known[which[flight]].append(flight)
        else:
            which[flight] = len(known)
            known.append([flight])
    return which


def _confirmed(scales: Array, sd: Array, which: np.ndarray) -> np.ndarray:
    """Whether each flight (n,) is of a sensor of which two have the same scales on every axis."""
    out = np.zeros(len(which), dtype=bool)
    for number in range(which.max() + 1):
        members = np.flatnonzero(which == number)
        for place, one in enumerate(members[:-1]):
            others = members[place + 1 :]
            off = np.abs(scales[others] - scales[one])
            same = (off < OTHER_SHARE * np.abs(scales[one])) | (off < SAME_SD * np.hypot(sd[others], sd[one]))
            if same.all(axis=1).any():
                out[members] = True
                break
    return out


def _all_alike(scales: Array, sd: Array) -> bool:
    """Whether no flight is another sensor's than the mean of those before it: most units fly with one, and are not
    compared flight by flight."""
    weight = 1.0 / sd**2
    before = np.cumsum(weight, axis=0)[:-1]
    mean = np.cumsum(weight * scales, axis=0)[:-1] / before
    off = scales[1:] - mean
    other = (np.abs(off) > OTHER_SHARE * np.abs(mean)) & (off**2 > OTHER_SD**2 * (1.0 / before + sd[1:] ** 2))
    return not (np.sum(other, axis=1) >= LEAST_AXES).any()


def _distance(scales: Array, sd: Array, flight: int, members: list[int]) -> float:
    """How far a flight is from a sensor's mean, in squares of sd; infinite where it is another one's."""
    weight = 1.0 / sd[members] ** 2
    mean, variance = np.average(scales[members], axis=0, weights=weight), 1.0 / weight.sum(axis=0)
    off = scales[flight] - mean
    z2 = off**2 / (variance + sd[flight] ** 2)
    other = (np.abs(off) > OTHER_SHARE * np.abs(mean)) & (z2 > OTHER_SD**2)
    return float("inf") if np.sum(other) >= LEAST_AXES else float(z2.sum())
