"""What the tests on board share: readings of a vehicle that tilts; the C on this machine and on a Cortex-M4F."""

from __future__ import annotations

import os
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from numpy.random import Generator
from scipy.spatial.transform import Rotation
from scipy.special import ndtr

from fieldcal.geometry.rotation import Array
from fieldcal.onboard import BoardSettings, write_sources

PROGRAMS = Path(__file__).parent / "onboard" / "c"
WARNINGS = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-Wdouble-promotion", "-Wconversion")
CORTEX_M4F = ("-mcpu=cortex-m4", "-mthumb", "-mfpu=fpv4-sp-d16", "-mfloat-abi=hard")
EMULATOR = ("qemu-system-arm", "-M", "mps2-an386", "-nographic", "-monitor", "none", "-serial", "none")
SEMIHOSTING = ("-semihosting-config", "enable=on,target=native", "-icount", "shift=0")
FIELD = np.array([0.5, 0.0, np.sqrt(0.75)])
"""A field that dips by 60°."""

SAMPLE = np.dtype(
    [("t_us", "<u4"), ("has_field", "<u4"), ("gyroscope", "<f4", 3), ("accelerometer", "<f4", 3), ("field", "<f4", 3)]
)
"""What `replay.c` reads."""


def tilting(rng: Generator, n: int, tilt_deg: float, interval_s: float = 0.01) -> Array:
    """Attitudes as A (n, 3, 3): bank, pitch and heading swing smoothly, each spread evenly within ± a tilt."""
    t = interval_s * np.arange(n)
    waves = np.sin(2 * np.pi * rng.uniform(0.05, 0.4, (3, 6)) * t[:, None, None] + rng.uniform(0, 2 * np.pi, (3, 6)))
    even = 2.0 * ndtr(waves.sum(axis=2) / np.sqrt(3.0)) - 1.0
    angles = np.radians(tilt_deg) * even
    return np.asarray(Rotation.from_euler("ZYX", angles[:, ::-1]).inv().as_matrix())


def readings(a: Array, scale: Array, bias: Array, noise: Array | float, rng: Generator) -> Array:
    """What a triad logs of FIELD at attitudes A (n, 3, 3): scale · logged + bias, noise (its sd, logged units)."""
    z = np.linalg.solve(scale, (a @ FIELD - bias).T).T
    return np.asarray(z + noise * rng.normal(size=z.shape))


def needs(program: str) -> None:
    """Skip where a program is missing; in CI, which installs it, fail."""
    if shutil.which(program) is None:
        told = f"{program} is not installed (.ci/run names its package)"
        if os.environ.get("CI"):
            pytest.fail(told)
        pytest.skip(told)


def run(*command: str | Path, cwd: Path) -> str:
    """Standard output of a command."""
    done = subprocess.run([str(part) for part in command], cwd=cwd, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-4000:]
    return done.stdout


@dataclass(frozen=True)
class Machine:
    """Where C runs."""

    name: str

    def run(self, program: str, folder: Path) -> dict[str, list[float]]:
        """Run a program of `PROGRAMS` with the sources in a folder there, compiled once: what it tells, by name."""
        place = folder / f"{program}.{self.name}"
        if self.name == "host":
            if not place.exists():
                self.build_host(program, folder, place)
            told = run(place, cwd=folder)
        else:
            if not place.exists():
                self.build_cortex_m4f(program, folder, place)
            told = run(*EMULATOR, *SEMIHOSTING, "-kernel", place, cwd=folder)
        return {line.split(" ")[0]: [float(word) for word in line.split(" ")[1:]] for line in told.splitlines()}

    def build_host(self, program: str, folder: Path, place: Path) -> None:
        needs("cc")
        sanitizers = ("-O0", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
        sources = (folder / "fieldcal_onboard.c", PROGRAMS / program)
        run("cc", *WARNINGS, *sanitizers, "-I", folder, *sources, "-lm", "-o", place, cwd=folder)

    def build_cortex_m4f(self, program: str, folder: Path, place: Path, *more: str, optimise: str = "-Os") -> None:
        """For an emulated MPS2 AN386, whose files and output are this machine's."""
        needs("arm-none-eabi-gcc")
        needs("qemu-system-arm")
        start = run("arm-none-eabi-gcc", *CORTEX_M4F, "--print-file-name=rdimon-crt0.o", cwd=folder).strip()
        link = ("--specs=rdimon.specs", "-nostartfiles", start, "-T", PROGRAMS / "mps2.ld", "-Wl,--gc-sections")
        sources = (PROGRAMS / "startup.c", folder / "fieldcal_onboard.c", PROGRAMS / program)
        flags = (*CORTEX_M4F, *WARNINGS, optimise, "-ffunction-sections", *more, "-I", folder)
        run("arm-none-eabi-gcc", *flags, *sources, *link, "-lm", "-o", place, cwd=folder)


MACHINES = (Machine("host"), Machine("cortex-m4f"))


def fly(machine: Machine, folder: Path, settings: BoardSettings, flight: np.ndarray) -> dict[str, list[float]]:
    """A flight (n,) of SAMPLE through the board's duty in C; it leaves `dump.bin` in the folder, which is of one
    configuration."""
    write_sources(folder, settings)
    flight.tofile(folder / "flight.bin")
    return machine.run("replay.c", folder)
