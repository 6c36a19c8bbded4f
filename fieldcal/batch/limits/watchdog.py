"""Ends the process that started it when that takes more than it may. A program of its own: `python watchdog.py PID`.

It knows the standard library only, so that it starts in a few hundredths of a second and weighs 10 MB. Each line on its
standard input is a JSON object: `work` (a number; another one begins the count anew), `place` (a path), and `limits`,
for each of "seconds", "cpu_seconds" and "memory_mb" how much may be taken and the text that is written to `place`
before the process is killed. A line without `work` ends the watch, the end of the input the program.
"""

from __future__ import annotations

import json
import os
import select
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

LOOK_EVERY_S = 0.1
_READ_BYTES = 1 << 16
_TICKS_PER_S = os.sysconf("SC_CLK_TCK")


def taken(pid: int) -> tuple[float, float]:
    """Seconds of the processor that a process took so far, and the MB it holds: memory of its own, mapped files and
    what others share with it do not count."""
    if not os.path.isdir("/proc/self"):
        return _told_by_ps(pid)
    stat = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace")
    user, system = stat.rpartition(")")[2].split()[11:13]
    held = 0
    for line in Path(f"/proc/{pid}/status").read_text(encoding="utf-8", errors="replace").splitlines():
        if line.startswith(("RssAnon:", "VmSwap:")):
            held += int(line.split()[1])
    return (int(user) + int(system)) / _TICKS_PER_S, held / 1024


def _told_by_ps(pid: int) -> tuple[float, float]:
    """The same where there is no /proc; mapped files count there."""
    told = subprocess.run(["ps", "-o", "rss=,time=", "-p", str(pid)], capture_output=True, text=True, check=True)
    held, clock = told.stdout.split()
    days, _, rest = clock.rpartition("-")
    seconds = 0.0
    for part in rest.split(":"):
        seconds = seconds * 60 + float(part)
    return seconds + 86400 * int(days or 0), int(held) / 1024


def watch(pid: int) -> None:
    """Watch what is told on standard input, until that ends or the process is over a limit."""
    rest = b""
    given: Any = {}
    began_s, before_s = 0.0, 0.0
    while True:
        heard = select.select([0], [], [], LOOK_EVERY_S if given else None)[0]
        if heard:
            piece = os.read(0, _READ_BYTES)
            if not piece:
                return
            *lines, rest = (rest + piece).split(b"\n")
            if not lines:
                continue
            told = json.loads(lines[-1])
            if told.get("work") != given.get("work"):
                began_s, before_s = time.monotonic(), taken(pid)[0]
            given = told if "work" in told else {}
        if given:
            cpu_s, held_mb = taken(pid)
            now = {"seconds": time.monotonic() - began_s, "cpu_seconds": cpu_s - before_s, "memory_mb": held_mb}
            for name, (most, text) in given["limits"].items():
                if now[name] > most:
                    _end(pid, Path(given["place"]), text)
                    return


def _end(pid: int, place: Path, text: str) -> None:
    """Write the text and kill the process; it is stopped first, so that it takes no more meanwhile."""
    if os.getppid() != pid:
        return
    os.kill(pid, signal.SIGSTOP)
    try:
        place.parent.mkdir(parents=True, exist_ok=True)
        beside = place.with_name(f".{pid}-{time.time_ns()}.tmp")
        beside.write_bytes(text.encode())
        beside.replace(place)
    finally:
        os.kill(pid, signal.SIGKILL)


if __name__ == "__main__":
    # Ctrl-C is for the process it watches, with whose end its input ends.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with suppress(FileNotFoundError, ProcessLookupError):  # the process has just ended
        watch(int(sys.argv[1]))
