"""The table of changes that no test can see speaks of code that is there, and each module of it has tests."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"


def test_equivalent_changes_are_changes_of_todays_code_and_every_module_has_tests(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(sys, "path", [str(BENCHMARKS), *sys.path])
    import mutation
    from mutation_table import EQUIVALENT

    modules = mutation.modules_of([])
    assert [module for module in modules if not mutation.tests_of(module)] == []
    of_today = {mutation.key_of(change) for module in modules for change in mutation.changes_of(module)}
    assert {key for key in EQUIVALENT if key not in of_today} == set()
