"""Recordings that are too large for the repository: `FIELDCAL_EXAMPLE_LOGS` names the folder that holds their folders.

Where it is not set, tests on recordings are skipped; where it is, every folder listed here must be there.
"""

from __future__ import annotations

import os
from pathlib import Path

import pytest

VARIABLE = "FIELDCAL_EXAMPLE_LOGS"
FOLDERS = (
    "data",
    "recordings-2",
    "autopilot-logs",
    "cases/logs",
    "cases/calibration",
    "cases/statistics",
)

PARENT = Path(os.environ.get(VARIABLE) or "/nonexistent")
EXAMPLES = PARENT / "data"
needs_examples = pytest.mark.skipif(not os.environ.get(VARIABLE), reason=f"{VARIABLE} is not set")
