"""Why a step runs: what its key is made of now, against the record of its last result."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping

from fieldcal.flight.record import Causes, Record
from fieldcal.provenance.run_key import VERSIONED

NO_RESULT = "no result yet"
LONGEST_VALUE = 40


def why_it_runs(former: Record, now: Causes) -> str:
    """A sentence without its full stop: "smoothing_cutoff_hz 8.0 → 6.0", "new input: attitude.attitude", …

    Parameters
    ----------
    former : mapping
        Record of the step's last result.
    now : mapping
        `run_key`, `params`, `inputs`, `source` and `versions` as they are now.
    """
    if former["run_key"] == now["run_key"]:
        return "its result is incomplete or was changed on disk"
    return "; ".join(_differences(former, now)) or "its last result was made otherwise"


def _differences(former: Record, now: Causes) -> Iterator[str]:
    yield from _changed(former.get("params", {}), now["params"])
    if inputs := [name for name, sha256 in now["inputs"].items() if former.get("inputs", {}).get(name) != sha256]:
        yield f"new input: {', '.join(inputs)}"
    if lost := [name for name in former.get("inputs", {}) if name not in now["inputs"]]:
        yield f"input no longer there: {', '.join(lost)}"
    if former.get("source") != now["source"]:
        yield "its code changed"
    before, after = former.get("versions", {}), now["versions"]
    yield from _changed({name: before.get(name) for name in VERSIONED}, {name: after.get(name) for name in VERSIONED})


def _changed(before: Mapping[str, object], after: Mapping[str, object]) -> Iterator[str]:
    for name in sorted({*before, *after}):
        if before.get(name) != after.get(name):
            yield f"{name} {_shown(before.get(name))} → {_shown(after.get(name))}"


def _shown(value: object) -> str:
    text = value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)
    return text if len(text) <= LONGEST_VALUE else f"{text[:LONGEST_VALUE]}…"
