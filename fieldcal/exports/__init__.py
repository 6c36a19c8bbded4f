"""The constants to fly with in the formats of others. Each module states its target's conventions and says what the
target cannot hold."""

from __future__ import annotations

from collections.abc import Callable

from fieldcal.exports.ardupilot import ardupilot
from fieldcal.exports.c_header import c_header
from fieldcal.exports.calibration import Constants, Export
from fieldcal.exports.json_document import json_document
from fieldcal.exports.px4 import px4
from fieldcal.exports.yaml_text import kalibr, ros

FORMATS: dict[str, Callable[[Constants], Export]] = {
    "px4": px4,
    "ardupilot": ardupilot,
    "ros": ros,
    "kalibr": kalibr,
    "json": json_document,
    "c": c_header,
}
