"""JSON: the whole model, self-explaining."""

from __future__ import annotations

import json
from collections.abc import Mapping

import numpy as np

from fieldcal.exports.calibration import Constants, Export, Triad
from fieldcal.names import INERTIAL_FIRST, Json

MODEL = (
    "calibrated = S (raw - Z), d = T - temperature_degc; S = scale + scale_per_degc d, Z = zero + zero_per_degc d"
    " + zero_per_degc2 d^2 + zero_per_degc3 d^3; sensor axes as logged"
)


def json_document(constants: Constants) -> Export:
    """One JSON object."""
    document = {
        "model": MODEL,
        "vehicle_id": constants.vehicle_id,
        "imu_id": constants.imu_id,
        "unit_ids": dict(constants.unit_ids),
        "as_of": constants.as_of or None,
        "sensors": {s: _triad(constants.triads[s]) for s in INERTIAL_FIRST if s in constants.triads},
    }
    return Export(json.dumps(document, ensure_ascii=False, indent=1, allow_nan=False) + "\n", ())


def _triad(triad: Triad) -> Mapping[str, Json]:
    slopes = ("scale_per_degc", "zero_per_degc", "zero_per_degc2", "zero_per_degc3")
    arrays = ("scale", "zero", *slopes, "scale_sd", "zero_sd")
    return {
        "unit": triad.unit,
        "raw_unit": triad.logged_unit,
        "temperature_degc": triad.temperature_degc,
        "flown_degc": None if triad.flown_degc is None else list(triad.flown_degc),
        **{name: _finite(getattr(triad, name)) for name in arrays},
        "why": list(triad.why),
    }


def _finite(array: np.ndarray) -> Json:
    """Nested lists; an unknown sd is null."""
    if array.ndim > 1:
        return [_finite(row) for row in array]
    return [float(v) if np.isfinite(v) else None for v in array]
