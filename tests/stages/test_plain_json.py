"""What a stage measured, as the JSON that its record and the history keep."""

from __future__ import annotations

import json
from datetime import datetime

import numpy as np
import pytest

from fieldcal.names import Status
from fieldcal.stages.results import plain


def test_what_is_measured_becomes_plain_json_or_is_refused() -> None:
    value = {"a": np.float64(1.5), "b": np.array([2.0, np.inf]), 3: (True, None, Status.OK, np.int32(4), float("nan"))}
    assert json.loads(json.dumps(plain(value), allow_nan=False)) == {
        "a": 1.5,
        "b": [2.0, None],
        "3": [True, None, "ok", 4, None],
    }
    with pytest.raises(TypeError, match="datetime"):
        plain({"when": datetime(2026, 1, 1)})
