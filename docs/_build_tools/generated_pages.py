"""Reference pages that are written from the code at every build: tables, command line, conventions, parameters."""

from __future__ import annotations

import inspect
import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from sphinx.application import Sphinx

import fieldcal
import fieldcal.errors
import fieldcal.logs
import fieldcal.logs.interface
import fieldcal.onboard
import fieldcal.warehouse.query
from fieldcal.cli.main import app as command_line
from fieldcal.config.parameters import PROFILES, Parameters
from fieldcal.reason_codes import ReasonCode
from fieldcal.warehouse.reference import markdown, relations

SECTIONS = {
    "History: the tables to ask": ("history",),
    "Views": ("view",),
    "Signals: readings as logged": ("signal",),
    "Stage tables: what passes between the stages of one flight": ("stage",),
}
FOLDER = "reference/generated"


def tables() -> str:
    """The data dictionary: history and views with a question each, signals, stage tables."""
    about = (
        "As `fieldcal schemas NAME` tells, `--json` and `--markdown` too. A star marks the columns that identify a "
        'row; a unit of "1" says dimensionless. A table\'s version grows with every change of its columns.'
    )
    parts = [f"# Data dictionary\n\n{about}\n"]
    known = relations().values()
    for title, kinds in SECTIONS.items():
        parts.append(f"## {title}\n\n{markdown(one for one in known if one.kind in kinds)}")
    return "\n".join(parts)


def commands() -> str:
    """Every command and option, from the command line itself."""
    text = str(command_line.generate_docs(output_format="markdown"))
    text = re.sub(r"## Table of Contents.*?(?=\*\*Commands\*\*)", "", text, flags=re.DOTALL)
    # cyclopts takes the program that is running for part of the usage.
    text = re.sub(r"^(fieldcal [\w-]+) (?:-m )?[\w-]*sphinx[\w-]*(?= )", r"\1", text, flags=re.MULTILINE)
    return re.sub(r"\A# .*\n", "# Command line\n", text)


def conventions() -> str:
    """The page that fixes the conventions: the package's own docstring."""
    return f"# Conventions\n\nThis is the docstring of `fieldcal`.\n\n```text\n{fieldcal.__doc__}```\n"


def parameters() -> str:
    """Every parameter of the stages, and the profiles."""
    lines = ["# Parameters of the stages", ""]
    lines += ["In `[defaults.parameters]` or a vehicle's `parameters`, or for one log `--set name=value`.", ""]
    lines += ["| parameter | default | unit | allowed | meaning |", "|---|---|---|---|---|"]
    for name, field in Parameters.model_json_schema()["properties"].items():
        default, unit, meaning = _toml(field["default"]), field.get("unit", ""), field["description"]
        lines.append(f"| `{name}` | {default} | {unit} | {_allowed(field)} | {meaning} |")
    lines += ["", "## Profiles", "", "What a profile sets; the configuration's own parameters win over it.", ""]
    for name, changes in PROFILES.items():
        what = ", ".join(f"`{key} = {_toml(value)}`" for key, value in changes.items()) or "the defaults above"
        lines.append(f"- `{name}`: {what}")
    return "\n".join(lines) + "\n"


def _toml(value: object) -> str:
    return json.dumps(value)


def _allowed(field: dict[str, Any]) -> str:
    if "enum" in field:
        return ", ".join(f"`{choice}`" for choice in field["enum"])
    return f"{field['minimum']:g} … {field['maximum']:g}" if "minimum" in field else "`true`, `false`"


def python() -> str:
    """The public names of the package, its warehouse and its errors."""
    names = [name for name in getattr(fieldcal, "__all__", ()) if not name.startswith("_")]
    blocks = [_entry(f"fieldcal.{name}", _directive(getattr(fieldcal, name))) for name in names]
    rooms = (fieldcal.onboard, fieldcal.warehouse.query, fieldcal.logs, fieldcal.logs.interface, fieldcal.errors)
    blocks += [_entry(room.__name__, "automodule", [name for name in names if hasattr(room, name)]) for room in rooms]
    return "# Python\n\n" + "\n".join(blocks)


def _entry(name: str, directive: str, told_above: Sequence[str] = ()) -> str:
    options = "" if directive in ("autofunction", "autodata") else "   :members:\n"
    if told_above:
        options += f"   :exclude-members: {', '.join(told_above)}\n"
    return f"```{{eval-rst}}\n.. {directive}:: {name}\n{options}```\n"


def _directive(public: object) -> str:
    if isinstance(public, type):
        return "autoexception" if issubclass(public, BaseException) else "autoclass"
    return "autofunction" if callable(public) else "autodata"


def reason_codes() -> str:
    """Every reason code with its meaning: its members' own docstrings."""
    lines = ["# Reason codes", "", "What stands as `reason_code` of a row or error, and as code of a finding or fault."]
    source = Path(inspect.getsourcefile(ReasonCode) or "").read_text(encoding="utf-8")
    for part in re.split(r"^    # --- ", source, flags=re.MULTILINE)[1:]:
        heading, _, members = part.partition("\n")
        lines += ["", f"## {heading[0].upper()}{heading[1:]}", "", "| code | meaning |", "|---|---|"]
        lines += [f"| `{c}` | {what} |" for c, what in re.findall(r'= "(\w+)"\n    """(.*)"""', members)]
    return "\n".join(lines) + "\n"


PAGES = {
    "tables": tables,
    "command-line": commands,
    "conventions": conventions,
    "parameters": parameters,
    "python": python,
    "reason-codes": reason_codes,
}


def write(app: Sphinx) -> None:
    """Writes what has changed, so that a second build reads the rest from its cache."""
    folder = Path(app.srcdir) / FOLDER
    folder.mkdir(parents=True, exist_ok=True)
    for name, make in PAGES.items():
        page, text = folder / f"{name}.md", make()
        if not page.is_file() or page.read_text(encoding="utf-8") != text:
            page.write_text(text, encoding="utf-8")


def setup(app: Sphinx) -> dict[str, bool]:
    app.connect("builder-inited", write)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
