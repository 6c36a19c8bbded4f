"""What PX4 and ArduPilot make of raw readings under parameters, written from their sources, and readers of their files.

Nothing of fieldcal is used: PX4-Autopilot, src/lib/sensor_calibration and src/modules/temperature_compensation;
ArduPilot, AP_InertialSensor_Backend.cpp, AP_InertialSensor_tempcal.cpp and AP_Compass_Backend.cpp. Readings are (n, 3)
in rad/s, m/s² and gauss; what is left out of a file has its default.
"""

from __future__ import annotations

import io
from collections.abc import Mapping
from contextlib import redirect_stdout
from pathlib import Path

import numpy as np
from pymavlink.mavparm import MAVParmDict
from scipy.spatial.transform import Rotation

YAW_ROLL_PITCH_DEG = {0: (0, 0, 0), 2: (0, 0, 90), 4: (0, 0, 180), 6: (0, 0, 270), 8: (180, 0, 0), 24: (0, 90, 0)}
"""Some of the mountings that both number alike: roll, pitch, yaw."""
PX4_SHORT = {"gyroscope": ("GYRO", "G"), "accelerometer": ("ACC", "A"), "magnetometer": ("MAG", "M")}


def read_qgroundcontrol(text: str) -> dict[str, float]:
    """Five columns, tabs between them; integers where the type is 6, floats where it is 9."""
    found = {}
    for line in text.splitlines():
        if line.startswith("#"):
            continue
        vehicle, component, name, value, kind = line.split("\t")
        assert 1 <= int(vehicle) <= 255
        assert component == "1"
        assert len(name) <= 16
        found[name] = float(int(value)) if kind == "6" else float(np.float32(value))
        assert kind in ("6", "9")
    return found


def read_mission_planner(text: str, folder: Path) -> dict[str, float]:
    """By pymavlink, which MAVProxy loads with; floats of 32 bits, as ArduPilot keeps them."""
    path = folder / "exported.param"
    path.write_text(text)
    loaded = MAVParmDict()
    with redirect_stdout(io.StringIO()):
        assert loaded.load(str(path))
    lines = [line for line in text.splitlines() if not line.startswith("#")]
    assert len(loaded) == len(lines)
    return {name: float(np.float32(value)) for name, value in loaded.items()}


def dcm(roll_deg: float, pitch_deg: float, yaw_deg: float) -> np.ndarray:
    return Rotation.from_euler("ZYX", [yaw_deg, pitch_deg, roll_deg], degrees=True).as_matrix()


def triple(p: Mapping[str, float], pattern: str, default: float = 0.0) -> np.ndarray:
    return np.array([p.get(pattern.replace("?", axis), default) for axis in "XYZ"])


def symmetric(diagonal: np.ndarray, off: np.ndarray) -> np.ndarray:
    (x, y, z), (xy, xz, yz) = diagonal, off
    return np.array([[x, xy, xz], [xy, y, yz], [xz, yz, z]])


def px4_board(p: Mapping[str, float]) -> np.ndarray:
    offset = dcm(*(p.get(f"SENS_BOARD_{axis}_OFF", 0.0) for axis in "XYZ"))
    return offset @ dcm(*YAW_ROLL_PITCH_DEG[int(p.get("SENS_BOARD_ROT", 0))])


def px4_thermal(sensor: str, device_id: int, p: Mapping[str, float], degc: np.ndarray) -> np.ndarray:
    letter = PX4_SHORT[sensor][1]
    for slot in range(4):
        own = f"TC_{letter}{slot}_"
        if p.get(f"TC_{letter}_ENABLE") == 1 and p.get(f"{own}ID") == device_id:
            d = np.clip(degc, p[f"{own}TMIN"], p[f"{own}TMAX"]) - p[f"{own}TREF"]
            x = np.array([[p[f"{own}X{order}_{axis}"] for axis in range(3)] for order in range(4)])
            return np.stack([d**0, d, d**2, d**3], axis=1) @ x
    return np.zeros((len(degc), 3))


def px4(sensor: str, device_id: int, raw: np.ndarray, p: Mapping[str, float], degc: np.ndarray) -> np.ndarray:
    """Readings as PX4 publishes them, turned to the body."""
    short = PX4_SHORT[sensor][0]
    slot = next(n for n in range(4) if p.get(f"CAL_{short}{n}_ID") == device_id)
    own = f"CAL_{short}{slot}_"
    left = raw - px4_thermal(sensor, device_id, p, degc) - triple(p, f"{own}?OFF")
    if sensor == "accelerometer":
        left = left * triple(p, f"{own}?SCALE", 1.0)
    if sensor == "magnetometer":
        left = left @ symmetric(triple(p, f"{own}?SCALE", 1.0), triple(p, f"{own}?ODIAG")).T
    return left @ px4_board(p).T


def ardupilot_instance(stem: str, slot: int) -> str:
    return stem if slot == 0 else f"{stem}{slot + 1}"


def ardupilot_thermal(kind: str, slot: int, p: Mapping[str, float], degc: np.ndarray) -> np.ndarray:
    own = f"INS_TCAL{slot + 1}_"
    if p.get(f"{own}ENABLE") != 1:
        return np.zeros((len(degc), 3))
    c = np.array([triple(p, f"{own}{kind}{order}_?") for order in (1, 2, 3)])

    def polynomial(t: np.ndarray) -> np.ndarray:
        d = np.clip(t, p[f"{own}TMIN"], p[f"{own}TMAX"]) - 35.0
        return np.stack([d, d**2, d**3], axis=1) @ c * 1e-6

    return polynomial(degc) - polynomial(np.array([p[f"INS_{kind}{slot + 1}_CALTEMP"]]))


def ardupilot(
    sensor: str,
    slot: int,
    raw: np.ndarray,
    p: Mapping[str, float],
    degc: np.ndarray,
    current_a: np.ndarray | None = None,
) -> np.ndarray:
    """Readings as ArduPilot uses them, in body axes."""
    board = dcm(*YAW_ROLL_PITCH_DEG[int(p.get("AHRS_ORIENTATION", 0))])
    if sensor == "magnetometer":
        n = "" if slot == 0 else str(slot + 1)
        left = 1e3 * raw @ board.T + triple(p, f"COMPASS_OFS{n}_?")
        scale = p.get(f"COMPASS_SCALE{n}", 0.0)
        if 1.0 / 1.5 <= scale <= 1.5:
            left = left * scale
        diagonal = triple(p, f"COMPASS_DIA{n}_?")
        left = left @ symmetric(diagonal if diagonal.any() else np.ones(3), triple(p, f"COMPASS_ODI{n}_?")).T
        if current_a is not None:
            left = left + current_a[:, None] * triple(p, f"COMPASS_MOT{n}_?")
        return 1e-3 * left
    kind = "GYR" if sensor == "gyroscope" else "ACC"
    own = ardupilot_instance(f"INS_{kind}", slot)
    left = raw - ardupilot_thermal(kind, slot, p, degc) - triple(p, f"{own}OFFS_?")
    if kind == "ACC":
        left = left * triple(p, f"{own}SCAL_?", 1.0)
    return left @ board.T
