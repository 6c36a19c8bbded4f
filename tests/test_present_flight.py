"""What a flight's page on the terminal must not hide: held-out comparisons beside all, and advice on weak constants."""

from __future__ import annotations

from typing import Any

from rich.console import Console

from flows.present_flight import advised, fit_table


def fit_row(sample: str, tic: float) -> dict[str, Any]:
    place = {"quantity": "body_rate", "method": "joint", "reference": "vps", "signal": "raw", "sample": sample}
    return place | {"tic": tic, "rms": 0.2, "rms_unit": "rad/s"}


def test_held_out_comparisons_stand_beside_all() -> None:
    console = Console(width=160, record=True, file=None, quiet=False)
    with console.capture() as captured:
        console.print(fit_table([fit_row("all", 0.0781), fit_row("held_out", 0.0913)]))
    text = captured.get()
    assert "0.0781" in text
    assert "0.0913" in text
    assert "body rate, held out" in text


def test_advice_is_given_where_a_stage_went_well_but_weakly() -> None:
    weak = {"stage": "joint", "status": "ok", "measured": {"advice": "Add 60° of roll."}}
    strong = {"stage": "joint", "status": "ok", "measured": {"advice": ""}}
    refused = {"stage": "joint", "status": "refused", "measured": {"advice": "Add 60° of yaw."}}
    assert advised([weak, strong, refused, {"stage": "verify", "status": "ok", "measured": {}}]) == ["Add 60° of roll."]
