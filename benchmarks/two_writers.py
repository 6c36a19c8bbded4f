"""The night and sessions at once, round after round: the history must be the union, with no row twice.

    python benchmarks/two_writers.py [--rounds 20]

Each round starts `nightly` over an archive and `session` for one of its folders at the same moment, as two processes
into one new warehouse.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parent.parent
SEED = 23


def at_once(archive: Path, session: Path, root: Path) -> list[int]:
    """Run both; their exit codes."""
    commands = (["nightly", str(archive)], ["session", str(session)])
    processes = [
        subprocess.Popen(
            [sys.executable, "-m", "fieldcal", *command, "--warehouse", str(root)],
            cwd=REPOSITORY,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        for command in commands
    ]
    return [process.wait() for process in processes]


def main() -> None:
    """All rounds."""
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--rounds", type=int, default=20)
    given = arguments.parse_args()

    from fieldcal.flows.run import run_night
    from fieldcal.flows.server import running_server
    from fieldcal.simulation.archive import write_flights
    from fieldcal.simulation.experiment import Experiment
    from fieldcal.warehouse.content import content_sha256
    from fieldcal.warehouse.upkeep.verify import verify

    with tempfile.TemporaryDirectory() as folder, running_server(Path(folder) / "server") as server:
        server.wait()
        archive = Path(folder) / "archive"
        write_flights(archive, Experiment(seed=SEED, duration_s=20.0), vehicles=2, sessions=2)
        run_night(archive, Path(folder) / "alone")
        expected = content_sha256(Path(folder) / "alone")
        sessions = sorted(archive.glob("*/2*"))
        wrong = 0
        for number in range(given.rounds):
            root = Path(folder) / f"round-{number}"
            codes = at_once(archive, sessions[number % len(sessions)], root)
            same = codes == [0, 0] and content_sha256(root) == expected and verify(root)["ok"]
            wrong += not same
            print(f"round {number + 1}: exit codes {codes}, {'the union' if same else 'DIFFERENT'}", flush=True)
        print(f"{given.rounds} rounds, {wrong} that were not the union")
        sys.exit(1 if wrong else 0)


if __name__ == "__main__":
    main()
