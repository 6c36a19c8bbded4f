"""Betaflight's blackbox as CSV: by blackbox_decode, and by the Blackbox Explorer with the log's header above."""

from __future__ import annotations

import math
import re
import struct

from fieldcal.logs.csv.dialect import cells_of
from fieldcal.logs.csv.presets.layout import Layout, Meaning, Preset, positive

GYROSCOPE, ACCELEROMETER, MAGNETOMETER = "gyroADC[*]", "accSmooth[*]", "magADC[*]"
EXPLORER = "Blackbox flight data recorder"
UNITS = {"deg/s": "deg/s", "rad/s": "rad/s", "g": "g", "m/s/s": "m/s^2"}
"""Units as the decoder appends them in brackets → as they are called here."""
HIGH_RESOLUTION = 10.0
"""By so much Betaflight multiplies the gyroscope's readings where `blackbox_high_resolution` is on."""
_HEX_FLOAT = re.compile(r"0x[0-9a-fA-F]{8}$")


def read(layout: Layout) -> Meaning | str:
    """The decoder's columns, a unit in brackets behind the name or none (raw); the Explorer's, scaled by its header."""
    explorer = bool(layout.above) and EXPLORER in layout.above[0]
    found = {}
    units = {}
    for sensor, pattern in (("gyroscope", GYROSCOPE), ("accelerometer", ACCELEROMETER), ("magnetometer", MAGNETOMETER)):
        for unit in ("", *UNITS):
            names = tuple(pattern.replace("*", str(i)) + (f" ({unit})" if unit else "") for i in range(3))
            if layout.has(*names):
                found[sensor] = names
                units[sensor] = UNITS.get(unit, "counts")
    times = {f"time ({unit})": unit for unit in ("us", "ms", "s")} | ({"time": "us"} if explorer else {})
    time = next((name for name in times if layout.has(name)), None)
    if not layout.has("loopIteration") or time is None or "gyroscope" not in found:
        return "it has not all of loopIteration, time (us) and gyroADC[0], gyroADC[1], gyroADC[2]"
    factors: dict[str, float] = {}
    if explorer:
        factors, scaled = _scales(layout)
        units |= scaled
    current = {"current": "amperageLatest (A)"} if layout.has("amperageLatest (A)") else {}
    return Meaning(
        imu={"t": time, **found, **current},
        time_unit=times[time],
        units=units,
        factors=factors,
        gravity_sign="specific_force",
        told="" if explorer or units.get("accelerometer") != "counts" else "its readings are raw, in no known unit",
    )


def _scales(layout: Layout) -> tuple[dict[str, float], dict[str, str]]:
    """Factors and units of raw readings by the log's header, as the Explorer applies them: acc_1G counts are 1 g;
    gyroScale is rad/µs a count, and gyro_scale, the same as logged, deg/s as a float in hexadecimal."""
    header = {cells[0]: cells[1] for cells in (cells_of(line, ",") for line in layout.above) if len(cells) > 1}
    factors, units = {}, {}
    one_g, scale = (positive(header.get(key, "")) for key in ("acc_1G", "gyroScale"))
    logged = header.get("gyro_scale", "")
    if one_g is not None:
        factors["accelerometer"], units["accelerometer"] = 1.0 / one_g, "g"
    dps = None
    if scale is not None:
        dps = math.degrees(scale * 1e6)
    elif _HEX_FLOAT.match(logged):
        dps = positive(repr(struct.unpack(">f", bytes.fromhex(logged[2:]))[0]))
    if dps is not None:
        fine = header.get("blackbox_high_resolution", "0") not in ("0", "")
        factors["gyroscope"], units["gyroscope"] = dps / (HIGH_RESOLUTION if fine else 1.0), "deg/s"
    return factors, units


BETAFLIGHT = Preset("betaflight", "Betaflight's blackbox", "imu", read)
"""Raw readings of blackbox_decode stay counts: what scales them is not in the file. Body axes are left to the
configuration; the accelerometer reads +1 g on the axis that points up (specific force)."""
