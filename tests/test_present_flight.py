"""What a flight's refusals are told as: each cause once, what only follows from one in a line."""

from __future__ import annotations

import io
from typing import Any

import pytest
from rich.console import Console

from fieldcal.pipeline import PIPELINE, run_stage
from flows.present_flight import is_consequence, print_refusals


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
