"""Names of tables and files stand in enumerations: each is used, has its meaning, and those worked out exist."""

from __future__ import annotations

import inspect
import os
import re
from pathlib import Path

import fieldcal
from fieldcal.config.parameters import Parameters
from fieldcal.names import PREFERRED_METHODS, SENSORS, VECTOR_SENSORS, Method
from fieldcal.reason_codes import ReasonCode
from fieldcal.stages.pipeline import PIPELINE
from fieldcal.stages.vector_triads import ELLIPSOID_METHOD
from fieldcal.warehouse.views import view_text


def test_every_reason_code_has_its_meaning_and_its_name() -> None:
    told = re.findall(r'^    (\w+) = "(\w+)"\n    """[A-Z].*\."""$', inspect.getsource(ReasonCode), flags=re.MULTILINE)
    assert [code for _, code in told] == list(ReasonCode)
    assert all(name == code.upper() for name, code in told)


def test_every_reason_code_is_used() -> None:
    folder = Path(str(fieldcal.__file__)).parent
    files = (Path(at, name) for at, _, names in os.walk(folder, followlinks=True) for name in names)
    source = "".join(path.read_text(encoding="utf-8") for path in files if path.suffix == ".py")
    used = {ReasonCode[name] for name in re.findall(r"ReasonCode\.([A-Z_0-9]+)", source)}
    worked_out = {ReasonCode(f"no_{need}") for stage in PIPELINE for need in stage.needs}
    worked_out |= {ReasonCode(f"no_{sensor}") for sensor in SENSORS}
    worked_out |= {ReasonCode(f"{sensor}_refused") for sensor in VECTOR_SENSORS}
    assert set(ReasonCode) - used - worked_out == set()


def test_the_view_prefers_methods_in_the_order_of_the_list() -> None:
    numbers = dict(re.findall(r"WHEN '(\w+)' THEN (\d+)", view_text("latest_calibration").split("AS l")[0]))
    assert sorted(numbers, key=lambda method: -int(numbers[method])) == list(PREFERRED_METHODS)
    assert int(numbers[PREFERRED_METHODS[-1]]) > 0


def test_every_choice_of_ellipsoid_fit_is_a_method() -> None:
    choices = Parameters.model_json_schema()["properties"]["ellipsoid"]["enum"]
    assert set(ELLIPSOID_METHOD) == set(choices)
    assert set(ELLIPSOID_METHOD.values()) <= set(Method)
