"""Types, dependency directions and the documentation: checked as tests, so that both processes of CI share the work."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
BESIDE_PYTHON = Path(sys.executable).parent


@pytest.mark.parametrize("command", ["mypy", "lint-imports"])
def test_what_is_not_run_holds(command: str) -> None:
    found = run([str(BESIDE_PYTHON / command)])
    assert found.returncode == 0, found.stdout + found.stderr


def test_the_documentation_is_built_without_a_warning(tmp_path: Path) -> None:
    built = run([sys.executable, "-m", "sphinx", "-q", "-W", "-b", "html", "docs", str(tmp_path)])
    assert built.returncode == 0, built.stdout + built.stderr
    assert (tmp_path / "index.html").exists()
    assert (tmp_path / "reference" / "configuration.html").exists()


def run(command: list[str]) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
