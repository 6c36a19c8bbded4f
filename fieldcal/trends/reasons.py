"""Why a row of `drift` has its status, in a sentence with the numbers that decided it."""

from __future__ import annotations

from fieldcal.names import DriftStatus
from fieldcal.schemas.reference import ENOUGH_SESSIONS, UNCONFIRMED_SD
from fieldcal.schemas.rows import DriftRow
from fieldcal.words.numbers import number, with_sd

VPS, AGREEMENT = "vps", "fit"
"""What stands as `sensor` of rows about the VPS clock and about agreement (Theil's coefficients)."""


def reason(row: DriftRow) -> str | None:
    """The sentence; None for a stable row whose last flight lies where it should."""
    unit = "" if row["unit"] in (None, "1") else f" {row['unit']}"
    if row["status"] == DriftStatus.INSUFFICIENT:
        sessions = row["n_sessions"]
        sentence = f"{sessions} session{'' if sessions == 1 else 's'}: a trend needs {ENOUGH_SESSIONS}."
        if row["borrowed_from"] is None:
            return sentence
        lent = f"scatter between sessions ({number(row['session_sd'])}{unit}) and slope are those of"
        return f"{sentence} The value is the sessions' mean; {lent} {row['borrowed_from']} siblings."
    if row["status"] == DriftStatus.STEP:
        size = with_sd(row["change_size"], row["change_size_sd"])
        return f"Stepped by {size}{unit} before the flight of {row['change_at']:%Y-%m-%d %H:%M} UTC."
    if row["status"] == DriftStatus.DRIFTING:
        slope = with_sd(row["slope_per_day"], row["slope_per_day_sd"])
        return f"Moves by {slope}{unit} a day, {_sigmas(row['slope_per_day'], row['slope_per_day_sd'])} sd from none."
    if row["status"] == DriftStatus.OUTLIER:
        what = "Its scatter between sessions" if row["sensor"] == "vps" else number(row["value_at_25degc"]) + unit
        return f"{what} is {row['fleet_z']:+.1f} sd from the fleet's other IMUs."
    if row["last_z"] is not None and abs(row["last_z"]) > UNCONFIRMED_SD:
        return (
            f"The last flight is {row['last_z']:+.1f} sd off the line: spoiled, or the first after a step. Another"
            " session will tell."
        )
    return None


def _sigmas(value: float | None, sd: float | None) -> str:
    return f"{abs(value) / sd:.1f}" if value is not None and sd else "many"
