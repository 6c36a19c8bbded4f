"""From random truth through an autopilot and back: raw readings → its formula with random parameters → what a
calibration finds of the logged ones → composition → export → its formula with the exported file on the raw readings.

Nothing is flown: the constants of the logged readings are known in closed form and get an error of their sd.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import autopilot_formulas as formulas
import numpy as np
import polars as pl
import pytest

from fieldcal.config.loaded import Loaded
from fieldcal.config.stage_settings import CompositionSettings
from fieldcal.errors import FieldcalError
from fieldcal.exports import AUTOPILOTS
from fieldcal.exports.autopilots.loading import Request
from fieldcal.exports.calibration import NOT_TURNED, Constants, Origin, Triad
from fieldcal.logs.dataflash.applied import Temperatures, inertial_corrections, magnetometer_corrections
from fieldcal.logs.dataflash.parameters import Parameters
from fieldcal.logs.interface import SensorSource
from fieldcal.logs.on_board import units_on_board
from fieldcal.logs.ulog.parameters import History, corrections, parameters_of
from fieldcal.names import SENSORS, Method, Sensor
from fieldcal.stages.composition import compose
from fieldcal.stages.results import triad_rows
from fieldcal.stages.tables import calibration_rows, constants

RNG_SEEDS = range(40)
UNIT = {Sensor.GYROSCOPE: "rad/s", Sensor.ACCELEROMETER: "m/s^2", Sensor.MAGNETOMETER: "G"}
SIZE = {Sensor.GYROSCOPE: 2.0, Sensor.ACCELEROMETER: 9.8, Sensor.MAGNETOMETER: 0.5}
OFFSET = {Sensor.GYROSCOPE: 0.05, Sensor.ACCELEROMETER: 0.4, Sensor.MAGNETOMETER: 0.15}
SCALE_SD = 1e-3
ZERO_SD = {Sensor.GYROSCOPE: 1e-3, Sensor.ACCELEROMETER: 1e-2, Sensor.MAGNETOMETER: 1e-3}
EXACT = 1e-6
"""Share of a reading that rounding to float32 may change, twice."""


@dataclass(frozen=True)
class Case:
    """A truth, and what its autopilot flies with. z = scale (raw − zero) at `degc`."""

    autopilot: str
    degc: float
    scale: dict[Sensor, np.ndarray]
    zero: dict[Sensor, np.ndarray]
    slots: dict[Sensor, int]
    ids: dict[Sensor, int]
    parameters: dict[str, float]

    def logged(self, sensor: Sensor, raw: np.ndarray, parameters: dict[str, float] | None = None) -> np.ndarray:
        held, warm = self.parameters if parameters is None else parameters, np.full(len(raw), self.degc)
        if self.autopilot == "px4":
            return formulas.px4(sensor, self.ids[sensor], raw, held, warm)
        return formulas.ardupilot(sensor, self.slots[sensor], raw, held, warm)

    @property
    def board(self) -> np.ndarray:
        if self.autopilot == "px4":
            return formulas.px4_board(self.parameters)
        return formulas.dcm(*formulas.YAW_ROLL_PITCH_DEG[int(self.parameters["AHRS_ORIENTATION"])])

    def calibrates_in_body(self, sensor: Sensor) -> bool:
        return self.autopilot == "ardupilot" and sensor == Sensor.MAGNETOMETER

    def true(self, sensor: Sensor, raw: np.ndarray) -> np.ndarray:
        """In body axes."""
        if self.calibrates_in_body(sensor):
            return (raw @ self.board.T - self.zero[sensor]) @ self.scale[sensor].T
        return (raw - self.zero[sensor]) @ self.scale[sensor].T @ self.board.T


def drawn(autopilot: str, seed: int, *, gyroscope_scale: bool = True) -> Case:
    rng = np.random.default_rng(seed)
    scale = {s: np.diag(rng.uniform(0.96, 1.04, 3)) for s in SENSORS}
    if not gyroscope_scale:
        scale[Sensor.GYROSCOPE] = np.eye(3)
    soft = rng.uniform(-0.02, 0.02, 3)
    scale[Sensor.MAGNETOMETER] = formulas.symmetric(np.diagonal(scale[Sensor.MAGNETOMETER]), soft)
    zero = {s: rng.uniform(-OFFSET[s], OFFSET[s], 3) for s in SENSORS}
    slots = {s: int(rng.integers(3)) for s in SENSORS}
    slots[Sensor.ACCELEROMETER] = slots[Sensor.GYROSCOPE]
    ids = {s: int(rng.integers(1, 1 << 24)) for s in SENSORS}
    degc = float(rng.uniform(15.0, 45.0))
    make = px4_parameters if autopilot == "px4" else ardupilot_parameters
    held = {name: float(np.float32(value)) for name, value in make(rng, slots, ids).items()}
    return Case(autopilot, degc, scale, zero, slots, ids, held)


def px4_parameters(rng: np.random.Generator, slots: dict[Sensor, int], ids: dict[Sensor, int]) -> dict[str, float]:
    p: dict[str, float] = {"SENS_BOARD_ROT": float(rng.choice([0, 2, 4, 6, 8, 24]))}
    p |= {f"SENS_BOARD_{axis}_OFF": rng.uniform(-5.0, 5.0) for axis in "XYZ"}
    for sensor, (short, letter) in formulas.PX4_SHORT.items():
        s = Sensor(sensor)
        own = f"CAL_{short}{slots[s]}_"
        p |= {f"CAL_{short}{n}_ID": float(ids[s] if n == slots[s] else 100 + n) for n in range(3)}
        for axis in "XYZ":
            p[f"{own}{axis}OFF"] = rng.uniform(-OFFSET[s], OFFSET[s])
            if s != Sensor.GYROSCOPE:
                p[f"{own}{axis}SCALE"] = rng.uniform(0.96, 1.04)
            if s == Sensor.MAGNETOMETER:
                p[f"{own}{axis}ODIAG"] = rng.uniform(-0.02, 0.02)
        p[f"TC_{letter}_ENABLE"] = float(rng.integers(2))
        block = f"TC_{letter}{(slots[s] + 1) % 3}_"
        p |= {f"{block}ID": float(ids[s]), f"{block}TREF": 30.0, f"{block}TMIN": 10.0, f"{block}TMAX": 50.0}
        for order, size in enumerate((0.3, 1e-2, 2e-4, 2e-6)):
            p |= {f"{block}X{order}_{i}": size * OFFSET[s] * rng.uniform(-1.0, 1.0) for i in range(3)}
    return p


def ardupilot_parameters(
    rng: np.random.Generator, slots: dict[Sensor, int], ids: dict[Sensor, int]
) -> dict[str, float]:
    p: dict[str, float] = {"AHRS_ORIENTATION": float(rng.choice([0, 2, 4, 6, 8, 24]))}
    slot = slots[Sensor.GYROSCOPE]
    block = f"INS_TCAL{slot + 1}_"
    p |= {f"{block}ENABLE": float(rng.integers(2)), f"{block}TMIN": 10.0, f"{block}TMAX": 50.0}
    for kind, s in (("GYR", Sensor.GYROSCOPE), ("ACC", Sensor.ACCELEROMETER)):
        own = formulas.ardupilot_instance(f"INS_{kind}", slot)
        p |= {f"{own}_ID": float(ids[s]), f"INS_{kind}{slot + 1}_CALTEMP": rng.uniform(20.0, 40.0)}
        for axis in "XYZ":
            p[f"{own}OFFS_{axis}"] = rng.uniform(-OFFSET[s], OFFSET[s])
            if kind == "ACC":
                p[f"{own}SCAL_{axis}"] = rng.uniform(0.96, 1.04)
            for order, size in ((1, 1e4), (2, 2e2), (3, 2.0)):
                p[f"{block}{kind}{order}_{axis}"] = size * OFFSET[s] * rng.uniform(-1.0, 1.0)
    n = str(slots[Sensor.MAGNETOMETER] + 1) if slots[Sensor.MAGNETOMETER] else ""
    p |= {f"COMPASS_DEV_ID{n}": float(ids[Sensor.MAGNETOMETER]), f"COMPASS_SCALE{n}": rng.uniform(0.9, 1.1)}
    for axis in "XYZ":
        p[f"COMPASS_OFS{n}_{axis}"] = rng.uniform(-150.0, 150.0)
        p[f"COMPASS_DIA{n}_{axis}"] = rng.uniform(0.95, 1.05)
        p[f"COMPASS_ODI{n}_{axis}"] = rng.uniform(-0.03, 0.03)
    return p


def of_logged(case: Case, sensor: Sensor) -> tuple[np.ndarray, np.ndarray]:
    """A and b of z = A (logged − b), body axes: exact, by where the autopilot takes four readings."""
    raw = np.vstack([np.zeros(3), np.eye(3)])
    logged, z = case.logged(sensor, raw), case.true(sensor, raw)
    a = np.linalg.solve((logged[1:] - logged[0]), (z[1:] - z[0])).T
    return a, logged[0] - np.linalg.solve(a, z[0])


def source(case: Case, sensor: Sensor) -> SensorSource:
    """As a reader hands it over."""
    device = case.ids[sensor]
    if case.autopilot == "px4":
        done = corrections(sensor, device, History(case.parameters), case.degc)
        told = parameters_of(sensor, device, case.parameters)
    else:
        held, told, slot = Parameters.of(case.parameters), case.parameters, case.slots[sensor]
        warm = Temperatures(np.zeros(1, np.int64), np.array([case.degc]))
        if sensor == Sensor.MAGNETOMETER:
            done = magnetometer_corrections(slot, held, np.zeros(1, np.int64), None)
        else:
            done = inertial_corrections("GYR" if sensor == Sensor.GYROSCOPE else "ACC", slot, held, 0, warm)
    table = "magnetometer" if sensor == Sensor.MAGNETOMETER else "imu"
    autopilot = "px4" if case.autopilot == "px4" else "ardupilot"
    return SensorSource(sensor, table, str(device), "", 100.0, True, False, device, done, autopilot, told)


def composed(case: Case, found: dict[Sensor, tuple[np.ndarray, np.ndarray]]) -> Constants:
    """The raw sensors' constants in the history, from those of the logged readings: A and b."""
    (unit,) = units_on_board([source(case, s) for s in SENSORS], [], 0, 10**9)
    done, loaded = unit["applied"], unit["loaded"]
    settings = CompositionSettings(
        applied_matrix={s: tuple(map(tuple, done[s]["matrix"])) for s in SENSORS},  # type: ignore[misc]
        applied_offset={s: tuple(done[s]["offset"]) for s in SENSORS},  # type: ignore[misc]
        applied_known=dict.fromkeys(SENSORS, True),
        applied_matrix_sd=dict.fromkeys(SENSORS, 0.0),
        applied_offset_sd=dict.fromkeys(SENSORS, (0.0, 0.0, 0.0)),
        applied_offset_per_degc=dict.fromkeys(SENSORS),
        gravity_sign="specific_force",
        field_ned=(0.2, 0.0, 0.45),
        field_unit="G",
        field_source="configured",
        body="frd",
        rotation_body_from_sensor=NOT_TURNED,
        loaded=dict.fromkeys(SENSORS),
        own_sensors=SENSORS,
    )
    rows = [
        row
        for s, (a, b) in found.items()
        for row in triad_rows(
            s,
            Method.JOINT,
            a,
            -a @ b,
            np.diag(np.r_[np.full(3, SCALE_SD**2), np.full(3, ZERO_SD[s] ** 2)]),
            unit=UNIT[s],
            logged_unit=UNIT[s],
            reference_reading=np.zeros(3),
            temperature_degc=case.degc,
            cross_sd=np.full((3, 3), SCALE_SD),
        )
    ]
    history = compose({"calibration": calibration_rows(rows)}, settings).tables["calibration"]
    triads, origins = {}, {}
    for s in SENSORS:
        own = history.filter(pl.col("sensor") == s, ~pl.col("parameter").str.starts_with("residual_"))
        scale = constants(own, s)[0]  # type: ignore[index]
        value = {(r["parameter"], r["axis"]): r["value"] for r in own.iter_rows(named=True)}
        triads[s] = Triad(
            scale=scale if scale.ndim == 2 else np.diag(scale),
            zero=np.array([value["zero", a] for a in "xyz"]),
            scale_per_degc=np.zeros((3, 3)),
            zero_per_degc=np.zeros(3),
            scale_sd=np.full(3, SCALE_SD),
            zero_sd=np.full(3, ZERO_SD[s]),
            unit=UNIT[s],
            logged_unit=UNIT[s],
            temperature_degc=25.0,
            flown_degc=None,
            why=(),
        )
        rotation = tuple(map(tuple, loaded[s]["rotation"]))
        told = Loaded(loaded[s]["autopilot"], loaded[s]["device_id"], rotation, loaded[s]["parameters"])  # type: ignore[arg-type]
        origins[s] = Origin(told, temperature_degc=case.degc)
    return Constants("v", "i", triads, "", origins=origins)


def exported(case: Case, flown: Constants, folder: Path) -> dict[str, float]:
    """What the autopilot flies with once the file is loaded on top of what it had."""
    text = AUTOPILOTS[case.autopilot](flown, None).text
    read = (
        formulas.read_qgroundcontrol(text) if case.autopilot == "px4" else formulas.read_mission_planner(text, folder)
    )
    assert not {name for name in read if name.endswith(("_ROT", "_PRIO", "ORIENTATION"))}
    return {**case.parameters, **read}


def readings(sensor: Sensor, seed: int) -> np.ndarray:
    return SIZE[sensor] * np.random.default_rng(seed).normal(size=(50, 3))


@pytest.mark.parametrize("autopilot", ["px4", "ardupilot"])
@pytest.mark.parametrize("seed", range(12))
def test_without_errors_the_exported_file_makes_the_truth_of_raw_readings(
    autopilot: str, seed: int, tmp_path: Path
) -> None:
    case = drawn(autopilot, seed, gyroscope_scale=False)
    found = {s: of_logged(case, s) for s in SENSORS}
    held = exported(case, composed(case, found), tmp_path)
    for s in SENSORS:
        raw = readings(s, seed)
        off = np.abs(case.logged(s, raw, held) - case.true(s, raw)).max()
        assert off < EXACT * SIZE[s], (s, off)
        assert off < 1e-3 * np.abs(case.logged(s, raw) - case.true(s, raw)).max()


def affine(case: Case, sensor: Sensor, held: dict[str, float]) -> tuple[np.ndarray, np.ndarray]:
    """Matrix and zero, in the axes in which the autopilot calibrates, that parameters make of raw readings."""
    turn = np.eye(3) if case.calibrates_in_body(sensor) else case.board
    raw = np.vstack([np.zeros(3), np.eye(3)])
    if case.calibrates_in_body(sensor):
        raw = raw @ case.board
    z = case.logged(sensor, raw, held) @ turn
    matrix = (z[1:] - z[0]).T
    return matrix, -np.linalg.solve(matrix, z[0])


@pytest.mark.parametrize("autopilot", ["px4", "ardupilot"])
def test_errors_on_the_aircraft_are_as_large_as_the_sd_says(autopilot: str, tmp_path: Path) -> None:
    """Offsets, scales and the magnetometer's matrix; of a gyroscope, which has no scale on either, the offset."""
    ratios: list[float] = []
    better = worse = 0
    for seed in RNG_SEEDS:
        case = drawn(autopilot, 1000 + seed)
        rng = np.random.default_rng(seed)
        found = {}
        for s in SENSORS:
            a, b = of_logged(case, s)
            noise = SCALE_SD * rng.normal(size=(3, 3))
            found[s] = a + noise, b + ZERO_SD[s] * rng.normal(size=3)
        held = exported(case, composed(case, found), tmp_path)
        for s in SENSORS:
            (matrix, zero), (active, _) = affine(case, s, held), affine(case, s, case.parameters)
            zero_sd = ZERO_SD[s] * np.linalg.norm(np.linalg.inv(active), axis=1)
            ratios += ((zero - case.zero[s]) / zero_sd).tolist()
            if s != Sensor.GYROSCOPE:
                scale_sd = SCALE_SD * np.linalg.norm(active, axis=0)
                ratios += (np.diagonal(matrix - case.scale[s]) / scale_sd).tolist()
            raw = readings(s, seed) if s != Sensor.GYROSCOPE else np.zeros((1, 3))
            before, after = (
                np.linalg.norm(case.logged(s, raw, p) - case.true(s, raw)) for p in (case.parameters, held)
            )
            better, worse = better + (after < before), worse + (after >= before)
    assert 0.8 < np.sqrt(np.mean(np.square(ratios))) < 1.2
    assert np.mean(np.abs(ratios) > 3.0) <= 0.005
    assert better >= 0.95 * (better + worse)


@pytest.mark.parametrize("autopilot", ["px4", "ardupilot"])
@pytest.mark.parametrize("seed", range(6))
def test_a_curve_over_temperature_is_the_same_on_the_aircraft(autopilot: str, seed: int, tmp_path: Path) -> None:
    """The history tells the raw sensors' cubic; whether a block was loaded before and what it said does not matter."""
    case = drawn(autopilot, 2000 + seed, gyroscope_scale=False)
    rng = np.random.default_rng(seed)
    flown = composed(case, {s: of_logged(case, s) for s in SENSORS})
    triads, curves = {}, {}
    warm = np.linspace(15.0, 40.0, 7)
    for s in SENSORS if autopilot == "px4" else (Sensor.GYROSCOPE, Sensor.ACCELEROMETER):
        terms = np.array([[1e-2], [2e-4], [1e-6]]) * OFFSET[s] * rng.normal(size=(3, 3))
        d = warm[:, None] - 25.0
        curves[s] = case.zero[s] + d * terms[0] + d**2 * terms[1] + d**3 * terms[2]
        turned = terms @ case.board.T
        triads[s] = replace(
            flown.triads[s],
            zero=case.board @ case.zero[s],
            zero_per_degc=turned[0],
            zero_per_degc2=turned[1],
            zero_per_degc3=turned[2],
            temperature_degc=25.0,
            flown_degc=(15.0, 40.0),
        )
    held = exported(case, replace(flown, triads=triads), tmp_path)
    for s, zeros in curves.items():
        for degc, zero in zip(warm, zeros, strict=True):
            raw = readings(s, seed)
            found = replace(case, degc=float(degc)).logged(s, raw, held)
            wanted = (raw - zero) @ case.scale[s].T @ case.board.T
            assert np.abs(found - wanted).max() < EXACT * SIZE[s], (s, degc)


@pytest.mark.parametrize("autopilot", ["px4", "ardupilot"])
@pytest.mark.parametrize("seed", range(6))
def test_given_parameters_are_composed_with_constants_of_corrected_readings(
    autopilot: str, seed: int, tmp_path: Path
) -> None:
    """A log that tells nothing of its autopilot: the constants are those of the logged readings, with a slope."""
    case = drawn(autopilot, 3000 + seed, gyroscope_scale=False)
    others = {f"CAL_{short}{n}_ID" for short in ("GYRO", "ACC", "MAG") for n in range(3)}
    own = {f"CAL_{formulas.PX4_SHORT[s][0]}{case.slots[s]}_ID" for s in SENSORS}
    case = replace(case, parameters={k: v for k, v in case.parameters.items() if k not in others - own})
    slope = {s: 1e-3 * OFFSET[s] * np.array([1.0, -2.0, 3.0]) for s in SENSORS}
    triads = {}
    for s in SENSORS:
        a, b = of_logged(case, s)
        triads[s] = Triad(
            scale=a,
            zero=b,
            scale_per_degc=np.zeros((3, 3)),
            zero_per_degc=slope[s],
            scale_sd=np.full(3, SCALE_SD),
            zero_sd=np.full(3, ZERO_SD[s]),
            unit=UNIT[s],
            logged_unit=UNIT[s],
            temperature_degc=case.degc,
            flown_degc=(12.0, 48.0),
            why=(),
        )
    constants = Constants("v", "i", triads, "", origins=dict.fromkeys(SENSORS, Origin()))
    with pytest.raises(FieldcalError, match="Give the parameters that were active") as caught:
        AUTOPILOTS[autopilot](constants, None)
    assert caught.value.reason_code == "not_loadable"
    text = AUTOPILOTS[autopilot](constants, Request(parameters=case.parameters)).text
    read = formulas.read_qgroundcontrol(text) if autopilot == "px4" else formulas.read_mission_planner(text, tmp_path)
    held = {**case.parameters, **read}
    for s in SENSORS:
        for degc in (15.0, case.degc, 45.0):
            warm = replace(case, degc=degc)
            raw = readings(s, seed)
            moved = 0.0 if (autopilot, s) == ("ardupilot", Sensor.MAGNETOMETER) else slope[s] * (degc - case.degc)
            wanted = (warm.logged(s, raw) - triads[s].zero - moved) @ triads[s].scale.T
            found = warm.logged(s, raw, held)
            assert np.abs(found - wanted).max() < EXACT * SIZE[s], (s, degc)


@pytest.mark.parametrize("motor", [{"X": 4.0, "Y": -7.0, "Z": 2.5}, {"Y": -7.0}, {}])
def test_the_motors_field_stays_cancelled(motor: dict[str, float], tmp_path: Path) -> None:
    """logged = D k (raw + OFS) + MOT · current: what the estimate makes of it, the new parameters make of raw ones."""
    case = drawn("ardupilot", 7)
    slot = case.slots[Sensor.MAGNETOMETER]
    n = str(slot + 1) if slot else ""
    loaded = {f"COMPASS_MOT{n}_{axis}": value for axis, value in motor.items()} | {"COMPASS_MOTCT": 2.0}
    case = replace(case, parameters={**case.parameters, **loaded})
    a, b = of_logged(case, Sensor.MAGNETOMETER)
    held = exported(case, composed(case, {s: of_logged(case, s) for s in SENSORS}), tmp_path)
    assert any(name.startswith(f"COMPASS_MOT{n}_") for name in held) == bool(motor)
    raw, current = readings(Sensor.MAGNETOMETER, 7), np.linspace(0.0, 40.0, 50)
    warm = np.full(50, case.degc)
    before, after = (formulas.ardupilot("magnetometer", slot, raw, p, warm, current) for p in (case.parameters, held))
    assert np.abs(after - (before - b) @ a.T).max() < EXACT * SIZE[Sensor.MAGNETOMETER]
