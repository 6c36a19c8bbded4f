"""Parameters of an autopilot from a file, as ground stations save them.

    QGroundControl            vehicle id, component id, name, value, type, separated by tabs
    Mission Planner           NAME,VALUE
    MAVProxy                  NAME   VALUE

A line may end in a comment, `# …`. Of QGroundControl's only those of the autopilot itself count, component 1.
"""

from __future__ import annotations

import math
from pathlib import Path

from fieldcal.errors import FieldcalError
from fieldcal.reason_codes import ReasonCode

AUTOPILOT_COMPONENT = "1"
OF_A_LINE, OF_QGROUNDCONTROL = 2, 5


def read_parameters(path: Path) -> dict[str, float]:
    """Name → value.

    Raises
    ------
    FieldcalError
        `not_found`: there is no such file. `wrong_option`: it holds a line that is no parameter, or none at all.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except FileNotFoundError as error:
        raise FieldcalError(ReasonCode.NOT_FOUND, f"There is no file of parameters at {path}.") from error
    except UnicodeDecodeError as error:
        raise FieldcalError(ReasonCode.WRONG_OPTION, f"{path} is no text, and so no file of parameters.") from error
    found: dict[str, float] = {}
    for number, line in enumerate(text.splitlines(), start=1):
        told = line.partition("#")[0].replace(",", " ").split()
        if not told:
            continue
        if len(told) == OF_QGROUNDCONTROL:
            if told[1] != AUTOPILOT_COMPONENT:
                continue
            told = told[2:4]
        value = _number(told[1]) if len(told) == OF_A_LINE else None
        if value is None:
            raise FieldcalError(
                ReasonCode.WRONG_OPTION,
                f"{path}, line {number}: {line.strip()[:60]!r} is no parameter as QGroundControl or Mission Planner"
                " saves it.",
            )
        found[told[0]] = value
    if not found:
        raise FieldcalError(ReasonCode.WRONG_OPTION, f"{path} holds no parameters.")
    return found


def _number(text: str) -> float | None:
    try:
        value = float(text)
    except ValueError:
        return None
    return value if math.isfinite(value) else None
