"""What a step leaves behind beside its tables: plain JSON, from which the history's row of the step is made."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NotRequired, TypedDict

from fieldcal.logs.facts import Facts
from fieldcal.names import Json


class Output(TypedDict):
    """A table that a step wrote, as `StageOutput` has it; a signal table lies elsewhere."""

    sha256: str
    rows: int
    file: NotRequired[str]
    bytes: NotRequired[int]
    columns: NotRequired[Mapping[str, Sequence[Json]]]
    handed_on: NotRequired[bool]


class Causes(TypedDict):
    """What the key of a step is made of."""

    run_key: str
    params: Mapping[str, Json]
    inputs: dict[str, str]
    source: str
    versions: dict[str, str]


class StepRecord(TypedDict):
    """How a step ended: a `Status`, code and sentence where it is not "ok", and the numbers that decided it."""

    status: str
    reason_code: str | None
    reason: str | None
    measured: Mapping[str, Json]
    versions: dict[str, str]
    run_key: str | None


class Refusal(TypedDict):
    """A step that refused or failed, with its code and sentence."""

    stage: str
    status: str
    reason_code: str | None
    reason: str | None


class Record(StepRecord, total=False):
    """The same of a step of a night, with what its key is made of and the sha256 of all it wrote.

    `facts` and `signals` are of the step that reads the log. `unkept`: the next night tries again.
    """

    params: Mapping[str, Json]
    inputs: dict[str, str]
    source: str
    outputs: dict[str, Output]
    facts: Facts
    signals: dict[str, Output]
    unkept: bool
