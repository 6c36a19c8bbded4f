"""Folders that are one CSV log: which of their files hold what."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

VPS = "vps.csv"


@dataclass(frozen=True)
class FolderLayout:
    """Files of a folder, all of which hold columns of the IMU. `needed`: without them it is no such folder; `optional`:
    sensors that a log may lack. `apart`: gyroscope and accelerometer have a file each, and are joined."""

    needed: tuple[str, ...]
    optional: tuple[str, ...] = ()
    apart: bool = False


LAYOUTS = (
    FolderLayout(("imu.csv",)),
    FolderLayout(("Gyroscope.csv", "Accelerometer.csv"), ("Magnetometer.csv",), apart=True),
    FolderLayout(("Inertial.csv",), ("Magnetometer.csv", "Temperature.csv")),
)
"""fieldcal's own; phyphox's, an export of its raw sensors; an x-IMU3's."""


def folder_layout(folder: Path) -> FolderLayout | None:
    """The layout of a folder that is a CSV log; None of another."""
    return next((layout for layout in LAYOUTS if all((folder / name).is_file() for name in layout.needed)), None)


def optional_files(folder: Path, layout: FolderLayout) -> Iterator[tuple[str, str]]:
    """Files beside the needed ones that are there, and what each holds: "imu" columns, or the "vps"."""
    yield from ((name, "imu") for name in layout.optional if (folder / name).is_file())
    if (folder / VPS).is_file():
        yield VPS, "vps"
