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
from scipy.spatial.transform import Rotation

from fieldcal.errors import FieldcalError
from fieldcal.exports import AUTOPILOTS, FORMATS, export_to
from fieldcal.exports.autopilots.loading import Request
from fieldcal.exports.calibration import Constants, Export, Origin, Triad

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


RAW_READINGS = Request(logged_raw=True)


def export(form: str, c: Constants) -> Export:
    return export_to(form, c, RAW_READINGS if form in AUTOPILOTS else None)


def same(found: np.ndarray, wanted: np.ndarray) -> bool:
    return bool(np.abs(found - wanted).max() <= EQUAL * np.abs(wanted).max())


@pytest.mark.parametrize("form", ["ros", "json", "c"])
def test_formats_that_hold_everything(form: str, tmp_path: Path) -> None:
    triads = {sensor: triad(sensor, soft_iron=True, warm=True) for sensor in SIZE}
    written = export(form, constants(**triads))
    assert written.warnings == ()
    for sensor, raw in RAW.items():
        wanted = triads[sensor].apply(raw, np.full(200, WARM))
        if form == "c":
            found = compiled(written.text, sensor, raw, tmp_path)
        else:
            document = yaml.safe_load(written.text) if form == "ros" else json.loads(written.text)
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


def test_kalibr_reads_the_file_and_its_model_gives_the_readings() -> None:
    """ImuParameters of kalibr_common/ConfigReader.py asks for these fields; the model is IccSensors.py's."""
    triads = {sensor: triad(sensor, soft_iron=True) for sensor in SIZE}
    turned = np.eye(3) + np.array([[0.0, 0.02, -0.01], [-0.03, 0.0, 0.01], [0.02, 0.01, 0.0]])
    triads = {sensor: replace(t, scale=t.scale @ turned) for sensor, t in triads.items()}
    written = export("kalibr", replace(constants(**triads), imu_rate_hz=250.0))
    imu = yaml.safe_load(written.text)
    assert (imu["update_rate"], imu["rostopic"][0], imu["model"]) == (250.0, "/", "scale-misalignment")
    for name in ("accelerometer", "gyroscope"):
        assert imu[f"{name}_noise_density"] > 0.0
        assert imu[f"{name}_random_walk"] > 0.0
    assert isinstance(imu["time_offset"], float)
    t_i_b, c_gyro_i = np.array(imu["T_i_b"]), np.array(imu["gyroscopes"]["C_gyro_i"])
    for rotation in (t_i_b[:3, :3], c_gyro_i):
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(rotation) > 0.0
    assert t_i_b[3].tolist() == [0.0, 0.0, 0.0, 1.0]
    for sensor, block in (("accelerometer", "accelerometers"), ("gyroscope", "gyroscopes")):
        m = np.array(imu[block]["M"])
        assert not np.any(np.triu(m, 1))
        z = triads[sensor].apply(RAW[sensor])
        in_imu = z @ t_i_b[:3, :3].T
        seen = in_imu if sensor == "accelerometer" else in_imu @ c_gyro_i.T
        bias = triads[sensor].zero  # what Kalibr would estimate by itself
        assert same(seen @ m.T + bias, RAW[sensor])
    assert not np.any(np.array(imu["gyroscopes"]["A"]))
    assert any("magnetometer" in warning for warning in written.warnings)
    assert any("bias" in warning for warning in written.warnings)
    assert any("noise densities" in warning for warning in written.warnings)


def test_kalibrs_file_has_the_noise_of_its_documentation_and_says_so() -> None:
    """The example of Kalibr's page on YAML formats: an ADIS16448 at 200 Hz."""
    c = constants(gyroscope=triad("gyroscope"))
    written = export("kalibr", c)
    imu = yaml.safe_load(written.text)
    assert (imu["accelerometer_noise_density"], imu["accelerometer_random_walk"]) == (0.01, 0.0002)
    assert (imu["gyroscope_noise_density"], imu["gyroscope_random_walk"]) == (0.005, 4.0e-06)
    assert imu["update_rate"] == 200.0
    assert any("rate of the readings is not known" in told for told in written.warnings)
    assert not any("rate of" in told for told in export("kalibr", replace(c, imu_rate_hz=200.0)).warnings)


def test_imu_calibs_file_gives_what_apply_gives() -> None:
    """AccelCalib::loadCalib and applyCalib of imu_calib: corrected = SM · raw − bias, SM row by row."""
    t = triad("accelerometer", soft_iron=True)
    written = export("imu_calib", constants(accelerometer=t, gyroscope=triad("gyroscope")))
    node = yaml.safe_load(written.text)
    assert (len(node["SM"]), len(node["bias"])) == (9, 3)
    corrected = RAW["accelerometer"] @ np.array(node["SM"]).reshape(3, 3).T - np.array(node["bias"])
    assert same(corrected, t.apply(RAW["accelerometer"]))
    assert [told.partition(":")[0] for told in written.warnings] == ["gyroscope"]
    assert written.warnings[0].startswith("gyroscope: imu_calib measures its zero itself")
    written = export("imu_calib", constants(accelerometer=t, magnetometer=triad("magnetometer")))
    assert written.warnings == ("magnetometer: imu_calib has none; left out.",)
    for other in ({"gyroscope": triad("gyroscope")}, {"accelerometer": replace(t, logged_unit="counts")}):
        with pytest.raises(FieldcalError, match="imu_calib corrects an accelerometer in m/s²") as caught:
            export("imu_calib", constants(**other))
        assert caught.value.reason_code == "not_loadable"


def test_imu_pipelines_transform_is_how_the_sensor_is_mounted() -> None:
    turn = Rotation.from_euler("ZYX", [40.0, 20.0, -10.0], degrees=True)
    rows = tuple(map(tuple, turn.as_matrix()))
    c = constants(gyroscope=triad("gyroscope"))
    written = export("imu_pipeline", replace(c, origins={"gyroscope": Origin(rotation_body_from_sensor=rows)}))
    document = yaml.safe_load(written.text)
    sent = document["static_transform_publisher"]["ros__parameters"]
    found = Rotation.from_quat([sent[f"rotation.{axis}"] for axis in "xyzw"])
    assert (found * turn.inv()).magnitude() < 1e-12
    assert sent["frame_id"] == document["imu_transformer"]["ros__parameters"]["target_frame"]
    with pytest.raises(FieldcalError, match="is not known; run a night"):
        export("imu_pipeline", c)


@pytest.mark.parametrize("form", ["px4", "ardupilot"])
def test_what_an_autopilot_cannot_hold_is_told(form: str) -> None:
    counts = replace(triad("accelerometer"), logged_unit="counts")
    mirrored = replace(triad("magnetometer"), scale=np.diag([1.0, -1.0, 1.0]))
    written = export(form, constants(accelerometer=counts, magnetometer=mirrored, gyroscope=triad("gyroscope")))
    assert not any(name in written.text for name in ("ACC", "MAG", "COMPASS"))
    told = " ".join(written.warnings)
    for part in ("in counts", "negative scale", "no gyroscope scale"):
        assert part in told
    told = " ".join(export(form, constants(accelerometer=triad("accelerometer", warm=True))).warnings)
    assert "no slope of the scale on temperature" in told
    cross = constants(
        accelerometer=triad("accelerometer", soft_iron=True),
        magnetometer=replace(triad("magnetometer"), scale=np.eye(3) + np.diag([0.1, 0.0], k=1)),
    )
    told = " ".join(export(form, cross).warnings)
    for part in ("no cross-axis terms", "symmetric matrix"):
        assert part in told


@pytest.mark.parametrize("form", ["px4", "ardupilot"])
def test_counts_are_refused_and_make_no_file_of_comments(form: str) -> None:
    counts = {sensor: replace(triad(sensor), logged_unit="counts") for sensor in SIZE}
    with pytest.raises(FieldcalError, match=r"Nothing to load .* are in counts") as caught:
        export(form, constants(**counts))
    assert caught.value.reason_code == "not_loadable"


def test_a_narrow_temperature_range_is_not_for_ardupilot() -> None:
    narrow = replace(triad("accelerometer", warm=True), flown_degc=(17.0, 24.0))
    written = export("ardupilot", constants(accelerometer=narrow))
    assert "TCAL" not in written.text
    assert any("10 °C" in warning for warning in written.warnings)


def test_ids_cannot_break_out_of_a_comment() -> None:
    """The id has a line break and the end of a C comment in it."""
    c = constants(gyroscope=triad("gyroscope"), accelerometer=triad("accelerometer"))
    for form in FORMATS:
        text = export(form, replace(c, origins={"gyroscope": Origin(), "accelerometer": Origin()})).text
        assert "\n1*/" not in text, form
