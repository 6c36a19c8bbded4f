"""Tests that ask for `either_kernel` run by NumPy and, where one was compiled, by the kernel in C."""

from __future__ import annotations

import pytest

from fieldcal import compiled


@pytest.fixture(params=["numpy", *([] if compiled.LIBRARY is None else ["c"])])
def either_kernel(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    if request.param == "numpy":
        monkeypatch.setattr(compiled, "LIBRARY", None)
