"""`run_key` changes when something that can change the result does, and only then."""

from __future__ import annotations

import functools
import os
import subprocess
import sys
import textwrap
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fieldcal import compiled
from fieldcal.config.configuration import load
from fieldcal.provenance import run_key
from fieldcal.provenance.run_key import source_digest
from fieldcal.provenance.source_tree import SourceTree


def test_wrapped_and_partial_functions_are_seen_through() -> None:
    @functools.wraps(load)
    def wrapped(path: Path | None) -> Any:
        return load(path)

    assert source_digest(wrapped) == source_digest(load)
    assert source_digest(functools.partial(load, None)) == source_digest(load)
    assert source_digest(run_key.run_key) != source_digest(load)
    assert source_digest(load, run_key.run_key) == source_digest(run_key.run_key, load)


def test_a_function_of_no_top_level_has_no_digest() -> None:
    with pytest.raises(LookupError, match="no definition of the source"):
        source_digest(lambda: None)


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
    }
    assert len(different | {base}) == 7


def test_versions_of_the_libraries_count(monkeypatch: pytest.MonkeyPatch) -> None:
    before = run_key.run_key("s", source_digest(load), {}, {})
    assert set(run_key.library_versions()) == {"numpy", "scipy", "polars", "kernel"}
    assert run_key.library_versions()["kernel"] == compiled.kernel_name()
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
        from fieldcal.provenance.run_key import run_key, source_digest
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


def test_the_digest_of_all_code_covers_every_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "part").mkdir()
    for name in ("__init__.py", "part/view.sql", "part/kernel.so", "part/.hidden", "part/deep.py"):
        (tmp_path / name).write_text("1")
    monkeypatch.setattr(run_key, "installed", lambda package: SourceTree(package, tmp_path))

    def after(name: str) -> str:
        (tmp_path / name).write_text("2")
        run_key.code_digest.cache_clear()
        return run_key.code_digest()

    run_key.code_digest.cache_clear()
    digests = [run_key.code_digest(), *(after(name) for name in ("part/view.sql", "part/kernel.so", "part/deep.py"))]
    assert len(set(digests)) == 4
    assert after("part/.hidden") == digests[-1]
    run_key.code_digest.cache_clear()
