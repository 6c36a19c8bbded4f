"""What a flight's refusals are told as: each cause once, what only follows from one in a line; held-out comparisons and
advice beside."""

from __future__ import annotations

import io
from typing import Any

import pytest
from rich.console import Console

from fieldcal.cli.present.flight import fit_table, print_refusals, residual_table
from fieldcal.stages.pipeline import PIPELINE
from fieldcal.stages.stage import run_stage
from fieldcal.words.flights import advised, is_consequence


def run(stage: str, code: str, status: str = "refused") -> dict[str, Any]:
    return {"stage": stage, "status": status, "reason_code": code, "measured": {"reason": f"{stage} says {code}."}}


@pytest.mark.parametrize("stage", [s for s in PIPELINE if s.needs], ids=lambda s: s.name)
def test_a_stage_without_its_input_is_a_consequence(stage: Any) -> None:
    """As the pipeline itself refuses it; a log without an IMU is no other stage's doing."""
    result = run_stage(stage, {}, {})
    own = stage.reads[stage.needs[0]].startswith("ingest.")
    assert is_consequence(run(stage.name, str(result.reason_code))) is not own


@pytest.mark.parametrize(
    ("stage", "code", "status"),
    [
        ("gyro_equation", "no_gyroscope", "refused"),
        ("attitude", "no_magnetometer", "refused"),
        ("gyro_output", "no_gyroscope", "failed"),
        ("magnetometer", "scale_uncertain", "refused"),
        ("ingest", "no_imu", "refused"),
    ],
)
def test_what_a_stage_found_itself_is_a_cause(stage: str, code: str, status: str) -> None:
    assert not is_consequence(run(stage, code, status))


def test_causes_are_told_and_consequences_listed() -> None:
    text = io.StringIO()
    runs = [
        run("gyro_equation_pass2", "no_gyroscope"),
        run("gyro_output", "no_gyroscope"),
        run("joint", "no_samples"),
    ]
    print_refusals(Console(file=text, width=200), runs)
    lines = text.getvalue().splitlines()
    assert lines[0].startswith("refused gyro_equation_pass2 (no_gyroscope)")
    assert lines[-1] == "not run for want of their input: gyro_output, joint"
    assert "gyro_output says" not in text.getvalue()


def fit_row(sample: str, tic: float) -> dict[str, Any]:
    place = {"quantity": "body_rate", "method": "joint", "reference": "vps", "signal": "raw", "sample": sample}
    return place | {"tic": tic, "rms": 0.2, "rms_unit": "rad/s"}


def test_held_out_comparisons_stand_beside_all() -> None:
    text = io.StringIO()
    Console(file=text, width=80).print(fit_table([fit_row("all", 0.0781), fit_row("held_out", 0.0913)]))
    assert "0.0781" in text.getvalue()
    assert "0.0913" in text.getvalue()
    assert "body rate, held out" in text.getvalue()


def test_advice_is_given_where_a_stage_went_well_but_weakly() -> None:
    weak = {"stage": "joint", "status": "ok", "measured": {"advice": "Add 60° of roll."}}
    strong = {"stage": "joint", "status": "ok", "measured": {"advice": ""}}
    refused = {"stage": "joint", "status": "refused", "measured": {"advice": "Add 60° of yaw."}}
    assert advised([weak, strong, refused, {"stage": "verify", "status": "ok", "measured": {}}]) == ["Add 60° of roll."]


def test_residual_rows_without_scale_or_zero_make_no_table() -> None:
    """A flight at rest that tells the warm-up alone."""
    row = {"flight_id": "f", "unit_id": "u", "sensor": "accelerometer", "method": "attitude", "axis": "x"}
    found = row | {"status": "ok", "reason_code": None, "value": 1.0, "sd": 0.1, "unit": "1"}
    rows: list[Any] = [found | {"parameter": parameter} for parameter in ("residual_zero_per_degc", "zero_per_degc")]
    assert residual_table(rows) is None
    scale: Any = found | {"parameter": "residual_scale"}
    listed = residual_table([scale])
    assert listed is not None
    assert len(listed.rows) == 1
