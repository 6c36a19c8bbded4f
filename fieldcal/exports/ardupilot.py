"""ArduPilot parameters, as Mission Planner and MAVProxy load them.

Conventions (ArduPilot, libraries/AP_InertialSensor and AP_Compass): in sensor axes, before rotation to the board,

    accelerometer  (raw − thermal − INS_ACCOFFS) · INS_ACCSCAL, m/s²
    gyroscope      raw − thermal − INS_GYROFFS, rad/s; there is no scale
    compass        M (raw + COMPASS_OFS), milligauss; M symmetric: COMPASS_DIA on the diagonal, COMPASS_ODI_X = M_xy,
                   _Y = M_xz, _Z = M_yz. **The offset is added: it has the opposite sign of fieldcal's zero**
    thermal        p(T) − p(INS_ACC1_CALTEMP), p(T) = 1e-6 (INS_TCAL1_ACC1 d + _ACC2 d² + _ACC3 d³), d = T − 35 °C, both
                   temperatures kept within INS_TCAL1_TMIN … TMAX, which must be at least 10 °C apart (gyroscope:
                   INS_TCAL1_GYR1, INS_GYR1_CALTEMP)

The first instance of each sensor is written; ArduPilot keeps parameters as float32.
"""

from __future__ import annotations

from fieldcal.exports.autopilot import in_autopilot_units, not_held, symmetric, thermal
from fieldcal.exports.calibration import Constants, Export, cubic_about
from fieldcal.names import Sensor

MILLIGAUSS = 1e-3
COEFFICIENT = 1e6
TEMPERATURE_REFERENCE_DEGC = 35.0
LEAST_SPAN_DEGC = 10.0
AXES = "XYZ"


def ardupilot(constants: Constants) -> Export:
    """NAME,VALUE lines."""
    triads, warnings = in_autopilot_units(constants, magnetic_unit=MILLIGAUSS)
    rows: list[tuple[str, float | int]] = []
    warm = []
    for sensor, short, offset in (
        (Sensor.ACCELEROMETER, "ACC", "INS_ACCOFFS"),
        (Sensor.GYROSCOPE, "GYR", "INS_GYROFFS"),
    ):
        if (triad := triads.get(sensor)) is None:
            continue
        for i, axis in enumerate(AXES):
            rows.append((f"{offset}_{axis}", float(triad.zero[i])))
            if sensor == Sensor.ACCELEROMETER:
                rows.append((f"INS_ACCSCAL_{axis}", float(triad.scale[i, i])))
        if thermal(triad) and triad.flown_degc is not None:
            warm.append((short, triad, *triad.flown_degc))
    if "gyroscope" in triads:
        warnings.append("gyroscope: ArduPilot measures INS_GYROFFS anew at every start unless INS_GYR_CAL is 0.")
    if warm:
        at = [triad.temperature_degc for _, triad, _, _ in warm]
        low, high = min(*(low for _, _, low, _ in warm), *at), max(*(high for _, _, _, high in warm), *at)
        if high - low < LEAST_SPAN_DEGC:
            warnings.append(
                f"Flown between {low:.1f} and {high:.1f} °C: ArduPilot wants 10 °C for a temperature calibration, so it"
                " is left out."
            )
        else:
            rows += [("INS_TCAL1_ENABLE", 1), ("INS_TCAL1_TMIN", low), ("INS_TCAL1_TMAX", high)]
            for short, triad, _, _ in warm:
                rows.append((f"INS_{short}1_CALTEMP", triad.temperature_degc))
                about_t0 = triad.zero_per_degc, triad.zero_per_degc2, triad.zero_per_degc3
                cubic = cubic_about(*about_t0, TEMPERATURE_REFERENCE_DEGC - triad.temperature_degc)
                for i, axis in enumerate(AXES):
                    for order, coefficient in enumerate(cubic, start=1):
                        rows.append((f"INS_TCAL1_{short}{order}_{axis}", COEFFICIENT * float(coefficient[i])))
    if (triad := triads.get(Sensor.MAGNETOMETER)) is not None:
        matrix, asymmetric = symmetric(triad, "ArduPilot")
        warnings += asymmetric
        off = (matrix[0, 1], matrix[0, 2], matrix[1, 2])
        for i, axis in enumerate(AXES):
            rows.append((f"COMPASS_OFS_{axis}", -float(triad.zero[i])))
            rows.append((f"COMPASS_DIA_{axis}", float(matrix[i, i])))
            rows.append((f"COMPASS_ODI_{axis}", float(off[i])))
    text = "\n".join([f"# {constants.heading}", *(f"{name},{value!r}" for name, value in rows)])
    return Export(text + "\n", (*warnings, *not_held(triads, "ArduPilot")))
