"""What logs of autopilots have in common: several units on board, gyroscope and accelerometer logged apart, readings
that were corrected before they were logged, simulations."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fieldcal.logs.interface import Columns, LogSummary, SensorSource
from fieldcal.logs.joining import imu_columns
from fieldcal.logs.on_board import tell_further_units
from fieldcal.reason_codes import ReasonCode

MOST_INTERVALS_APART = 2.5
"""An accelerometer's reading is interpolated between two that are at most so many of its usual intervals apart."""


@dataclass(frozen=True)
class Joined:
    """Gyroscope and accelerometer as rows at the gyroscope's stamps.

    `columns`: those of table "imu". `interpolated`: rows whose accelerometer lies between two of its readings.
    `left_out`: gyroscope readings in a pause of the accelerometer. `outside`: those before its first or after its last.
    """

    columns: Columns
    interpolated: int = 0
    left_out: int = 0
    outside: int = 0


def join_on_gyroscope(
    gyroscope_ns: NDArray[np.int64],
    gyroscope: NDArray[np.float64],
    accelerometer_ns: NDArray[np.int64],
    accelerometer: NDArray[np.float64],
) -> Joined:
    """Rows of an IMU whose two sensors are logged apart.

    Where both have one stamp, the readings are as logged. Elsewhere the accelerometer is interpolated linearly, never
    across a pause of more than `MOST_INTERVALS_APART` usual intervals and never beyond its first and last reading.

    Parameters
    ----------
    gyroscope_ns, accelerometer_ns : (n,), (m,) int64
        Stamps of one clock, in any order.
    gyroscope, accelerometer : (n, 3), (m, 3)
        Readings, any unit.
    """
    stamps, first = np.unique(accelerometer_ns, return_index=True)  # of a stamp that repeats, its first reading
    if not len(stamps) or not len(gyroscope_ns):
        return Joined(imu_columns(gyroscope_ns[:0], gyroscope[:0], accelerometer[:0]), outside=len(gyroscope_ns))
    values = accelerometer[first]
    after = np.searchsorted(stamps, gyroscope_ns)
    exact = stamps[np.minimum(after, len(stamps) - 1)] == gyroscope_ns
    before = np.where(exact, after, after - 1)
    inside = (before >= 0) & (after < len(stamps))
    before, after = np.clip(before, 0, None), np.minimum(after, len(stamps) - 1)
    apart = stamps[after] - stamps[before]
    usual = float(np.median(np.diff(stamps))) if len(stamps) > 1 else 0.0
    kept = inside & (apart <= MOST_INTERVALS_APART * usual)
    kept |= exact
    share = np.where(exact, 0.0, (gyroscope_ns - stamps[before]) / np.maximum(apart, 1))[kept, None]
    low, high = values[before[kept]], values[after[kept]]
    between = np.where(share == 0.0, low, low + share * (high - low))
    return Joined(
        imu_columns(gyroscope_ns[kept], gyroscope[kept], between),
        int(np.count_nonzero(kept & ~exact)),
        int(np.count_nonzero(inside & ~kept)),
        int(np.count_nonzero(~inside)),
    )


def tell_join(
    summary: LogSummary, log_name: str, stream: str, *, interpolated: int, left_out: int, outside: int
) -> None:
    """Findings on rows that were joined from two streams; numbers as `Joined` has them."""
    if interpolated:
        summary.add(
            ReasonCode.INTERPOLATED,
            interpolated,
            f"{log_name}: {stream} has gyroscope and accelerometer at different times; in {interpolated} rows the "
            "accelerometer is interpolated to the gyroscope's time.",
        )
    if left_out or outside:
        summary.add(
            ReasonCode.INCOMPLETE_ROW,
            left_out + outside,
            f"{log_name}: {left_out + outside} gyroscope readings of {stream} have no accelerometer reading around "
            f"them ({outside} of them before its first or after its last) and were left out.",
            loses_data=left_out > 0,
        )


def unit_ids(device_ids: Sequence[int | None], what: str, summary: LogSummary, log_name: str) -> list[str]:
    """A name for each unit of one kind, in order of their instances: its device id; where the log gives none, or the
    same to two, the instance.

    `what` names the kind in the finding's sentence ("IMU", "magnetometer").
    """
    known = [number for number in device_ids if number]
    shared = sorted({number for number in known if known.count(number) > 1})
    if shared:
        ids = ", ".join(map(str, shared))
        summary.add(
            ReasonCode.SHARED_DEVICE_ID,
            sum(number in shared for number in known),
            f"{log_name}: several of its {what}s have the device id {ids}; they are told apart by their instance, "
            "which is another one's after a change of hardware.",
        )
    return [
        str(number) if number and number not in shared else f"instance-{instance}"
        for instance, number in enumerate(device_ids)
    ]


def tell_sources(summary: LogSummary, log_name: str, advice: str) -> None:
    """Findings on `summary.sources`: which readings were corrected before they were logged, and further units.

    `advice`: a sentence, what to log instead for raw readings.
    """
    corrected = [source for source in summary.sources if source.primary and source.corrected]
    unknown = " The log does not tell which of its units they are of, and so which parameters held."
    if corrected:
        told = "" if all(one.parameters for source in corrected for one in source.corrections) else unknown
        summary.add(
            ReasonCode.ALREADY_CORRECTED,
            1,
            f"{log_name}: {_listed(corrected)} had been corrected by the autopilot by its parameters; "
            f"published are constants of the raw sensor, composed with those parameters; rows residual_… hold for the "
            f"readings as logged.{told} {advice}",
        )
    tell_further_units(summary, log_name)


def tell_simulated(summary: LogSummary, log_name: str, why: str, *, expected: bool) -> None:
    """Finding on a log without real sensors, as `why` says; fatal unless its vehicle is a simulated one."""
    summary.add(
        ReasonCode.SIMULATED,
        1,
        f"{log_name} is of a simulation ({why}): its sensors are not real. "
        + (
            "It is read as one."
            if expected
            else "Nothing of it is published as a flight; if the vehicle is a simulated one, set simulated = true in "
            "its table of fieldcal.toml."
        ),
        fatal=not expected,
    )


def _listed(sources: Iterable[SensorSource]) -> str:
    streams: dict[str, list[str]] = {}
    for source in sources:
        streams.setdefault(source.stream, []).append(str(source.sensor))
    return "; ".join(f"{' and '.join(sensors)} ({stream})" for stream, sensors in streams.items())
