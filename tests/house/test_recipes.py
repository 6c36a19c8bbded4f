"""Recipes that people copy: what can be checked of them without a server."""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml

from fieldcal.cli.main import app

DEPLOY = Path(__file__).parents[2] / "docs" / "deploy"
UNITS = sorted((DEPLOY / "systemd").iterdir())
INSTALLED = "/opt/fieldcal/bin/fieldcal"


def commands() -> list[str]:
    """Every fieldcal command line in the recipes."""
    told = [line.partition("=")[2] for unit in UNITS for line in unit.read_text().splitlines() if "ExecStart=" in line]
    told += re.findall(rf"{INSTALLED} .*?(?= >)", (DEPLOY / "fieldcal.cron").read_text())
    services = compose()["services"].values()
    return [*told, *(f"fieldcal {one['command']}" for one in services if "command" in one)]


def compose() -> dict[str, Any]:
    found: dict[str, Any] = yaml.safe_load((DEPLOY / "docker" / "compose.yaml").read_text())
    return found


@pytest.mark.parametrize("command", commands())
def test_commands_are_ones_that_fieldcal_has(command: str) -> None:
    _, *tokens = shlex.split(command)
    function, _, _ = app.parse_args(tokens, exit_on_error=False, print_error=False)
    assert function.__name__ in ("nightly", "serve")


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="no systemd here")
def test_systemd_takes_the_units(tmp_path: Path) -> None:
    own = str(Path(sys.executable).with_name("fieldcal"))
    for unit in UNITS:
        (tmp_path / unit.name).write_text(unit.read_text().replace(INSTALLED, own))
    names = [str(tmp_path / unit.name) for unit in UNITS]
    done = subprocess.run(["systemd-analyze", "verify", *names], capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_the_container_is_built_from_what_is_there() -> None:
    nights = compose()["services"]["nights"]
    context = (DEPLOY / "docker" / nights["build"]["context"]).resolve()
    assert context == DEPLOY.parents[1]
    assert (context / nights["build"]["dockerfile"]).is_file()
    assert "fieldcal[alerts]".removeprefix("fieldcal") in (DEPLOY / "docker" / "Dockerfile").read_text()
