"""Why a row of `drift` has its status, in a sentence with the numbers that decided it."""

from __future__ import annotations

from fieldcal.names import DriftStatus
from fieldcal.schemas.reference import ENOUGH_SESSIONS, UNCONFIRMED_SD
from fieldcal.schemas.rows import DriftRow
from fieldcal.trends.more_sessions import until_step_or_drift
from fieldcal.words.measures import change, measure

MONTH_D = 30.0
MAY_DRIFT = "May drift"
VPS, AGREEMENT = "vps", "fit"
"""What stands as `sensor` of rows about the VPS clock and about agreement (Theil's coefficients)."""


def reason(row: DriftRow, more: int = 0) -> str | None:
    """The sentence; None for a stable row whose last flight lies where it should.

    Parameters
    ----------
    more : int
        How many more sessions would tell what is in question (`trends.more_sessions.needed`).
    """
    unit = row["unit"]
    if row["status"] == DriftStatus.INSUFFICIENT:
        n = row["n_sessions"]
        sentence = f"{_sessions(n)}: a trend needs {ENOUGH_SESSIONS}, {ENOUGH_SESSIONS - n} more."
        if row["borrowed_from"] is None:
            return sentence
        lent = f"scatter between sessions ({measure(row['session_sd'], None, unit)}) and slope are those of"
        return f"{sentence} The value is the sessions' mean; {lent} {row['borrowed_from']} siblings."
    if row["status"] == DriftStatus.STEP:
        size = measure(row["change_size"], row["change_size_sd"], unit)
        return f"Stepped by {size} before the flight of {row['change_at']:%Y-%m-%d %H:%M} UTC."
    if row["status"] == DriftStatus.DRIFTING:
        told = f"Moves by {_in_30_days(row)} in 30 days, {_sigmas(row['slope_per_day'], row['slope_per_day_sd'])} sd"
        if wanting := until_step_or_drift(row["n_sessions"]):
            return f"{told} from none; or it stepped in between: about {_sessions(wanting, 'more')} would tell."
        return f"{told} from none."
    if row["status"] == DriftStatus.OUTLIER:
        own = measure(row["value_at_25degc"], None, unit)
        what = "Its scatter between sessions" if row["sensor"] == "vps" else own
        return f"{what} is {row['fleet_z']:+.1f} sd from the fleet's other IMUs."
    if row["last_z"] is not None and abs(row["last_z"]) > UNCONFIRMED_SD:
        return (
            f"The last flight is {row['last_z']:+.1f} sd off the line: spoiled, or the first after a step. Another"
            " session will tell."
        )
    if more:
        return f"{MAY_DRIFT}, by {_in_30_days(row)} in 30 days: about {_sessions(more, 'more')} would tell."
    return None


def status_words(row: DriftRow) -> str:
    """The status as far as so many sessions tell."""
    if row["status"] == DriftStatus.DRIFTING and until_step_or_drift(row["n_sessions"]):
        return "drift or step"
    if row["status"] == DriftStatus.STABLE and str(row["reason"] or "").startswith(MAY_DRIFT):
        return "may drift"
    return row["status"]


def _in_30_days(row: DriftRow) -> str:
    slope, sd = row["slope_per_day"], row["slope_per_day_sd"]
    return change(
        None if slope is None else MONTH_D * slope,
        None if sd is None else MONTH_D * sd,
        row["unit"],
        parameter=row["parameter"],
        of=row["value_at_25degc"],
    )


def _sessions(n: int, more: str = "") -> str:
    return f"{n} {more}{' ' if more else ''}session{'' if n == 1 else 's'}"


def _sigmas(value: float | None, sd: float | None) -> str:
    return f"{abs(value) / sd:.1f}" if value is not None and sd else "many"
