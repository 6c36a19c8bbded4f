"""Every example in a docstring of the package runs."""

from __future__ import annotations

import doctest
import importlib
import pkgutil

import pytest

import fieldcal

MODULES = sorted(m.name for m in pkgutil.walk_packages(fieldcal.__path__, "fieldcal.") if "__main__" not in m.name)
NUMERICS_WITH_EXAMPLES = {"fieldcal.estimation.ellipsoid"}


@pytest.mark.parametrize("name", MODULES)
def test_examples_of_a_module(name: str) -> None:
    outcome = doctest.testmod(importlib.import_module(name))
    assert outcome.failed == 0
    assert outcome.attempted > 0 or name not in NUMERICS_WITH_EXAMPLES
