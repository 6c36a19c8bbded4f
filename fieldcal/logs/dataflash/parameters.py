"""ArduPilot's parameters as a log has them: every value from when on, and how those of a sensor are called."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from fieldcal.logs.dataflash.records import Rows
from fieldcal.names import Triple

AUTOPILOT: Final = "ardupilot"


class Parameters:
    """Values piecewise in time.

    A log writes out all parameters within its first seconds, and each again when it changes: the first value of a
    parameter holds from the start.

    Parameters
    ----------
    rows : Rows or None
        The PARM messages.
    t_ns : (n,) int64
        Their stamps.
    """

    def __init__(self, rows: Rows | None, t_ns: Iterable[int]) -> None:
        self._history: dict[str, list[tuple[int, float]]] = {}
        if rows is None or "Value" not in rows or not rows.has_text("Name"):
            return
        for name, value, at_ns in zip(rows.texts("Name"), rows.numbers("Value").tolist(), t_ns, strict=True):
            history = self._history.setdefault(name, [])
            if np.isfinite(value) and (not history or history[-1][1] != value):
                history.append((at_ns, value))
        for history in self._history.values():
            history.sort(key=lambda change: change[0])

    @classmethod
    def of(cls, values: Mapping[str, float]) -> Parameters:
        """Those that hold all the time."""
        parameters = cls(None, ())
        parameters._history = {name: [(0, value)] for name, value in values.items()}
        return parameters

    def __contains__(self, name: str) -> bool:
        return bool(self._history.get(name))

    def value(self, name: str, at_ns: int, default: float = 0.0) -> float:
        """The value that holds at `at_ns`; `default` where the log has no such parameter."""
        history = self._history.get(name)
        if not history:
            return default
        return history[max(bisect_right(history, at_ns, key=lambda change: change[0]) - 1, 0)][1]

    def first(self, name: str, default: float = 0.0) -> float:
        """The value with which the log begins; `default` where it has no such parameter."""
        history = self._history.get(name)
        return history[0][1] if history else default

    def triple(self, names: Triad, at_ns: int, default: float = 0.0) -> Triple:
        """The values of three axes that hold at `at_ns`."""
        x, y, z = (self.value(name, at_ns, default) for name in names)
        return x, y, z

    def changes_ns(self, names: Iterable[str]) -> list[int]:
        """When any of these parameters took another value than its first, sorted."""
        return sorted({at_ns for name in names for at_ns, _ in self._history.get(name, ())[1:]})

    def held(self, names: Iterable[str], at_ns: int) -> dict[str, float]:
        """Of these parameters those that the log has, as they are at `at_ns`."""
        return {name: self.value(name, at_ns) for name in names if name in self}

    def last(self, names: Iterable[str]) -> dict[str, float]:
        """Of these parameters those that the log has, as they are at its end."""
        return {name: self._history[name][-1][1] for name in names if name in self}


Triad = tuple[str, str, str]
"""Names of the parameters of three axes."""


@dataclass(frozen=True)
class InertialNames:
    """Parameters of the gyroscope or the accelerometer in one slot. `scale`: None for gyroscopes, which have none.

    `thermal`: coefficients of the first, second and third power of the temperature.
    """

    device_id: str
    use: str
    offset: Triad
    scale: Triad | None
    calibrated_degc: str
    thermal_enable: str
    thermal_min_degc: str
    thermal_max_degc: str
    thermal: tuple[Triad, Triad, Triad]

    def all(self) -> tuple[str, ...]:
        """Every parameter that a correction depends on."""
        coefficients = [name for power in self.thermal for name in power]
        limits = (self.calibrated_degc, self.thermal_enable, self.thermal_min_degc, self.thermal_max_degc)
        return (*self.offset, *(self.scale or ()), *limits, *coefficients)

    def loaded(self) -> tuple[str, ...]:
        """Every parameter that tells what is calibrated for the sensor, and whether it stays so."""
        return (self.device_id, self.use, *self.all(), *(("INS_GYR_CAL",) if self.scale is None else ()))


def inertial_names(kind: str, slot: int) -> InertialNames:
    """Names of slot 0, 1, … of `kind`, "GYR" or "ACC". From the fourth slot on they are named by another rule."""
    if slot < 3:
        number = "" if slot == 0 else str(slot + 1)
        stem, identity, calibrated = f"INS_{kind}{number}", f"INS_{kind}{number}_ID", f"INS_{kind}{slot + 1}_CALTEMP"
        use, thermal = f"INS_USE{number}", f"INS_TCAL{slot + 1}_"
    else:
        group = f"INS{slot + 1}_"
        stem, identity, calibrated = f"{group}{kind}", f"{group}{kind}_ID", f"{group}{kind}_CALTEMP"
        use, thermal = f"{group}USE", f"{group}TCAL_"
    return InertialNames(
        identity,
        use,
        triad(f"{stem}OFFS"),
        triad(f"{stem}SCAL") if kind == "ACC" else None,
        calibrated,
        f"{thermal}ENABLE",
        f"{thermal}TMIN",
        f"{thermal}TMAX",
        (triad(f"{thermal}{kind}1"), triad(f"{thermal}{kind}2"), triad(f"{thermal}{kind}3")),
    )


@dataclass(frozen=True)
class CompassNames:
    """Parameters of the magnetometer in one slot. `orientation` counts where `external` is not 0, else the board's.

    `motor`: what is added to it by current or throttle, as COMPASS_MOTCT says."""

    device_id: str
    use: str
    offset: Triad
    diagonal: Triad
    off_diagonal: Triad
    scale: str
    orientation: str
    external: str
    motor: Triad

    def all(self) -> tuple[str, ...]:
        """Every parameter that a correction depends on."""
        return (*self.offset, *self.diagonal, *self.off_diagonal, self.scale, self.orientation, self.external)

    def loaded(self) -> tuple[str, ...]:
        """Every parameter that tells what is calibrated for the sensor, and whether it stays so."""
        return (self.device_id, self.use, *self.all(), *self.motor, "COMPASS_MOTCT", "COMPASS_LEARN")


def compass_names(slot: int) -> CompassNames:
    """Names of slot 0, 1, 2."""
    number = "" if slot == 0 else str(slot + 1)
    return CompassNames(
        f"COMPASS_DEV_ID{number}",
        f"COMPASS_USE{number}",
        triad(f"COMPASS_OFS{number}"),
        triad(f"COMPASS_DIA{number}"),
        triad(f"COMPASS_ODI{number}"),
        f"COMPASS_SCALE{number}",
        f"COMPASS_ORIENT{number}",
        "COMPASS_EXTERNAL" if slot == 0 else f"COMPASS_EXTERN{number}",
        triad(f"COMPASS_MOT{number}"),
    )


def triad(stem: str) -> Triad:
    """Names of three axes."""
    return f"{stem}_X", f"{stem}_Y", f"{stem}_Z"
