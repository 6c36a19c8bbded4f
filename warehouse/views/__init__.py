"""The text of a view: its SQL file with the numbers and the order of methods put in that the code uses too."""

from __future__ import annotations

from importlib.resources import files

from fieldcal.names import PREFERRED_METHODS
from fieldcal.schemas.reference import ENOUGH_SESSIONS, REFERENCE_DEGC, SAME_VALUE, UNCONFIRMED_SD

VIEWS = ("latest_calibration", "history", "drift_by_temperature", "worst_tic", "refusals", "active", "calibration_at")
"""In the order in which they are made: later ones may need earlier ones."""
AT = {"calibration_at": "calibration_at(12.5)"}
"""Views of a value, as one calls them."""
VALUES = {
    "reference_degc": f"{REFERENCE_DEGC:g}",
    "enough_sessions": str(ENOUGH_SESSIONS),
    "unconfirmed_sd": f"{UNCONFIRMED_SD:g}",
    "same_value": f"{SAME_VALUE:g}",
    "exactness": " ".join(
        f"WHEN '{method}' THEN {len(PREFERRED_METHODS) - place}" for place, method in enumerate(PREFERRED_METHODS)
    ),
}
"""What stands for each `{name}` in the files of `views/`."""


def view_text(name: str) -> str:
    """The statement that makes a view. Raises KeyError where its file has a placeholder that `VALUES` lacks."""
    text = (files(__package__) / f"{name}.sql").read_text(encoding="utf-8")
    return text.format_map(VALUES)
