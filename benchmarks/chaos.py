"""A small fleet's nights under all that goes wrong, in random order; the end must be that of an undisturbed night.

    python benchmarks/chaos.py [--minutes 30] [--seed 1]

A round: something happens to a night (its main process, a worker or Prefect's server is killed; files may not grow, as
on a full disk; a bit of a stored file is turned; a hostile file lies in the archive; the clock of its processes jumps),
then, with that out of the way, another night runs to its end. It must end with the content hash of an undisturbed one
and no damaged file; after a turned bit it may refuse, if it names the file, which is restored then. Results stay from
round to round, but for some rounds, which begin with an empty warehouse.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parent.parent
PATIENCE_S = 600.0
ANEW_SHARE = 0.5
FILE_BYTES = (0, 20_000, 200_000, 2_000_000)
"""Sizes at which a full disk stops a file."""
JUMPS_S = (-10 * 365 * 86_400, -3600, 3600, 40 * 365 * 86_400)
HEADER = "t,ax,ay,az,gx,gy,gz,mx,my,mz\n"
NIGHT = """
import sys, time
real, jump = time.time, float(sys.argv[1])
if jump:
    time.time = lambda: real() + jump
    time.time_ns = lambda: int((real() + jump) * 1e9)
if __name__ == "__main__":
    from fieldcal.cli.main import run
    sys.exit(run(sys.argv[2:]))
"""
"""The workers run this too, but for its last lines."""

Deed = Callable[["Fleet", random.Random], None]


class Fleet:
    """An archive and its warehouse."""

    def __init__(self, folder: Path) -> None:
        self.archive, self.root = folder / "archive", folder / "warehouse"
        self.program = folder / "night.py"
        self.program.write_text(NIGHT, encoding="utf-8")
        self.kept: tuple[Path, bytes] | None = None
        """A file with a turned bit, and what it held."""

    def night(self, jump_s: float = 0.0, file_bytes: int | None = None) -> subprocess.Popen[str]:
        """Start a night on two workers, in a process group of its own."""
        limit = [] if file_bytes is None else ["prlimit", f"--fsize={file_bytes}"]
        command = ["nightly", str(self.archive), "--warehouse", str(self.root), "--workers=2", "--json"]
        return subprocess.Popen(
            [*limit, sys.executable, str(self.program), str(jump_s), *command],
            cwd=REPOSITORY,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )

    def children(self, pid: int, mark: bytes) -> list[int]:
        """Processes that a process started, by what stands in their command line."""
        try:
            listed = Path(f"/proc/{pid}/task/{pid}/children").read_text(encoding="ascii").split()
            return [int(child) for child in listed if mark in Path(f"/proc/{child}/cmdline").read_bytes()]
        except OSError:
            return []


def killed(mark: bytes | None) -> Deed:
    """Kill the night (None), or one of its processes, at a random time."""

    def deed(fleet: Fleet, rng: random.Random) -> None:
        process = fleet.night()
        time.sleep(rng.uniform(0.5, 25.0))
        victims = [process.pid] if mark is None else fleet.children(process.pid, mark)
        if process.poll() is None and victims:
            os.kill(rng.choice(victims), signal.SIGKILL)
        process.communicate(timeout=PATIENCE_S)

    return deed


def disk_full(fleet: Fleet, rng: random.Random) -> None:
    """No file may grow beyond a size."""
    fleet.night(file_bytes=rng.choice(FILE_BYTES)).communicate(timeout=PATIENCE_S)


def clock_jump(fleet: Fleet, rng: random.Random) -> None:
    """The night believes another time."""
    fleet.night(jump_s=rng.choice(JUMPS_S)).communicate(timeout=PATIENCE_S)


def flip(fleet: Fleet, rng: random.Random) -> None:
    """Turn a bit of something that is kept."""
    places = ("tables", "signals", "stages", "night", "checksums", "reports")
    files = [path for place in places for path in sorted((fleet.root / place).rglob("*")) if path.is_file()]
    files = [path for path in files if path.stat().st_size]
    if files:
        path = rng.choice(files)
        data = bytearray(path.read_bytes())
        fleet.kept = path, bytes(data)
        data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
        path.write_bytes(bytes(data))


def hostile_file(fleet: Fleet, rng: random.Random) -> None:
    """Something lies in the archive for one night that is no log."""
    session = fleet.archive / "hostile" / "s"
    session.mkdir(parents=True)
    place = os.path.join(os.fsencode(session), rng.choice([b"log.csv", b"log.mcap", b"l\xffg.csv", b"=\x1b[2J.csv"]))
    if rng.random() < 0.2:
        os.mkfifo(place)
    else:
        digits = "1" * rng.randrange(900_000)
        texts = [
            rng.randbytes(rng.randrange(100_000)),
            (HEADER + digits + ",1,2\n" + digits).encode(),
            b"#\n" * 500_000,
        ]
        Path(os.fsdecode(place)).write_bytes(rng.choice(texts))
    fleet.night().communicate(timeout=PATIENCE_S)
    shutil.rmtree(fleet.archive / "hostile")
    shutil.rmtree(fleet.root, ignore_errors=True)  # its history would stay


DEEDS: dict[str, Deed] = {
    "main killed": killed(None),
    "worker killed": killed(b"spawn_main"),
    "server killed": killed(b"prefect"),
    "disk full": disk_full,
    "clock jump": clock_jump,
    "flip": flip,
    "hostile file": hostile_file,
}


def settled(fleet: Fleet, expected: str) -> str | None:
    """Run the night that must end well; what is wrong, None where nothing is."""
    from fieldcal.warehouse.content import content_sha256
    from fieldcal.warehouse.upkeep.verify import verify

    process = fleet.night()
    told, talk = process.communicate(timeout=PATIENCE_S)
    if process.returncode and fleet.kept is not None:
        path, data = fleet.kept
        if process.returncode != 1 or path.name not in talk:
            return f"exit code {process.returncode} without the damaged file's name: {talk[-500:]}"
        path.write_bytes(data)
        process = fleet.night()
        told, talk = process.communicate(timeout=PATIENCE_S)
    fleet.kept = None
    if process.returncode or "Traceback" in talk:
        return f"exit code {process.returncode}: {talk[-500:]}"
    json.loads(told)
    damaged = verify(fleet.root)["damaged"]
    if damaged:
        return f"damaged: {damaged[:3]}"
    return None if content_sha256(fleet.root) == expected else "another content hash"


def main() -> None:
    """Rounds until the time is up."""
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--minutes", type=float, default=30.0)
    arguments.add_argument("--seed", type=int, default=1)
    given = arguments.parse_args()

    from fieldcal.simulation.archive import write_flights
    from fieldcal.simulation.experiment import Experiment
    from fieldcal.warehouse.content import content_sha256

    rng = random.Random(given.seed)
    rounds: Counter[str] = Counter()
    falls = 0
    with tempfile.TemporaryDirectory() as folder:
        fleet = Fleet(Path(folder))
        write_flights(fleet.archive, Experiment(seed=given.seed, duration_s=20.0, sets=1), vehicles=2, flights=2)
        fleet.night().communicate(timeout=PATIENCE_S)
        expected = content_sha256(fleet.root)
        give_up = time.monotonic() + 60.0 * given.minutes
        while time.monotonic() < give_up:
            what = rng.choice(list(DEEDS))
            if what != "flip" and rng.random() < ANEW_SHARE:
                shutil.rmtree(fleet.root, ignore_errors=True)
            DEEDS[what](fleet, rng)
            problem = settled(fleet, expected)
            rounds[what] += 1
            falls += problem is not None
            print(f"round {rounds.total()}: {what}: {problem or 'same'}", flush=True)
            if problem is not None:
                shutil.rmtree(fleet.root, ignore_errors=True)
                fleet.kept = None
    print(f"{rounds.total()} rounds ({', '.join(f'{n} {what}' for what, n in sorted(rounds.items()))}), falls: {falls}")
    sys.exit(1 if falls else 0)


if __name__ == "__main__":
    main()
