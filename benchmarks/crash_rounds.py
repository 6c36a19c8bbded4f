"""Kill the night at every stage boundary and at random times; what the next night makes of it must be the same.

    python benchmarks/crash_rounds.py [--random 20] [--flights 2]

Each round: a night in a new warehouse is killed (SIGKILL, the whole process group) just before or just after the n-th
result or history file gets its name, or at a random time; a second night runs to its end; the content hash of the
history must be that of a night that was never killed, and every file whole.
"""

from __future__ import annotations

import argparse
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parent.parent
SEED = 17
BEFORE, AFTER = "before", "after"

# A night that ends itself, worker and all, when its n-th file gets its name. Counted, in a file of their own, are
# stage records and history files. The worker runs this module too, but for its last lines.
NIGHT = """
import os, signal, sys
from pathlib import Path
from fieldcal.warehouse import files

archive, root, side, number = sys.argv[1:5]
real, counted = files.AtomicFile.commit, Path(root + ".counted")

def commit(self):
    counts = self.path.name == "run.json" or "/tables/" in str(self.path)
    if counts:
        with counted.open("ab") as stream:
            stream.write(b".")
    last = counts and counted.stat().st_size == int(number)
    if last and side == "before":
        os.killpg(0, signal.SIGKILL)
    sha256 = real(self)
    if last:
        os.killpg(0, signal.SIGKILL)
    return sha256

files.AtomicFile.commit = commit
if __name__ == "__main__":
    from fieldcal.flows.run import run_night
    run_night(Path(archive), Path(root))
    print(counted.stat().st_size)
"""


def night(archive: Path, root: Path, side: str = BEFORE, number: int = 0) -> subprocess.Popen[str]:
    """A night that is killed at its `number`-th file; 0: never, and it prints how many there were."""
    program = root.parent / "night.py"
    program.write_text(NIGHT, encoding="utf-8")
    return subprocess.Popen(
        [sys.executable, str(program), str(archive), str(root), side, str(number)],
        cwd=REPOSITORY,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        start_new_session=True,
    )


def killed_at(archive: Path, root: Path, side: str, number: int) -> bool:
    """Run a night that is killed at a boundary; whether it was."""
    process = night(archive, root, side, number)
    process.communicate()
    return process.returncode == -signal.SIGKILL


def killed_after(archive: Path, root: Path, seconds: float) -> bool:
    """Run a night that is killed after so many seconds; whether it still ran."""
    process = night(archive, root)
    time.sleep(seconds)
    running = process.poll() is None
    if running:
        os.killpg(process.pid, signal.SIGKILL)
    process.communicate()
    return running


def main() -> None:
    """All boundaries, then random times."""
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--random", type=int, default=20)
    arguments.add_argument("--flights", type=int, default=1)
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
        write_flights(archive, Experiment(seed=SEED, duration_s=20.0), vehicles=2, flights=given.flights)
        whole = night(archive, Path(folder) / "whole")
        began = time.monotonic()
        files = int(whole.communicate()[0])
        longest = time.monotonic() - began
        expected = content_sha256(Path(folder) / "whole")

        wrong = 0
        rng = random.Random(SEED)
        rounds: list[tuple[str, float]] = [(side, n) for n in range(1, files + 1) for side in (BEFORE, AFTER)]
        rounds += [("at random", rng.uniform(0.1, longest)) for _ in range(given.random)]
        for number, (side, when) in enumerate(rounds):
            root = Path(folder) / f"round-{number}"
            killed = (
                killed_after(archive, root, when) if side == "at random" else killed_at(archive, root, side, int(when))
            )
            run_night(archive, root)
            same = content_sha256(root) == expected and verify(root)["ok"]
            wrong += not same
            at = f"{when:.2f} s" if side == "at random" else f"{side} file {int(when)} of {files}"
            print(f"{at}: {'killed' if killed else 'had ended'}, {'same' if same else 'DIFFERENT'}", flush=True)
        print(f"{len(rounds)} rounds, {wrong} with another content hash or a damaged file")
        sys.exit(1 if wrong else 0)


if __name__ == "__main__":
    main()
