"""The temperature of a unit over a log: its range, and whether it can be one."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fieldcal.logs.interface import Finding
from fieldcal.reason_codes import ReasonCode
from fieldcal.schemas.reference import PLAUSIBLE_DEGC


@dataclass
class Warmth:
    """A temperature over a log, °C. It is one if most readings are such as an inertial sensor may have."""

    rows: int = 0
    possible: int = 0
    total: float = 0.0
    lowest: float = math.inf
    highest: float = -math.inf

    def add(self, degc: NDArray[np.float64]) -> None:
        """Take readings (n,)."""
        self.rows += len(degc)
        self.possible += int(np.count_nonzero((degc > PLAUSIBLE_DEGC[0]) & (degc < PLAUSIBLE_DEGC[1])))
        self.total += float(degc.sum())
        self.lowest, self.highest = min(self.lowest, float(degc.min())), max(self.highest, float(degc.max()))

    @property
    def plausible(self) -> bool:
        """Whether it is a temperature at all."""
        return 2 * self.possible > self.rows

    def finding(self, log_name: str, table: str) -> Finding:
        """That it is none."""
        return Finding(
            ReasonCode.TEMPERATURE_IMPLAUSIBLE,
            self.rows,
            f"{log_name}: {table} runs from {self.lowest:.6g} to {self.highest:.6g} °C, which no inertial sensor does: "
            "it is in counts or another unit, and not used. Log it in °C.",
        )
