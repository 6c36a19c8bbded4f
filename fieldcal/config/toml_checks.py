"""Checks of single values read from the configuration; every refusal names the file, the key and what is allowed."""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, NoReturn

from fieldcal.errors import ConfigurationError

Triple = tuple[float, float, float]


@dataclass(frozen=True)
class Place:
    """A key of the configuration file, for error sentences: `fieldcal.toml, [vehicles.a] field.unit`."""

    file: str
    keys: tuple[str, ...] = ()

    def __truediv__(self, key: str) -> Place:
        return Place(self.file, (*self.keys, key))

    def __str__(self) -> str:
        return f"{self.file}: {'.'.join(_quoted(key) for key in self.keys)}" if self.keys else self.file

    def fail(self, reason_code: str, problem: str) -> NoReturn:
        raise ConfigurationError(reason_code, f"{self}: {problem}.")


def _quoted(key: str) -> str:
    return key if key.replace("_", "").replace("-", "").isalnum() and key.isascii() else f'"{key}"'


def table(value: Any, place: Place, known: Iterable[str] | None = None) -> dict[str, Any]:
    """A TOML table, all of whose keys are `known` (any, when None)."""
    if not isinstance(value, dict):
        place.fail("wrong_type", f"a table is needed here, not {_shown(value)}")
    if known is not None:
        allowed = list(known)
        for key in value:
            if key not in allowed:
                _unknown(key, allowed, place)
    return value


def _unknown(key: str, known: list[str], place: Place) -> NoReturn:
    nearest = difflib.get_close_matches(key.lower(), known, n=1, cutoff=0.0)
    close = difflib.get_close_matches(key.lower(), known, n=1, cutoff=0.6)
    hint = f'did you mean "{nearest[0]}"?'
    if not close:
        hint += f" Known here: {', '.join(known)}."
    raise ConfigurationError("unknown_key", f'{place}: there is no key "{key}"; {hint}')


def text(value: Any, place: Place) -> str:
    """A string that is not empty."""
    if not isinstance(value, str) or not value:
        place.fail("wrong_type", f"a text is needed here, not {_shown(value)}")
    return value


def character(value: Any, place: Place) -> str:
    """A single character."""
    if len(text(value, place)) != 1:
        place.fail("wrong_value", f"a single character is needed here, not {_shown(value)}")
    return str(value)


def choice(value: Any, place: Place, allowed: Iterable[str]) -> str:
    """One of the allowed texts."""
    allowed = list(allowed)
    if value not in allowed or not isinstance(value, str):
        place.fail("wrong_value", f"{_shown(value)} is not one of {', '.join(allowed)}")
    return value


def flag(value: Any, place: Place) -> bool:
    """true or false."""
    if not isinstance(value, bool):
        place.fail("wrong_type", f"true or false is needed here, not {_shown(value)}")
    return value


def number(value: Any, place: Place, lowest: float = -math.inf, highest: float = math.inf) -> float:
    """A finite number within inclusive bounds."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        place.fail("wrong_type", f"a number is needed here, not {_shown(value)}")
    try:
        result = float(value)
    except OverflowError:
        result = math.inf
    if not math.isfinite(result) or not lowest <= result <= highest:
        limits = "finite" if math.isinf(lowest) and math.isinf(highest) else f"from {lowest:g} to {highest:g}"
        place.fail("wrong_value", f"{_shown(value)} is not allowed; it must be {limits}")
    return result


def positive(value: Any, place: Place) -> float:
    """A finite number above zero."""
    result = number(value, place)
    if result <= 0:
        place.fail("wrong_value", f"{_shown(value)} is not allowed; it must be above zero")
    return result


def triple(value: Any, place: Place) -> Triple:
    """Three finite numbers, x y z."""
    x, y, z = (number(item, place) for item in _items(value, place, 3, "numbers"))
    return x, y, z


def positive_triple(value: Any, place: Place) -> Triple:
    """Three numbers above zero, or one for all three axes."""
    items = _items(value, place, 3, "numbers") if isinstance(value, list) else [value] * 3
    x, y, z = (positive(item, place) for item in items)
    return x, y, z


def texts(value: Any, place: Place, count: int) -> tuple[str, ...]:
    """So many different texts."""
    result = tuple(text(item, place) for item in _items(value, place, count, "texts"))
    if len(set(result)) != count:
        place.fail("wrong_value", f"{_shown(value)} names one thing twice")
    return result


def signs(value: Any, place: Place) -> tuple[int, int, int]:
    """Three signs, each 1 or -1."""
    items = _items(value, place, 3, "signs")
    if any(isinstance(item, bool) or item not in (1, -1) for item in items):
        place.fail("wrong_value", f"{_shown(value)} is not allowed; each of the three must be 1 or -1")
    x, y, z = (int(item) for item in items)
    return x, y, z


def rotation(value: Any, place: Place, tolerance: float = 1e-6) -> tuple[Triple, Triple, Triple]:
    """A 3x3 matrix, by rows, that is a rotation: orthonormal within `tolerance`, determinant +1."""
    a, b, c = (triple(row, place) for row in _items(value, place, 3, "rows of three numbers"))
    off = max(abs(sum(p * q for p, q in zip(u, v, strict=True)) - (u is v)) for u in (a, b, c) for v in (a, b, c))
    if off > tolerance:
        place.fail("wrong_value", f"the rows are not orthogonal unit vectors (off by {off:.3g}): not a rotation")
    determinant = (
        a[0] * (b[1] * c[2] - b[2] * c[1]) - a[1] * (b[0] * c[2] - b[2] * c[0]) + a[2] * (b[0] * c[1] - b[1] * c[0])
    )
    if determinant < 0:
        place.fail("wrong_value", "the determinant is -1: a reflection, not a rotation; swap or negate one axis")
    return a, b, c


def _items(value: Any, place: Place, count: int, kind: str) -> list[Any]:
    if not isinstance(value, list) or len(value) != count:
        place.fail("wrong_type", f"a list of {count} {kind} is needed here, not {_shown(value)}")
    return value


def _shown(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, dict):
        return "a table"
    shown = f'"{value}"' if isinstance(value, str) else str(value)
    return shown if len(shown) <= 60 else f"{shown[:57]}..."
