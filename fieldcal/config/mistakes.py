"""Mistakes in `fieldcal.toml` as sentences: the file, the key, what stands there and what is allowed."""

from __future__ import annotations

import difflib
import re
import types
from collections.abc import Mapping
from typing import Annotated, Union, get_args, get_origin

from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails

from fieldcal.config.values import shown
from fieldcal.errors import ConfigurationError
from fieldcal.reason_codes import ReasonCode

NEEDED = {
    "string_type": "a text",
    "string_too_short": "a text",
    "float_type": "a number",
    "bool_type": "true or false",
    "dict_type": "a table",
    "list_type": "a list of tables",
    "tuple_type": "a list",
}
"""What is needed where pydantic finds another type, by its name of the error."""


def key_path(*keys: str) -> str:
    """Keys as TOML writes them: `vehicles.a.field`."""
    return ".".join(
        key if key.replace("_", "").replace("-", "").isalnum() and key.isascii() else f'"{key}"' for key in keys
    )


def configuration_error(file: str, model: type[BaseModel], error: ValidationError) -> ConfigurationError:
    """All mistakes that pydantic found; the first is the sentence, all stand in `measured["mistakes"]`."""
    # One number for three axes is found wrong three times.
    told = list(dict.fromkeys(_mistake(file, model, one) for one in error.errors(include_url=False)))
    reason_code, sentence = told[0]
    more = len(told) - 1
    if more:
        sentence += f" And {more} more mistake{'' if more == 1 else 's'}: fieldcal config check lists all."
    return ConfigurationError(reason_code, sentence, {"mistakes": [mistake for _, mistake in told]})


def _mistake(file: str, model: type[BaseModel], error: ErrorDetails) -> tuple[ReasonCode, str]:
    """Reason code and sentence of one mistake."""
    loc, context = list(error["loc"]), error.get("ctx", {})
    while loc and isinstance(loc[-1], int) and not _tables(model, loc[:-1]):
        loc.pop()  # a place within a list of numbers: the list is what is told
    keys = [str(key) for key in (*loc, *context.get("at", ()))]
    code, problem = _told(error["type"], error["input"], context, model, error["loc"])
    end = "" if problem.endswith("?") else "."
    return code, f"{file}: {key_path(*keys)}{': ' if keys else ''}{problem}{end}"


def _tables(model: type[BaseModel], loc: list[int | str]) -> bool:
    """Whether a key path ends in a list of tables."""
    field = field_at(model, tuple(loc))
    return field is not None and get_origin(field.annotation) is list


def _told(
    kind: str, value: object, context: Mapping[str, object], model: type[BaseModel], loc: tuple[int | str, ...]
) -> tuple[ReasonCode, str]:
    if kind in ("unknown_key", "wrong_type", "wrong_value"):
        return ReasonCode(kind), str(context["problem"])
    if kind in NEEDED:
        # A whole number that no float holds is a number.
        too_large = kind == "float_type" and isinstance(value, int) and not isinstance(value, bool)
        if not too_large:
            return ReasonCode.WRONG_TYPE, f"{NEEDED[kind]} is needed here, not {shown(value)}"
    if kind == "literal_error":
        allowed = re.findall("'([^']*)'", str(context["expected"]))
        nearest = difflib.get_close_matches(str(value).lower(), allowed, n=1)
        hint = f'; did you mean "{nearest[0]}"?' if nearest else ""
        return ReasonCode.WRONG_VALUE, f"{shown(value)} is not one of {', '.join(allowed)}{hint}"
    if kind == "string_too_long":
        return ReasonCode.WRONG_VALUE, f"a single character is needed here, not {shown(value)}"
    return ReasonCode.WRONG_VALUE, f"{shown(value)} is not allowed; it must be {_limits(kind, model, loc)}"


def _limits(kind: str, model: type[BaseModel], loc: tuple[int | str, ...]) -> str:
    """What a number must be, by the field's own limits."""
    if kind == "greater_than":
        return "above zero"
    field = field_at(model, loc)
    metadata = [] if field is None else field.metadata
    lowest = next((item.ge for item in metadata if hasattr(item, "ge")), None)
    highest = next((item.le for item in metadata if hasattr(item, "le")), None)
    return "finite" if lowest is None or highest is None else f"from {lowest:g} to {highest:g}"


def field_at(model: type[BaseModel], loc: tuple[int | str, ...]) -> FieldInfo | None:
    """The field that a key path ends in; None where it ends in no field of a model."""
    here: object = model
    field = None
    for key in loc:
        field = None
        here = _without_none(here)
        if isinstance(here, type) and issubclass(here, BaseModel):
            field = here.model_fields.get(str(key))
            here = None if field is None else field.annotation
        elif get_origin(here) in (dict, list, tuple):
            here = get_args(here)[-1]
    return field


def _without_none(annotation: object) -> object:
    """X of `X | None` and of `Annotated[X, …]`."""
    if get_origin(annotation) is Annotated:
        return _without_none(get_args(annotation)[0])
    if get_origin(annotation) in (Union, types.UnionType):
        return next((part for part in get_args(annotation) if part is not type(None)), None)
    return annotation
