"""On board: the paper's low-fidelity version, streaming in fixed memory; the same in Python and, in `c/`, as C99.

    >>> from fieldcal.onboard import Board, BoardSettings, write_sources

`Moments` and `RateEquations` collect sums of a vector triad and of the gyroscope; `Board` does the duty of one IMU.
What was collected can be dumped and merged, so that flights add up to one fit that no flight alone allows.
"""

from __future__ import annotations

from fieldcal.onboard.board import Board, BoardResult, BoardSettings
from fieldcal.onboard.dumps import dump, read_dumps
from fieldcal.onboard.ellipsoid import Limits, MomentsFit
from fieldcal.onboard.handout import write_sources
from fieldcal.onboard.rates import RatesFit
from fieldcal.onboard.streams import Moments, RateEquations

__all__ = [
    "Board",
    "BoardResult",
    "BoardSettings",
    "Limits",
    "Moments",
    "MomentsFit",
    "RateEquations",
    "RatesFit",
    "dump",
    "read_dumps",
    "write_sources",
]
