"""Which kernel runs: the switch, a library that is missing, broken or of another source, and its name in keys."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from fieldcal import compiled


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of the kernel's folder, which `load` looks at."""
    copy = Path(shutil.copytree(compiled.FOLDER, tmp_path / "compiled"))
    monkeypatch.setattr(compiled, "FOLDER", copy)
    monkeypatch.delenv(compiled.SWITCH, raising=False)
    return copy


def test_the_switch_leaves_it_out(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(compiled.SWITCH, "numpy")
    assert compiled.load() == (None, "NumPy, as FIELDCAL_KERNEL asks")


def test_what_is_missing_or_broken_is_told(folder: Path) -> None:
    for library in folder.glob("_kernel*"):
        library.unlink()
    assert compiled.load() == (None, "NumPy: none was compiled when fieldcal was installed")
    (folder / "_kernel.abi3.so").write_bytes(b"no library")
    assert compiled.load()[0] is None
    assert "does not load" in compiled.load()[1]


@pytest.mark.skipif(compiled.LIBRARY is None, reason="No kernel was compiled, or FIELDCAL_KERNEL=numpy.")
def test_one_of_another_source_is_not_used(folder: Path) -> None:
    library, described = compiled.load()
    assert library is not None
    assert described == f"C, {compiled.source_digest()}"
    with (folder / "rows.c").open("a") as source:
        source.write("/* edited */")
    assert compiled.load()[0] is None
    assert "another source" in compiled.load()[1]


def test_keys_name_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compiled, "LIBRARY", object())
    assert compiled.kernel_name() == f"c-{compiled.source_digest()}"
    monkeypatch.setattr(compiled, "LIBRARY", None)
    assert compiled.kernel_name() == "numpy"


def test_arrays_that_c_would_misread_are_refused() -> None:
    for check in (compiled.real, compiled.whole, compiled.flags):
        with pytest.raises(ValueError, match=r"\(2, 3\) instead of \(3, 3\)"):
            check([[0, 1, 2], [3, 4, 5]], 3, 3)
    with pytest.raises(ValueError, match="contiguous"):
        compiled.pointer(compiled.real([[0, 1], [2, 3], [4, 5]], 3, 2).T)
