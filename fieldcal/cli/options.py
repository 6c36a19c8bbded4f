"""Options that several commands have alike."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter, Token


def _whole(type_: object, tokens: Sequence[Token]) -> int:
    """A whole number, which the library that reads the command line would make of any other by rounding it."""
    text = tokens[0].value
    try:
        return int(text)
    except ValueError as error:
        raise ValueError(f"{text} is no whole number.") from error


Whole = Annotated[int, Parameter(converter=_whole)]
Config = Annotated[Path | None, Parameter(help="fieldcal.toml to use; else the archive's own, if it has one.")]
UnusedConfig = Annotated[Path | None, Parameter(show=False)]
"""Every command takes `--config`; these need nothing of it."""
Place = str
"""A path, or a URL, in which a path would lose a slash."""
Root = Annotated[
    Place | None,
    Parameter(name="--warehouse", help="Data root or its URL; else FIELDCAL_WAREHOUSE, else ./fieldcal-data."),
]
UnusedRoot = Annotated[Place | None, Parameter(show=False)]
AsJson = Annotated[bool, Parameter(name="--json", negative="", help="One JSON document on stdout.")]
AsCsv = Annotated[bool, Parameter(name="--csv", negative="", help="CSV on stdout.")]
Wide = Annotated[bool, Parameter(name="--wide", negative="", help="All rows and columns, as wide as they are.")]
DryRun = Annotated[bool, Parameter(help="List what would run; change nothing.")]
Output = Annotated[Path | None, Parameter(name=["--output", "-o"])]
SessionFolder = Annotated[Place, Parameter(name="SESSION_DIR")]
Workers = Annotated[int, Parameter(converter=_whole, help="Processes that calibrate; results do not depend on it.")]
Runner = Annotated[
    Literal["process", "dask", "pool"],
    Parameter(help="Where they run: on this machine, on a Dask cluster, or in the work pool of prefect.yaml."),
]
Scheduler = Annotated[str | None, Parameter(help="Address of the Dask scheduler; else a cluster on this machine.")]
