"""`fieldcal config`: is `fieldcal.toml` right, what does it come to for a vehicle, and its schema for editors."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from cyclopts import App

from fieldcal.cli.options import AsJson, UnusedConfig, UnusedRoot

if TYPE_CHECKING:
    from fieldcal.config.origins import Entry
    from fieldcal.names import Json

OK, WRONG = 0, 2

config_app = App(name="config", help="Check fieldcal.toml, show what it comes to, or print its schema.")


@config_app.command
def check(
    file: Path | None = None, /, *, as_json: AsJson = False, config: UnusedConfig = None, warehouse: UnusedRoot = None
) -> int:
    """Check a configuration: every mistake with its key and what is allowed there.

    Parameters
    ----------
    file
        The file, or the archive at whose root it lies; else ./fieldcal.toml.
    """
    from fieldcal.cli.show import print_json
    from fieldcal.config.configuration import load
    from fieldcal.errors import ConfigurationError

    path = _file(file or config)
    try:
        found = load(path)
    except ConfigurationError as error:
        mistakes = error.mistakes
        if as_json:
            print_json({"file": str(path), "ok": False, "vehicles": [], "mistakes": mistakes})
        else:
            for mistake in mistakes:
                print(f"fieldcal: {mistake}", file=sys.stderr)
        return WRONG
    if as_json:
        print_json({"file": str(path), "ok": True, "vehicles": list(found.vehicles), "mistakes": []})
    else:
        named = ", ".join(found.vehicles) or "none, the defaults hold for all"
        print(f"{path}: no mistakes. Vehicles: {named}. Entries of archive.logs: {len(found.logs)}.")
    return OK


@config_app.command
def show(
    file: Path | None = None,
    /,
    *,
    vehicle: str | None = None,
    as_json: AsJson = False,
    config: UnusedConfig = None,
    warehouse: UnusedRoot = None,
) -> int:
    """Show everything that holds for a vehicle, as TOML, each value with where it comes from.

    Parameters
    ----------
    file
        The file, or the archive at whose root it lies; else ./fieldcal.toml.
    vehicle
        Its name in the file; else what holds for a vehicle that the file does not name.
    """
    from fieldcal.cli.show import print_json
    from fieldcal.config.configuration import load
    from fieldcal.config.mistakes import key_path
    from fieldcal.config.origins import effective
    from fieldcal.words.talk import say

    path = _file(file or config)
    found = load(path)
    if vehicle is not None and vehicle not in found.vehicles:
        say(f'{path} does not name vehicle "{vehicle}": its defaults hold.')
    entries = effective(found, vehicle)
    if as_json:
        told = [
            {
                "key": key_path(*entry.keys),
                "value": entry.value,
                "from": entry.source,
                "unit": entry.unit,
                "meaning": entry.meaning,
            }
            for entry in entries
        ]
        print_json({"vehicle": vehicle, "settings": told})
        return OK
    print("[defaults]" if vehicle is None else f"[{key_path('vehicles', vehicle)}]")
    for entry in entries:
        print(_line(entry))
    return OK


@config_app.command
def schema(*, config: UnusedConfig = None, warehouse: UnusedRoot = None) -> int:
    """Print the JSON schema of fieldcal.toml: an editor that knows it completes keys and marks mistakes."""
    from fieldcal.cli.show import print_json
    from fieldcal.config.configuration import Document

    dialect = "https://json-schema.org/draft/2020-12/schema"
    print_json({"$schema": dialect, **Document.model_json_schema(), "title": "fieldcal.toml"})
    return OK


def _file(given: Path | None) -> Path:
    from fieldcal.config.find import CONFIG_NAME

    path = given or Path(CONFIG_NAME)
    return path / CONFIG_NAME if path.is_dir() else path


def _line(entry: Entry) -> str:
    """One value as TOML; what is not configured stands as a comment."""
    from fieldcal.config.mistakes import key_path

    told = "; ".join(part for part in (entry.source, entry.unit, entry.meaning) if part)
    if entry.value is None:
        return f"# {key_path(*entry.keys)}: not configured  # {told}"
    return f"{key_path(*entry.keys)} = {_toml(entry.value)}  # {told}"


def _toml(value: Json) -> str:
    """A value as TOML writes it. What a table has from a date on is the date, without quotes."""
    if isinstance(value, Mapping):
        inside = (f"{key} = {item if key == 'from' else _toml(item)}" for key, item in value.items())
        return f"{{ {', '.join(inside)} }}"
    if isinstance(value, list):
        return f"[{', '.join(_toml(item) for item in value)}]"
    return json.dumps(value, ensure_ascii=False)
