"""Constants in the formats of others: parsed back and applied by the target's own formula, they give the same."""

from __future__ import annotations

import json
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from fieldcal.exports import FORMATS
from fieldcal.exports.calibration import Constants, Triad

EQUAL = 1e-9
"""Largest difference of calibrated readings, relative to their size."""
AT, WARM = 20.0, 33.0
UNITS = {"gyroscope": "rad/s", "accelerometer": "m/s^2", "magnetometer": "T"}
SIZE = {"gyroscope": 3.0, "accelerometer": 9.8, "magnetometer": 5e-5}
RNG = np.random.default_rng(3)
RAW = {sensor: size * RNG.normal(size=(200, 3)) for sensor, size in SIZE.items()}


def triad(sensor: str, *, soft_iron: bool = False, warm: bool = False, unit_scale: bool = False) -> Triad:
    scale = np.eye(3) if unit_scale else np.diag(RNG.uniform(0.95, 1.05, 3))
    if soft_iron:
        off = RNG.normal(scale=0.02, size=(3, 3))
        scale = scale + off + off.T
    size = SIZE[sensor]
    return Triad(
        scale=scale,
        zero=0.1 * size * RNG.normal(size=3),
        scale_per_degc=1e-4 * RNG.normal(size=(3, 3)) * np.eye(3) if warm else np.zeros((3, 3)),
        zero_per_degc=1e-3 * size * RNG.normal(size=3) if warm else np.zeros(3),
        zero_per_degc2=2e-5 * size * RNG.normal(size=3) if warm else np.zeros(3),
        zero_per_degc3=1e-6 * size * RNG.normal(size=3) if warm else np.zeros(3),
        scale_sd=np.full(3, 1e-3),
        zero_sd=np.array([1e-3, np.nan, 1e-3]),
        unit=UNITS[sensor],
        logged_unit=UNITS[sensor],
        temperature_degc=AT,
        flown_degc=(-5.0, 45.0) if warm else None,
        why=("Trend of 24 flights.",),
    )


def constants(**triads: Triad) -> Constants:
    return Constants("v\n1*/", "imu 7", triads, "2026-05-04T12:00:00+00:00")


def same(found: np.ndarray, wanted: np.ndarray) -> bool:
    return bool(np.abs(found - wanted).max() <= EQUAL * np.abs(wanted).max())


def px4(text: str) -> dict[str, float]:
    rows = [line.split("\t") for line in text.splitlines() if not line.startswith("#")]
    assert {(row[0], row[1], len(row)) for row in rows} == {("1", "1", 5)}
    return {row[2]: float(row[3]) for row in rows}


def vector(p: dict[str, float], pattern: str) -> np.ndarray:
    return np.array([p[pattern.replace("?", axis)] for axis in "XYZ"])


def symmetric(diagonal: np.ndarray, off: np.ndarray) -> np.ndarray:
    return np.array([[diagonal[0], off[0], off[1]], [off[0], diagonal[1], off[2]], [off[1], off[2], diagonal[2]]])


@pytest.mark.parametrize("temperature", [AT, WARM])
def test_px4(temperature: float) -> None:
    accelerometer = replace(triad("accelerometer", warm=True), scale_per_degc=np.zeros((3, 3)))
    gyroscope = replace(triad("gyroscope", warm=True, unit_scale=True), scale_per_degc=np.zeros((3, 3)))
    magnetometer = triad("magnetometer", soft_iron=True)
    export = FORMATS["px4"](constants(accelerometer=accelerometer, gyroscope=gyroscope, magnetometer=magnetometer))
    p = px4(export.text)

    def thermal(sensor: str) -> np.ndarray:
        x = np.array([[p[f"TC_{sensor}0_X{order}_{i}"] for i in range(3)] for order in range(4)])
        t = np.clip(temperature, p[f"TC_{sensor}0_TMIN"], p[f"TC_{sensor}0_TMAX"]) - p[f"TC_{sensor}0_TREF"]
        return np.array([1.0, t, t**2, t**3]) @ x

    at = np.full(200, temperature)
    found = (RAW["accelerometer"] - thermal("A") - vector(p, "CAL_ACC0_?OFF")) * vector(p, "CAL_ACC0_?SCALE")
    assert same(found, accelerometer.apply(RAW["accelerometer"], at))
    found = RAW["gyroscope"] - thermal("G") - vector(p, "CAL_GYRO0_?OFF")
    assert same(found, gyroscope.apply(RAW["gyroscope"], at))
    gauss = 1e4 * RAW["magnetometer"]
    matrix = symmetric(vector(p, "CAL_MAG0_?SCALE"), vector(p, "CAL_MAG0_?ODIAG"))
    assert same((gauss - vector(p, "CAL_MAG0_?OFF")) @ matrix.T, 1e4 * magnetometer.apply(RAW["magnetometer"]))


@pytest.mark.parametrize("temperature", [AT, WARM])
def test_ardupilot(temperature: float) -> None:
    accelerometer = replace(triad("accelerometer", warm=True), scale_per_degc=np.zeros((3, 3)))
    gyroscope = replace(triad("gyroscope", warm=True, unit_scale=True), scale_per_degc=np.zeros((3, 3)))
    magnetometer = triad("magnetometer", soft_iron=True)
    all_three = constants(accelerometer=accelerometer, gyroscope=gyroscope, magnetometer=magnetometer)
    export = FORMATS["ardupilot"](all_three)
    p = {k: float(v) for k, v in (r.split(",") for r in export.text.splitlines() if not r.startswith("#"))}

    def thermal(short: str) -> np.ndarray:
        c = np.array([vector(p, f"INS_TCAL1_{short}{order}_?") for order in (1, 2, 3)])
        low, high = p["INS_TCAL1_TMIN"], p["INS_TCAL1_TMAX"]
        inside = [np.clip(t, low, high) for t in (temperature, p[f"INS_{short}1_CALTEMP"])]
        polynomial = [np.array([t - 35.0, (t - 35.0) ** 2, (t - 35.0) ** 3]) @ c * 1e-6 for t in inside]
        return polynomial[0] - polynomial[1]

    at = np.full(200, temperature)
    found = (RAW["accelerometer"] - thermal("ACC") - vector(p, "INS_ACCOFFS_?")) * vector(p, "INS_ACCSCAL_?")
    assert same(found, accelerometer.apply(RAW["accelerometer"], at))
    found = RAW["gyroscope"] - thermal("GYR") - vector(p, "INS_GYROFFS_?")
    assert same(found, gyroscope.apply(RAW["gyroscope"], at))
    milligauss = 1e7 * RAW["magnetometer"]
    matrix = symmetric(vector(p, "COMPASS_DIA_?"), vector(p, "COMPASS_ODI_?"))
    assert same((milligauss + vector(p, "COMPASS_OFS_?")) @ matrix.T, 1e7 * magnetometer.apply(RAW["magnetometer"]))


@pytest.mark.parametrize("form", ["ros", "json", "c"])
def test_formats_that_hold_everything(form: str, tmp_path: Path) -> None:
    triads = {sensor: triad(sensor, soft_iron=True, warm=True) for sensor in SIZE}
    export = FORMATS[form](constants(**triads))
    assert export.warnings == ()
    for sensor, raw in RAW.items():
        wanted = triads[sensor].apply(raw, np.full(200, WARM))
        if form == "c":
            found = compiled(export.text, sensor, raw, tmp_path)
        else:
            document = yaml.safe_load(export.text) if form == "ros" else json.loads(export.text)
            if form == "ros":
                document = {"sensors": document["/**"]["ros__parameters"]["fieldcal"]}
            t = document["sensors"][sensor]
            a = {
                k: np.array(t[k], dtype=float).reshape((3, 3) if "scale" in k else 3)
                for k in ("scale", "zero", "scale_per_degc", "zero_per_degc", "zero_per_degc2", "zero_per_degc3")
            }
            dt = WARM - t["temperature_degc"]
            scale = a["scale"] + a["scale_per_degc"] * dt
            zero = a["zero"] + a["zero_per_degc"] * dt + a["zero_per_degc2"] * dt**2 + a["zero_per_degc3"] * dt**3
            found = (raw - zero) @ scale.T
            assert (t["unit"], t["raw_unit"]) == (UNITS[sensor], UNITS[sensor])
        assert same(found, wanted)


def compiled(header: str, sensor: str, raw: np.ndarray, folder: Path) -> np.ndarray:
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("no C compiler")
    (folder / "constants.h").write_text(header)
    (folder / "main.c").write_text(
        '#include <stdio.h>\n#include "constants.h"\nint main(void) { double r[3], z[3];\n'
        'while (scanf("%lf %lf %lf", r, r + 1, r + 2) == 3) {\n'
        f"fieldcal_apply(&fieldcal_{sensor}, r, {WARM}, z);\n"
        'printf("%.17g %.17g %.17g\\n", z[0], z[1], z[2]); } return 0; }\n'
    )
    program = str(folder / "main")
    strict = ["-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-Wno-unused"]
    subprocess.run([compiler, *strict, "-o", program, str(folder / "main.c")], check=True)
    text = "\n".join(" ".join(repr(float(v)) for v in row) for row in raw)
    out = subprocess.run([program], input=text, capture_output=True, text=True, check=True).stdout
    return np.array([[float(v) for v in line.split()] for line in out.splitlines()])


def test_kalibr_holds_the_matrix() -> None:
    triads = {sensor: triad(sensor, soft_iron=True) for sensor in SIZE}
    export = FORMATS["kalibr"](constants(**triads))
    imu = yaml.safe_load(export.text)["imu0"]
    assert imu["model"] == "scale-misalignment"
    for sensor, block in (("accelerometer", "accelerometers"), ("gyroscope", "gyroscopes")):
        m = np.array(imu[block]["M"])
        bias = triads[sensor].zero  # what Kalibr would estimate by itself
        found = np.linalg.solve(m, (RAW[sensor] - bias).T).T
        assert same(found, triads[sensor].apply(RAW[sensor]))
    assert np.array(imu["gyroscopes"]["C_gyro_i"]).tolist() == np.eye(3).tolist()
    assert any("magnetometer" in warning for warning in export.warnings)
    assert any("bias" in warning for warning in export.warnings)


@pytest.mark.parametrize("form", ["px4", "ardupilot"])
def test_what_an_autopilot_cannot_hold_is_told(form: str) -> None:
    counts = replace(triad("accelerometer"), logged_unit="counts")
    mirrored = replace(triad("magnetometer"), scale=np.diag([1.0, -1.0, 1.0]))
    export = FORMATS[form](constants(accelerometer=counts, magnetometer=mirrored, gyroscope=triad("gyroscope")))
    assert not any(name in export.text for name in ("ACC", "MAG", "COMPASS"))
    told = " ".join(export.warnings)
    for part in ("in counts", "negative scale", "no gyroscope scale"):
        assert part in told
    warm = constants(accelerometer=triad("accelerometer", warm=True), magnetometer=triad("magnetometer", warm=True))
    told = " ".join(FORMATS[form](warm).warnings)
    for part in ("no slope of the scale on temperature", "does not correct it for temperature"):
        assert part in told
    cross = constants(
        accelerometer=triad("accelerometer", soft_iron=True),
        magnetometer=replace(triad("magnetometer"), scale=np.eye(3) + np.diag([0.1, 0.0], k=1)),
    )
    told = " ".join(FORMATS[form](cross).warnings)
    for part in ("no cross-axis terms", "symmetric matrix"):
        assert part in told


def test_a_narrow_temperature_range_is_not_for_ardupilot() -> None:
    narrow = replace(triad("accelerometer", warm=True), flown_degc=(17.0, 24.0))
    export = FORMATS["ardupilot"](constants(accelerometer=narrow))
    assert "TCAL" not in export.text
    assert any("10 °C" in warning for warning in export.warnings)


def test_ids_cannot_break_out_of_a_comment() -> None:
    """The id has a line break and the end of a C comment in it."""
    for form, write in FORMATS.items():
        text = write(constants(gyroscope=triad("gyroscope"))).text
        assert "\n1*/" not in text, form
