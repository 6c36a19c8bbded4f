"""`run_key`: the digest that says whether a stage need not run again.

It covers the stage's name, the parameters that change results, the content of the input tables, the versions of numpy,
scipy and polars, which kernel computes (`fieldcal.compiled`), and the meaning of the source that the stage reaches
(`fieldcal.provenance`): comments, docstrings and formatting do not count, nor do definitions that nothing on the way
names. Execution settings never enter.
"""

from __future__ import annotations

import functools
import hashlib
import importlib.metadata
import inspect
import json
from collections.abc import Callable, Mapping

from fieldcal.compiled import kernel_name
from fieldcal.names import Json
from fieldcal.provenance.reached_code import reach_digest
from fieldcal.provenance.source_tree import files_below, installed

PROJECT = "fieldcal"
LIBRARIES = ("numpy", "scipy", "polars")
KERNEL = "kernel"
VERSIONED = (*LIBRARIES, KERNEL)


def run_key(
    stage_name: str,
    source: str,
    params: Mapping[str, Json],
    input_hashes: Mapping[str, str],
) -> str:
    """Digest of one execution of a stage: 32 hex digits, the same in every process.

    Parameters
    ----------
    stage_name : str
        Name of the stage.
    source : str
        `source_digest` of what the stage runs, taken when that was imported: a file edited since is not what runs.
    params : mapping
        Parameters that change results; plain JSON without NaN.
    input_hashes : mapping
        Content hash of every input table, by its name.

    Raises
    ------
    TypeError, ValueError
        A parameter is not plain JSON (a numpy value, NaN).
    """
    content = {
        "stage": stage_name,
        "params": dict(params),
        "inputs": dict(input_hashes),
        "source": source,
        "versions": library_versions(),
    }
    text = json.dumps(content, sort_keys=True, allow_nan=False, separators=(",", ":"), ensure_ascii=True)
    return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()


@functools.cache
def library_versions() -> dict[str, str]:
    """Versions of the libraries whose change may change results, and which kernel computes: C and NumPy round
    differently."""
    return {**{name: importlib.metadata.version(name) for name in LIBRARIES}, KERNEL: kernel_name()}


@functools.cache
def code_digest() -> str:
    """One digest of every file of the package, by which the processes of a night tell that they run the same."""
    digest = hashlib.sha256()
    folder = installed(PROJECT).folder
    for path in files_below(folder):
        digest.update(f"{path.relative_to(folder).as_posix()}\0".encode())
        digest.update(hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()


def source_digest(*functions: Callable[..., object]) -> str:
    """32 hex digits of the source that functions of the project reach, as it was when it was first read.

    Parameters
    ----------
    *functions : callable
        Top-level functions or classes of the project; wrapped ones and partials stand for what they wrap.

    Raises
    ------
    LookupError
        One is not a top-level definition of the project.
    """
    return reach_digest(installed(PROJECT), [dotted_name(function) for function in functions])


def dotted_name(function: Callable[..., object]) -> str:
    """Module and name of what `functools.wraps` and `functools.partial` wrap."""
    target = inspect.unwrap(function.func if isinstance(function, functools.partial) else function)
    return f"{target.__module__}.{target.__qualname__}"
