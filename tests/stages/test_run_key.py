"""`run_key` changes when something that can change the result does, and only then."""

from __future__ import annotations

import functools
import importlib
import os
import subprocess
import sys
import textwrap
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from fieldcal.config.configuration import load
from fieldcal.stages import run_key
from fieldcal.stages.run_key import source_digest

STAGES = '''
"""Stages."""
from toy import alpha
from toy.beta import LIMIT
import toy.gamma

SHARED = 3

def helper(x):
    return x + SHARED

def first(x):
    """Uses alpha and the helper."""
    return alpha.double(helper(x))

def second(x):
    from toy.delta import late
    return late(x) + LIMIT

def third(x):
    return toy.gamma.f(x)

def fourth(x):
    return x
'''
FILES = {
    "__init__": "",
    "stages": STAGES,
    "alpha": "from toy import deep\ndef double(x):\n    return deep.twice(x)\n",
    "deep": "def twice(x):\n    return 2 * x\n",
    "beta": "LIMIT = 4\n",
    "gamma": "from . import deep\nfrom .inner import thing\ndef f(x):\n    return x\n",
    "inner/__init__": "from .leaf import thing\n",
    "inner/leaf": "thing = 1\n",
    "delta": "def late(x):\n    return x\n",
    "report": "def page():\n    return ''\n",
}


@pytest.fixture
def toy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A project package `toy` that provenance takes for its own."""
    for name, text in FILES.items():
        path = tmp_path / "toy" / f"{name}.py"
        path.parent.mkdir(exist_ok=True)
        path.write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(run_key, "PROJECT", ("toy",))
    forget()
    yield tmp_path / "toy"
    for name in [name for name in sys.modules if name.split(".")[0] == "toy"]:
        del sys.modules[name]
    forget()


def forget() -> None:
    run_key._path.cache_clear()
    run_key._package_folder.cache_clear()


def stages() -> ModuleType:
    return importlib.import_module("toy.stages")


def keys() -> dict[str, str]:
    return {name: run_key.source_digest(getattr(stages(), name)) for name in ("first", "second", "third", "fourth")}


def edit(toy: Path, name: str, old: str, new: str) -> set[str]:
    """Stages whose digest changes with this edit."""
    before = keys()
    path = toy / f"{name}.py"
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new))
    os.utime(path, ns=(1, path.stat().st_mtime_ns + 1_000_000))
    return {stage for stage, digest in keys().items() if digest != before[stage]}


@pytest.mark.parametrize(
    ("name", "old", "new", "changed"),
    [
        ("alpha", "deep.twice", "2 * deep.twice", {"first"}),
        ("deep", "2 * x", "3 * x", {"first", "third"}),
        ("beta", "4", "5", {"second"}),
        ("delta", "return x", "return -x", {"second"}),
        ("gamma", "return x", "return -x", {"third"}),
        ("inner/leaf", "1", "2", {"third"}),
        ("report", "''", "'x'", set()),
        ("stages", "SHARED = 3", "SHARED = 4", {"first"}),
        ("stages", "x + SHARED", "x - SHARED", {"first"}),
        ("stages", "+ LIMIT", "- LIMIT", {"second"}),
        ("stages", "    return x\n", "    return 2 * x\n", {"fourth"}),
        ("stages", '"""Stages."""', '"""The stages."""', set()),
        ("stages", "SHARED = 3", "SHARED = 3\nprint()", {"first", "second", "third", "fourth"}),
    ],
)
def test_an_edit_concerns_the_stages_that_reach_it(toy: Path, name: str, old: str, new: str, changed: set[str]) -> None:
    assert edit(toy, name, old, new) == changed


def test_reached_modules_are_named(toy: Path) -> None:
    assert toy.is_dir()
    assert run_key.reached_modules(stages().first) == ("toy.alpha", "toy.deep")
    assert run_key.reached_modules(stages().second) == ("toy.beta", "toy.delta")
    assert run_key.reached_modules(stages().third) == ("toy.deep", "toy.gamma", "toy.inner", "toy.inner.leaf")
    assert run_key.reached_modules(stages().fourth) == ()


def test_wrapped_and_partial_functions_are_seen_through(toy: Path) -> None:
    assert toy.is_dir()
    first: Callable[[int], int] = stages().first

    @functools.wraps(first)
    def wrapped(x: int) -> int:
        return first(x)

    assert run_key.source_digest(wrapped) == run_key.source_digest(first)
    assert run_key.source_digest(functools.partial(first, 1)) == run_key.source_digest(first)
    assert run_key.source_digest(stages().helper) != run_key.source_digest(first)


def test_every_part_of_the_key_counts() -> None:
    base = run_key.run_key("s", source_digest(load), {"a": 1.0, "b": [1, 2]}, {"imu": "1", "vps": "2"})
    assert len(base) == 32
    assert int(base, 16) >= 0
    assert run_key.run_key("s", source_digest(load), {"b": [1, 2], "a": 1.0}, {"vps": "2", "imu": "1"}) == base
    different = {
        run_key.run_key("t", source_digest(load), {"a": 1.0, "b": [1, 2]}, {"imu": "1", "vps": "2"}),
        run_key.run_key("s", source_digest(run_key.run_key), {"a": 1.0, "b": [1, 2]}, {"imu": "1", "vps": "2"}),
        run_key.run_key("s", source_digest(load), {"a": 1.5, "b": [1, 2]}, {"imu": "1", "vps": "2"}),
        run_key.run_key("s", source_digest(load), {"a": 1.0, "b": [2, 1]}, {"imu": "1", "vps": "2"}),
        run_key.run_key("s", source_digest(load), {"a": 1.0, "b": [1, 2]}, {"imu": "2", "vps": "1"}),
        run_key.run_key("s", source_digest(load), {"a": 1.0, "b": [1, 2]}, {"imu": "1"}),
        run_key.run_key("s", source_digest(load), {"a": 1.0, "b": [1, 2]}, {"imu": "1", "vps": "2"}, extra={"x": 1}),
    }
    assert len(different | {base}) == 8


def test_versions_of_the_libraries_count(monkeypatch: pytest.MonkeyPatch) -> None:
    before = run_key.run_key("s", source_digest(load), {}, {})
    assert set(run_key.library_versions()) == {"numpy", "scipy", "polars"}
    monkeypatch.setattr(run_key, "library_versions", lambda: {"numpy": "99"})
    assert run_key.run_key("s", source_digest(load), {}, {}) != before


def test_parameters_must_be_plain_json() -> None:
    with pytest.raises(ValueError, match="JSON compliant"):
        run_key.run_key("s", source_digest(load), {"a": float("nan")}, {})
    with pytest.raises(TypeError):
        run_key.run_key("s", source_digest(load), {"a": np.float32(1.0)}, {})


def test_the_key_is_the_same_in_every_process() -> None:
    script = """
        from fieldcal.config.configuration import load
        from fieldcal.stages.run_key import run_key, source_digest
        print(run_key("s", source_digest(load), load(None).vehicle("v").settings(), {"imu": "1", "vps": "2"}))
    """
    found = {
        subprocess.run(
            [sys.executable, "-c", textwrap.dedent(script)],
            env={**os.environ, "PYTHONHASHSEED": seed, "TZ": zone},
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        for seed, zone in (("0", "UTC"), ("1", "Asia/Tokyo"))
    }
    assert len(found) == 1
