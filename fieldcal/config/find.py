"""Which `fieldcal.toml` holds, and what the command line lays over it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

from fieldcal.config.configuration import Configuration, Vehicle, load, parse
from fieldcal.errors import ConfigurationError
from fieldcal.reason_codes import ReasonCode

CONFIG_NAME = "fieldcal.toml"
Source = dict[str, str | None]
"""Path and text of a configuration file, as plain JSON: what was read once holds for the whole night."""


def find_source(config: Path | None, archive: Path | None) -> Source:
    """The configuration named, else the archive's own at its root, else none (the defaults).

    Raises
    ------
    ConfigurationError
        The file is wrong, or the named one is not there.
    """
    path = config
    if path is None and archive is not None and (archive / CONFIG_NAME).is_file():
        path = archive / CONFIG_NAME
    if path is None:
        return {"path": None, "text": ""}
    if not path.is_file():
        raise ConfigurationError(ReasonCode.CONFIG_NOT_READABLE, f"{path}: there is no such file.")
    load(path)
    return {"path": str(path), "text": path.read_bytes().decode("utf-8-sig")}


def find_near(log: Path, archive: Path) -> Path | None:
    """A single log's configuration: its archive's own as in a night, else the one beside or in the log, else the one in
    the current directory."""
    near = (folder / CONFIG_NAME for folder in (archive, log, log.parent, Path.cwd()))
    return next((path for path in near if path.is_file()), None)


def configuration_of(source: Source) -> Configuration:
    """The configuration from its source."""
    return parse(source["text"] or "", Path(source["path"]) if source["path"] else None)


def with_parameters(vehicle: Vehicle, profile: str | None, changes: Mapping[str, str]) -> Vehicle:
    """A vehicle with a profile's presets and single parameters (name → text) laid over its own.

    Raises
    ------
    ConfigurationError
        An unknown name (the nearest known one is told) or a value that is not allowed.
    """
    lines = ["[defaults]"]
    if profile is not None:
        lines.append(f"profile = {json.dumps(profile)}")
    lines.append("[defaults.parameters]")
    lines += [f"{json.dumps(name)} = {_toml_value(text)}" for name, text in changes.items()]
    given = parse("\n".join(lines), Path("command line")).vehicle(vehicle.vehicle_id)
    over = {name: getattr(given.parameters, name) for name in changes}
    parameters = vehicle.parameters.model_copy(update=over) if profile is None else given.parameters
    update = {"profile": profile or vehicle.profile, "parameters": parameters}
    if profile is not None:
        update["method"] = given.method
    return vehicle.model_copy(update=update)


def _toml_value(text: str) -> str:
    """Text of a parameter as TOML: numbers and true/false as they are, the rest quoted."""
    if text in ("true", "false"):
        return text
    try:
        float(text)
    except ValueError:
        return json.dumps(text)
    return text
