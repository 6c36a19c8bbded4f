"""The corrections that a log's parameters say ArduPilot applied, sensor by sensor, piecewise in time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fieldcal.logs.dataflash.corrections import (
    NO_THERMAL,
    THERMAL_RANGE_DEGC,
    THERMAL_REFERENCE_DEGC,
    Affine,
    Thermal,
    inertial,
    inertial_before_3_3,
    magnetometer,
)
from fieldcal.logs.dataflash.orientation import CUSTOM_ANGLES, orientation_matrix
from fieldcal.logs.dataflash.parameters import InertialNames, Parameters, compass_names, inertial_names
from fieldcal.logs.interface import Correction
from fieldcal.names import Rotation, Triple

BOARD = "AHRS_ORIENTATION"
THERMAL_STEP_DEGC = 1.0
"""Where an offset depends on temperature, a new correction begins when it has changed by so much."""
GAUSS_PER_MILLIGAUSS = 1e-3
ROUNDED = 1.0
"""Ofs in MAG messages are cut to whole milligauss: COMPASS_OFS within this of them is the same."""
THERMAL_ON = 1


@dataclass(frozen=True)
class Temperatures:
    """A unit's temperature over time: (n,) ns, (n,) °C."""

    t_ns: NDArray[np.int64]
    degc: NDArray[np.float64]

    def steps(self) -> list[tuple[int, float]]:
        """(from when on, temperature) wherever it has changed by a step since the last."""
        found: list[tuple[int, float]] = []
        degc, t_ns = self.degc[np.isfinite(self.degc)], self.t_ns[np.isfinite(self.degc)]
        place = 0
        while place < len(degc):
            found.append((int(t_ns[place]), float(degc[place])))
            away = np.flatnonzero(np.abs(degc[place:] - degc[place]) > THERMAL_STEP_DEGC)
            place = place + int(away[0]) if away.size else len(degc)
        return found

    def at(self, at_ns: int) -> float:
        """The latest temperature at a time; the first before it; NaN without any."""
        finite = np.isfinite(self.degc)
        if not finite.any():
            return float("nan")
        place = int(np.searchsorted(self.t_ns[finite], at_ns, "right")) - 1
        return float(self.degc[finite][max(place, 0)])


def inertial_corrections(
    kind: str, slot: int, parameters: Parameters, first_ns: int, temperatures: Temperatures, *, before_3_3: bool = False
) -> tuple[Correction, ...]:
    """Of the gyroscope ("GYR") or accelerometer ("ACC") in a slot from `first_ns` on; () where the log does not say."""
    names = inertial_names(kind, slot)
    if not all(name in parameters for name in names.offset):
        return ()
    used = (BOARD, *(name for angles in CUSTOM_ANGLES.values() for name in angles), *names.all())
    times = {first_ns, *parameters.changes_ns(used)}
    if parameters.value(names.thermal_enable, first_ns) == THERMAL_ON:
        times |= {at_ns for at_ns, _ in temperatures.steps()}
    found = []
    for at_ns in _from(times, first_ns):
        board = _turned(parameters, BOARD, at_ns)
        if board is None:
            return ()
        offset = parameters.triple(names.offset, at_ns)
        scale = parameters.triple(names.scale, at_ns, 1.0) if names.scale else (1.0, 1.0, 1.0)
        degc = temperatures.at(at_ns)
        thermal = _thermal(names, parameters, at_ns) if np.isfinite(degc) else NO_THERMAL
        if before_3_3:
            affine = inertial_before_3_3(board, offset, scale)
        else:
            affine = inertial(
                board, offset, scale, thermal, degc if thermal is not NO_THERMAL else THERMAL_REFERENCE_DEGC
            )
        warm = degc if thermal is not NO_THERMAL else None
        found.append(_correction(at_ns, affine, parameters.held(used, at_ns), warm))
    return tuple(found)


def magnetometer_corrections(
    slot: int, parameters: Parameters, t_ns: NDArray[np.int64], offsets_mg: NDArray[np.float64] | None
) -> tuple[Correction, ...]:
    """Of the magnetometer in a slot whose messages are stamped `t_ns` (n,), sorted; () where the log does not say.

    `offsets_mg` (n, 3): the offsets that stand in the messages, cut to whole milligauss. Where they are not those of
    the parameters, as while the autopilot learns them, they count.
    """
    names = compass_names(slot)
    if not len(t_ns) or (offsets_mg is None and not all(name in parameters for name in names.offset)):
        return ()
    used = (BOARD, *names.all())
    times = {int(t_ns[0]), *parameters.changes_ns(used)}
    if offsets_mg is not None:
        times |= set(t_ns[1:][np.any(np.diff(offsets_mg, axis=0) != 0, axis=1)].tolist())
    found = []
    for at_ns in _from(times, int(t_ns[0])):
        mounting = _mounting(slot, parameters, at_ns)
        if mounting is None:
            return ()
        offset = np.array(parameters.triple(names.offset, at_ns))
        if offsets_mg is not None:
            logged = offsets_mg[max(int(np.searchsorted(t_ns, at_ns, "right")) - 1, 0)]
            offset = offset if np.all(np.abs(offset - logged) < ROUNDED) else logged
        affine = magnetometer(
            mounting,
            offset * GAUSS_PER_MILLIGAUSS,
            parameters.triple(names.diagonal, at_ns),
            parameters.triple(names.off_diagonal, at_ns),
            parameters.value(names.scale, at_ns),
        )
        found.append(_correction(at_ns, affine, parameters.held(used, at_ns), None))
    return tuple(found)


def _mounting(slot: int, parameters: Parameters, at_ns: int) -> NDArray[np.float64] | None:
    """How a magnetometer is turned: by its own parameter where it is external, else with the board."""
    names = compass_names(slot)
    if not parameters.value(names.external, at_ns):
        return _turned(parameters, BOARD, at_ns)
    return _turned(parameters, names.orientation, at_ns, "COMPASS_CUS")


def _turned(parameters: Parameters, name: str, at_ns: int, custom: str = "AHRS_CUSTOM") -> NDArray[np.float64] | None:
    """The matrix of an orientation that a parameter numbers; `custom`: how the angles of number 100 are called."""

    def angle(of: str) -> float:
        return parameters.value(of.replace("AHRS_CUSTOM", custom), at_ns)

    return orientation_matrix(int(parameters.value(name, at_ns)), angle)


def _thermal(names: InertialNames, parameters: Parameters, at_ns: int) -> Thermal:
    if parameters.value(names.thermal_enable, at_ns) != THERMAL_ON:
        return NO_THERMAL
    return Thermal(
        np.array([parameters.triple(power, at_ns) for power in names.thermal]),
        parameters.value(names.calibrated_degc, at_ns),
        parameters.value(names.thermal_min_degc, at_ns, THERMAL_RANGE_DEGC[0]),
        parameters.value(names.thermal_max_degc, at_ns, THERMAL_RANGE_DEGC[1]),
    )


def _from(times_ns: set[int], first_ns: int) -> Sequence[int]:
    """The times in order, none before the first."""
    return sorted(at_ns for at_ns in times_ns if at_ns >= first_ns)


def _correction(
    from_ns: int, affine: Affine, parameters: dict[str, float], temperature_degc: float | None
) -> Correction:
    rows = [_triple(row) for row in affine.matrix]
    matrix: Rotation = (rows[0], rows[1], rows[2])
    slope = _triple(affine.offset_per_degc)
    return Correction(from_ns, matrix, _triple(affine.offset), parameters, temperature_degc, slope)


def _triple(values: NDArray[np.float64]) -> Triple:
    x, y, z = (float(value) for value in values)
    return x, y, z
