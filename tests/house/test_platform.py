"""What a platform lacks is a sentence."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

WITHOUT_LOCKS = """
import sys
sys.modules["fcntl"] = None
from fieldcal.cli.main import run
sys.exit(run(sys.argv[1:]))
"""


@pytest.mark.parametrize("command", ["history", "nightly", "calibrate"])
def test_without_file_locks_a_sentence_says_where_fieldcal_runs(command: str, tmp_path: Path) -> None:
    log = tmp_path / "vehicle" / "session" / "log.csv"
    log.parent.mkdir(parents=True)
    log.write_text("t_s,gx,gy,gz\n0,0,0,0\n")
    place = {"history": [], "nightly": [str(tmp_path)], "calibrate": [str(log)]}[command]
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT_LOCKS, command, *place, "--warehouse", str(tmp_path / "root")],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 1
    assert done.stdout == ""
    assert done.stderr.count("\n") == 1
    assert "Linux and macOS" in done.stderr
    assert "WSL" in done.stderr
