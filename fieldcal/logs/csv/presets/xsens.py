"""Xsens MT Manager's ASCII export: comments by //, then columns by output."""

from __future__ import annotations

import re

from fieldcal.logs.csv.presets.layout import Layout, Meaning, Preset, axes, positive

TICK = "100us"
"""SampleTimeFine counts 10 kHz (MT low-level communication protocol), in 32 bits."""
UPPER = ("X", "Y", "Z")
_RATE = re.compile(r"//\s*(?:Update|Sample) Rate:\s*(\d+(?:\.\d+)?)\s*Hz", re.IGNORECASE)


def read(layout: Layout) -> Meaning | str:
    """Calibrated readings: rad/s, m/s², the magnetometer in units of the field where it was calibrated. Time is
    SampleTimeFine where it is filled in, else PacketCounter (16 bits) at the update rate above the header."""
    if not any(line.startswith("//") for line in layout.above):
        return "no lines that begin with // stand above its header"
    sensors = {"gyroscope": axes("Gyr_*", UPPER), "accelerometer": axes("Acc_*", UPPER)}
    absent = [name for names in sensors.values() for name in names if not layout.has(name)]
    if absent:
        return f"it has no column {absent[0]!r}"
    magnetometer = axes("Mag_*", UPPER)
    known = {**sensors, **({"magnetometer": magnetometer} if layout.has(*magnetometer) else {})}
    units = {"gyroscope": "rad/s", "accelerometer": "m/s^2", "magnetometer": "norm"}
    if layout.has("SampleTimeFine") and layout.cell("SampleTimeFine").isdigit():
        return Meaning(imu={"t": "SampleTimeFine", **known}, time_unit=TICK, units=units, gravity_sign="specific_force")
    rates = [positive(match[1]) for match in map(_RATE.match, layout.above) if match]
    if not layout.has("PacketCounter") or not rates or rates[0] is None:
        return "it has neither SampleTimeFine nor a PacketCounter with an update rate above the header"
    return Meaning(
        imu={"t": "PacketCounter", **known},
        rate_hz=rates[0],
        units=units,
        gravity_sign="specific_force",
        told=f"its time is that of packets at {rates[0]:g} Hz; csv.rate_hz corrects the rate",
    )


XSENS_MT = Preset("xsens_mt", "Xsens MT Manager's", "imu", read)
"""Quat_ … and Mat[ … are the device's own estimates, FreeAcc_ lacks gravity: neither is read. Sensor axes are those
printed on the device and left to the configuration. Xsens DOT's exports have other units under the same names, and no
lines by //."""
