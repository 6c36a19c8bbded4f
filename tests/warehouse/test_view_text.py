"""The views' texts carry the numbers that the code uses, and no placeholder is left in them."""

from __future__ import annotations

import re

import pytest

from fieldcal.warehouse import views as view_text
from fieldcal.warehouse.views import VIEWS


@pytest.mark.parametrize("view", VIEWS)
def test_no_placeholder_is_left(view: str) -> None:
    assert not re.findall(r"[{}]", view_text.view_text(view))


def test_numbers_come_from_the_code(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(view_text.VALUES, "reference_degc", "31")
    monkeypatch.setitem(view_text.VALUES, "unconfirmed_sd", "7")
    text = view_text.view_text("latest_calibration")
    assert "(l.at_degc - 31)" in text
    assert "off > 7" in text


def test_an_unknown_placeholder_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(view_text.VALUES, "reference_degc")
    with pytest.raises(KeyError, match="reference_degc"):
        view_text.view_text("calibration_at")
