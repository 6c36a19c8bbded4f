"""Three ways from a log to an answer, as a new user goes them: commands counted, each timed.

    python benchmarks/journeys.py FOLDER                 simulated logs, in a folder that is made
    python benchmarks/journeys.py FOLDER --px4 LOG.ulg   the first one with a log of one's own

1. A PX4 log → constants → a parameter file. 2. CSV files in physical units → drift over three sessions.
3. Nights on a server that tell somebody: a webhook on this machine hears them."""

from __future__ import annotations

import argparse
import http.server
import json
import shutil
import subprocess
import sys
import threading
import time
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from fieldcal.names import SENSORS
from fieldcal.simulation.archive import write_flight
from fieldcal.simulation.experiment import Experiment, constants_at, simulate

SESSIONS = 3
SHORT = {"gyroscope": ("g", "rad/s"), "accelerometer": ("a", "m/s^2"), "magnetometer": ("m", "uT")}
FIELD_UT = 48.0
SHOWN = 400
"""Characters of what a command says."""


def run(folder: Path, *command: str) -> float:
    """One command as it is typed; how long it took."""
    began = time.monotonic()
    done = subprocess.run([sys.executable, "-m", "fieldcal", *command], cwd=folder, capture_output=True, text=True)
    took = time.monotonic() - began
    print(f"$ fieldcal {' '.join(command)}    ({took:.1f} s, exit code {done.returncode})")
    print("    " + (done.stdout.strip() or done.stderr.strip())[:SHOWN].replace("\n", "\n    ") + "\n")
    return took


def told(name: str, times: list[float]) -> None:
    print(f"== {name}: {len(times)} command{'' if len(times) == 1 else 's'}, {sum(times):.0f} s\n")


def px4(folder: Path, log: Path | None) -> None:
    own = folder / "logs" / "my-quad" / "monday"
    own.mkdir(parents=True)
    if log is None:
        write_flight(
            own, "flight", simulate(Experiment(vps=False)), datetime(2026, 5, 4, tzinfo=UTC), log_format="ulog"
        )
    else:
        shutil.copy(log, own / log.name)
    (name,) = [path.name for path in own.iterdir() if path.suffix == ".ulg"]
    first = [run(folder, "calibrate", f"logs/my-quad/monday/{name}")]
    told("PX4 log → constants", first)
    after = [
        run(folder, "nightly", "logs"),
        run(folder, "export", "my-quad", "--format", "px4", "-o", "my-quad.params"),
    ]
    told("PX4 log → parameter file", first + after)


def csv(folder: Path) -> None:
    """Readings in physical units, with offsets of a sensor that nobody calibrated."""
    for k in range(SESSIONS):
        day = datetime.now(UTC) - timedelta(days=1 + 7 * (SESSIONS - 1 - k))
        flight = simulate(replace(Experiment(vps=False), seed=k + 1))
        columns = {"t [s]": flight.t}
        for number, sensor in enumerate(SENSORS):
            scale, bias = constants_at(flight.experiment, sensor, 25.0)
            z = flight.counts[sensor] * scale + bias
            own = (1.0 + 0.01 * np.arange(3)) * z + 0.01 * (number + 1)
            short, unit = SHORT[sensor]
            for i, axis in enumerate("xyz"):
                columns[f"{short}{axis} [{unit}]"] = own[:, i] * (FIELD_UT if sensor == "magnetometer" else 1.0)
        place = folder / "logs" / "my-phone" / f"{day:%Y-%m-%d}"
        place.mkdir(parents=True)
        pl.DataFrame(columns).write_csv(place / "walk.csv")
    told(
        f"CSV → drift over {SESSIONS} sessions",
        [run(folder, "init", "logs"), run(folder, "nightly", "logs"), run(folder, "drift", "--vehicle", "my-phone")],
    )


class Hook(http.server.BaseHTTPRequestHandler):
    """Hears messages."""

    def do_POST(self) -> None:
        said: dict[str, Any] = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
        print(f"    heard: {said['title']}\n    " + said["message"].strip().replace("\n", "\n    ") + "\n")
        self.send_response(200)
        self.end_headers()

    def log_message(self, format: str, *args: object) -> None:
        """Nothing."""


def server(folder: Path) -> None:
    session = folder / "logs" / "quad-1" / "monday"
    session.mkdir(parents=True)
    write_flight(session, "flight", simulate(Experiment()), datetime.now(UTC) - timedelta(days=1))
    (session / "cut.mcap").write_bytes(b"")
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Hook) as hook:
        threading.Thread(target=hook.serve_forever, daemon=True).start()
        to = f'[alerts]\nto = ["json://127.0.0.1:{hook.server_address[1]}"]\n'
        (folder / "logs" / "fieldcal.toml").write_text(to)
        told("nights that tell somebody", [run(folder, "alerts", "test", "logs"), run(folder, "nightly", "logs")])
        hook.shutdown()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--px4", type=Path, help="a ULog of one's own")
    options = parser.parse_args()
    for name in ("px4", "csv", "server"):
        (options.folder / name).mkdir(parents=True)
    px4(options.folder / "px4", options.px4 and options.px4.absolute())
    csv(options.folder / "csv")
    server(options.folder / "server")


if __name__ == "__main__":
    main()
