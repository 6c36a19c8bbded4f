"""`import fieldcal`: light, typed, complete."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

import fieldcal
from fieldcal.provenance.reached_code import reach
from fieldcal.provenance.source_tree import installed
from fieldcal.stages.pipeline import PIPELINE, Stage

REPOSITORY = Path(__file__).parents[2]
SCRIPT = """
from pathlib import Path

import numpy as np
from matplotlib import pyplot

import fieldcal


def scales(log: Path) -> dict[str, np.ndarray]:
    recording = fieldcal.read_log(log, vehicle="quad-1")
    calibration = fieldcal.calibrate(recording, method="joint", parameters={"smoothing_cutoff_hz": 6.0})
    found: dict[str, np.ndarray] = {}
    for sensor in (calibration.magnetometer, calibration.accelerometer, calibration.gyroscope):
        try:
            found[sensor.sensor] = sensor.scale.value
        except fieldcal.Refused as error:
            print(error.reason_code, error.sentence)
    if calibration.sync is not None:
        print(calibration.sync.lag_s * 1e3)
    calibration.plot()[0].set_title("flight")
    pyplot.savefig("flight.png")
    return found


def flown(root: Path) -> str:
    constants: fieldcal.Constants = fieldcal.Warehouse(root).calibration_at("quad-1", 12.5)
    return fieldcal.export(constants, "px4").text


flight = fieldcal.simulate(seed=1)
fit: fieldcal.EllipsoidFit = fieldcal.fit_ellipsoid(flight.counts["magnetometer"], 1.0)
print(fit.scale_sd, fieldcal.synchronise(flight.t, flight.counts["gyroscope"], flight.vps_t, flight.vps_q).lag_s)
"""


def mypy(tmp_path: Path, script: str) -> str:
    place = tmp_path / "script.py"
    place.write_text(script)
    cache = REPOSITORY / ".mypy_cache"
    # What is installed is silent; of a checkout mypy would judge the package too, by the user's flags.
    silent = ["--follow-imports", "silent"]
    command = [sys.executable, "-m", "mypy", "--strict", *silent, "--cache-dir", str(cache), str(place)]
    return subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True).stdout


def test_a_users_script_is_typed(tmp_path: Path) -> None:
    assert mypy(tmp_path, SCRIPT).startswith("Success")


def test_a_misspelt_name_is_an_error_of_types(tmp_path: Path) -> None:
    told = mypy(tmp_path, "import fieldcal\n\nfieldcal.calibrat('a.mcap')\nfieldcal.calibrate('a.mcap').gyroscop\n")
    assert '"calibrat"' in told
    assert '"gyroscop"' in told


def test_every_name_is_there() -> None:
    assert sorted(fieldcal.__all__) == list(fieldcal.__all__)
    for name in fieldcal.__all__:
        assert getattr(fieldcal, name).__doc__
    assert set(fieldcal.__all__) <= set(dir(fieldcal))
    with pytest.raises(AttributeError, match="calibrat"):
        fieldcal.calibrat  # type: ignore[attr-defined]  # noqa: B018


def test_nothing_heavy_is_loaded_before_it_is_asked_for() -> None:
    program = (
        "import sys, fieldcal; heavy = ('polars', 'scipy', 'prefect', 'matplotlib', 'duckdb', 'numpy'); "
        "print([m for m in heavy if m in sys.modules]); fieldcal.Warehouse; fieldcal.calibrate; "
        "print([m for m in ('prefect', 'matplotlib', 'duckdb') if m in sys.modules])"
    )
    told = subprocess.run([sys.executable, "-c", program], cwd=REPOSITORY, capture_output=True, text=True)
    assert told.stdout.split("\n")[:2] == ["[]", "[]"]


@pytest.mark.parametrize("stage", PIPELINE, ids=lambda stage: stage.name)
def test_public_names_have_no_part_in_what_a_stage_is_known_by(stage: Stage) -> None:
    """Every module imports `fieldcal`: were its names followed, any change would run every stage again."""
    reached = reach(installed("fieldcal"), [f"{stage.function.__module__}.{stage.function.__name__}"])
    assert "fieldcal" in reached.modules
    assert not {name for name in reached.modules if name.startswith(("fieldcal.api", "fieldcal.cli", "fieldcal.plots"))}


def test_a_function_called_as_its_module_is_found() -> None:
    """`from fieldcal.exports.ros import ros` in the package: the path may mean either, and leads to both."""
    reached = reach(installed("fieldcal"), ["fieldcal.exports.PROGRAMS"])
    assert {("fieldcal.exports.ros", "ros"), ("fieldcal.exports.kalibr", "kalibr")} <= reached.definitions
