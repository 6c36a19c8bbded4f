"""What a stage declares it reads, it reads: an input that is never looked at makes it run again for nothing."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from dataclasses import fields, replace
from typing import Any

import numpy as np
import polars as pl
import pytest

from fieldcal.config.configuration import parse
from fieldcal.config.flight_settings import FlightSettings, flight_settings
from fieldcal.config.parameters import PROFILES
from fieldcal.config.stage_settings import StageSettings
from fieldcal.simulation.archive import settings, signals
from fieldcal.simulation.experiment import SENSORS, SimulatedFlight, simulate
from fieldcal.stages.pipeline import PIPELINE
from fieldcal.stages.results import StageResult
from fieldcal.stages.stage import Stage, run_stage

FIELD_UT = 45.0
BEFOREHAND = {"faults", "attitude_faults"}
"""Tables that `stage.refused_beforehand` reads for a stage."""


def watched_settings(content: StageSettings, asked: set[str]) -> StageSettings:
    """The same settings, which note in `asked` what is read of them; a copy with changes reads nothing."""
    names = {field.name for field in fields(content)}

    class Watching(type(content)):  # type: ignore[misc]
        def __getattribute__(self, name: str) -> Any:
            if name in names and sys._getframe(1).f_globals["__name__"] != "dataclasses":
                asked.add(name)
            return super().__getattribute__(name)

    watching: StageSettings = object.__new__(Watching)
    vars(watching).update(vars(content))
    return watching


class Watched(Mapping[str, Any]):
    """A mapping that notes what is asked of it, also whether something is there."""

    def __init__(self, content: Mapping[str, Any]) -> None:
        self.content = content
        self.asked: set[str] = set()

    def __getitem__(self, name: str) -> Any:
        self.asked.add(name)
        return self.content[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.content)

    def __len__(self) -> int:
        return len(self.content)


def fly(tables: Mapping[str, pl.DataFrame], chosen: FlightSettings) -> dict[str, set[str]]:
    """Run all stages; what each asked for, tables as `table x` and settings as `setting y`."""
    known = {f"ingest.{name}": frame for name, frame in tables.items()}
    asked: dict[str, set[str]] = {}
    for stage in PIPELINE:

        def watched(inputs: Any, values: Any, stage: Stage = stage) -> StageResult:
            read, settings_read = Watched(inputs), set[str]()
            result = stage.function(read, watched_settings(values, settings_read))
            tables_read = {f"table {name}" for name in read.asked}
            asked[stage.name] = tables_read | {f"setting {name}" for name in settings_read}
            return result

        result = run_stage(replace(stage, function=watched), known, chosen)
        assert result.status != "failed"
        known |= {f"{stage.name}.{name}": frame for name, frame in result.tables.items()}
    return asked


def in_si(recording: SimulatedFlight, field: str = "") -> tuple[dict[str, pl.DataFrame], FlightSettings]:
    """The same flight logged in physical units, and its settings; the field is of unknown strength unless given."""
    e = recording.experiment
    counts = {n: recording.counts[n] * np.array(e.scale[n]) + np.array(e.bias[n]) for n in SENSORS}
    counts["magnetometer"] *= FIELD_UT
    units = {"gyroscope": "rad/s", "accelerometer": "m/s^2", "magnetometer": "uT"}
    vehicle = parse(f"[vehicles.a]\n{field}", None).vehicle("a")
    return signals(replace(recording, counts=counts)), flight_settings(vehicle, units=units)


def with_power(tables: dict[str, pl.DataFrame]) -> dict[str, pl.DataFrame]:
    stamps = tables["imu"]["t_ns"]
    drive = np.linspace(0.0, 10.0, len(stamps))
    return {**tables, "power": pl.DataFrame({"t_ns": stamps, "current_a": drive, "throttle": drive / 10.0})}


@pytest.fixture(scope="module")
def asked() -> dict[str, set[str]]:
    """What each stage asked for in any of several flights."""
    recording = simulate(seed=21, temperature_degc=(20.0, 30.0))
    tables, chosen = signals(recording), settings(recording.experiment)
    si_tables, si = in_si(recording, f'field = {{ north_east_down = [{FIELD_UT}, 0.0, 0.0], unit = "uT" }}')
    _, strength_unknown = in_si(recording)
    level = simulate(seed=21, turned=(0.0, 0.0, 1.0), tremor_rad=0.0, vps=False)
    short = simulate(seed=21, duration_s=8.0)
    warm = simulate(seed=21, duration_s=400.0, tremor_rad=0.0, temperature_degc=(15.0, 45.0), vps=False)
    no_magnetometer = {name: frame for name, frame in tables.items() if name != "magnetometer"}
    doubted = {"ellipsoid_max_scale_sd": 1e-4, "gyro_max_scale_sd": 1e-4}
    flights = [
        (with_power(tables), chosen),
        (tables, chosen.changed(method="joint", use_vps=True)),
        (tables, chosen.changed(method="joint", use_vps=False)),
        (si_tables, si.changed(method="joint", use_vps=False)),
        (tables, chosen.changed(method="auto")),
        (tables, chosen.changed(**PROFILES["paper"])),
        (tables, chosen.changed(**PROFILES["onboard"])),
        (tables, chosen.changed(lever_arm_m=(0.05, 0.02, -0.03))),
        (si_tables, si),
        (si_tables, si.changed(**doubted)),
        (si_tables, strength_unknown.changed(**doubted)),
        (with_power(signals(level)), settings(level.experiment)),
        (no_magnetometer, chosen),
        (signals(short), settings(short.experiment)),
        (signals(warm), settings(warm.experiment)),
    ]
    found: dict[str, set[str]] = {stage.name: set() for stage in PIPELINE}
    for one in flights:
        for stage, names in fly(*one).items():
            found[stage] |= names
    return found


@pytest.mark.parametrize("stage", PIPELINE, ids=lambda stage: stage.name)
def test_every_declared_input_and_setting_is_read(asked: dict[str, set[str]], stage: Stage) -> None:
    beforehand = {f"table {name}" for name in BEFOREHAND & set(stage.reads) if stage.trusts or name != "faults"}
    declared = {f"table {name}" for name in stage.reads} | {f"setting {name}" for name in stage.settings}
    assert declared - asked[stage.name] - beforehand == set()
