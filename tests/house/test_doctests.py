"""Every example in a docstring of the package runs, and every public name has one."""

from __future__ import annotations

import doctest
import importlib
import pkgutil

import matplotlib
import pytest

import fieldcal

NOT_MODULES = ("fieldcal.__main__", "fieldcal.compiled._kernel")
"""The command, and a library that is no extension of Python's."""
MODULES = sorted({m.name for m in pkgutil.walk_packages(fieldcal.__path__, "fieldcal.")} - {*NOT_MODULES})
OPTIONS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE


@pytest.mark.parametrize("name", MODULES)
def test_examples_of_a_module(name: str) -> None:
    matplotlib.use("agg")
    assert doctest.testmod(importlib.import_module(name), optionflags=OPTIONS).failed == 0


@pytest.mark.parametrize("name", fieldcal.__all__)
def test_a_public_name_has_an_example_that_its_module_runs(name: str) -> None:
    own = getattr(fieldcal, name)
    module = importlib.import_module(own.__module__)
    found = [test for test in doctest.DocTestFinder().find(module) if test.name == f"{module.__name__}.{own.__name__}"]
    assert [len(test.examples) > 0 for test in found] == [True]
    assert own.__module__ in MODULES
