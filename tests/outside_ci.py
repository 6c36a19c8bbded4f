"""Tests that take long on their own account: outside CI, whose twenty minutes are for all of them together."""

from __future__ import annotations

import os

import pytest

outside_ci = pytest.mark.skipif(bool(os.environ.get("CI")), reason="long: runs outside CI")
