"""Changes in `exports` that no caller can see."""

from __future__ import annotations

from mutation_table.reasons import NEVER_MET, RCOND, SAME_MINUS, SWITCH, THREE_TAKEN, TINY_OFFSET, UNREAD

EQUIVALENT: dict[tuple[str, str, str, str], str] = {
    (
        "exports.apply",
        "_temperature_at",
        'origin = int(known["t_ns"][0])',
        "0 → 1",
    ): "an origin near the stamps, for the digits alone",
    (
        "exports.apply",
        "raw_readings",
        "return logged if p is None or o is None else np.linalg.solve(np.array(p), (logged - np.array(o)).T).T",
        "or → and",
    ): "both are known of a sensor, or neither",
    (
        "exports.autopilots.affine",
        "of_raw",
        "there = np.zeros((3, 3)) if thermal is None else thermal.about(triad.temperature_degc)",
        "3 → 4",
    ): UNREAD,
    (
        "exports.autopilots.ardupilot",
        "",
        "NOT_ZERO = {Sensor.ACCELEROMETER: 1e-5, Sensor.MAGNETOMETER: 1e-2}",
        "1e-05 → 1.1000000000000001e-05",
    ): TINY_OFFSET,
    (
        "exports.autopilots.ardupilot",
        "",
        "NOT_ZERO = {Sensor.ACCELEROMETER: 1e-5, Sensor.MAGNETOMETER: 1e-2}",
        "0.01 → 0.011000000000000001",
    ): TINY_OFFSET,
    (
        "exports.autopilots.ardupilot",
        "_by_itself",
        'if any(parameters.get("INS_GYR_CAL", 1.0) != 0.0 for parameters in gyroscopes):',
        "1.0 → 1.1",
    ): SWITCH,
    (
        "exports.autopilots.ardupilot_slot",
        "ArduPilot.named",
        "return [slot for slot, one in _names(sensor).items() if one.offset[0] in parameters]",
        "0 → 1",
    ): "parameters have an offset's three axes or none",
    (
        "exports.autopilots.ardupilot_slot",
        "ArduPilot.raw",
        "found = inertial_corrections(KIND[sensor], slot, Parameters.of(parameters), 0, at)",
        "0 → 1",
    ): "parameters and temperature hold all the time",
    ("exports.autopilots.comparison", "", "ROUNDING = 1e-9", "1e-09 → 1.1000000000000001e-09"): RCOND,
    ("exports.autopilots.comparison", "_shown", "return 0.0 if abs(value) < ROUNDING else value", "< → <="): NEVER_MET,
    (
        "exports.autopilots.comparison",
        "_of_sensor",
        "sure = not np.isfinite(sd) or abs(estimate - loaded) > SURE_SD * sd",
        "> → >=",
    ): NEVER_MET,
    (
        "exports.autopilots.comparison",
        "_of_sensor",
        "bool(sure and effect is not None and effect >= MATTERS[effect_unit]),",
        ">= → >",
    ): NEVER_MET,
    (
        "exports.autopilots.loading",
        "_stated_raw",
        "if (angle := angle_deg(mounting)) > LEAST_TURN_DEG:",
        "> → >=",
    ): NEVER_MET,
    ("exports.autopilots.loading", "_composed", "if angle_deg(mounting) > LEAST_TURN_DEG:", "> → >="): NEVER_MET,
    (
        "exports.autopilots.parameter_file",
        "read_parameters",
        'f"{path}, line {number}: {line.strip()[:60]!r} is no parameter as QGroundControl or Mission Planner"',
        "60 → 66",
    ): "how much of a line is shown, to find it by",
    (
        "exports.autopilots.px4",
        "_by_itself",
        "own = [name for name in BY_ITSELF[sensor] if any(p.get(name, 1.0) != 0.0 for p in loaded)]",
        "1.0 → 1.1",
    ): SWITCH,
    ("exports.autopilots.thermal", "", "ROUNDING = 1e-9", "1e-09 → 1.1000000000000001e-09"): RCOND,
    (
        "exports.autopilots.thermal",
        "curve_to_load",
        "bent = np.abs(found - there)[1:] > ROUNDING * np.maximum(np.abs(found), np.abs(there))[1:]",
        "maximum → minimum",
    ): "where two are nearly one, either tells their size",
    (
        "exports.autopilots.thermal",
        "curve_to_load",
        "own = Curve(triad.temperature_degc, low, high, np.where(differs, found, there), np.zeros(3))",
        "3 → 4",
    ): UNREAD,
    (
        "exports.autopilots.thermal",
        "slope_span",
        "known = np.abs(triad.zero_per_degc) > triad.zero_per_degc_sd",
        "> → >=",
    ): NEVER_MET,
    ("exports.autopilots.units", "", "ROUNDING = 1e-9", "1e-09 → 1.1000000000000001e-09"): RCOND,
    (
        "exports.autopilots.units",
        "not_held",
        "if sensor != Sensor.MAGNETOMETER and cross > ROUNDING:",
        "> → >=",
    ): NEVER_MET,
    ("exports.autopilots.units", "dropped_rotation", "if angle < LEAST_ANGLE_DEG:", "< → <="): NEVER_MET,
    (
        "exports.calibrated_files",
        "write_folder",
        "values = c.readings[name][1] if name in own else np.full((len(t_ns), 3), np.nan)",
        "3 → 4",
    ): THREE_TAKEN,
    (
        "exports.calibrated_files",
        "write_ros",
        "nothing = np.full((len(either[0]), 3), np.nan)",
        "0 → 1",
    ): "stamps and readings are equally many",
    (
        "exports.calibration_at",
        "_constants",
        'ids = {s: str(rows.filter(sensor=s)["unit_id"][0]) for s in triads}',
        "0 → 1",
    ): "the rows of a sensor are one unit's",
    ("exports.handed_out", "_became", 'same=(pl.col("set_to") - pl.col("exported")).abs()', "<= → <"): NEVER_MET,
    (
        "exports.json_document",
        "json_document",
        'return Export(json.dumps(document, ensure_ascii=False, indent=1, allow_nan=False) + "\\n", ())',
        "1 → 2",
    ): "white space of JSON means nothing",
    (
        "exports.kalibr",
        "lower_and_rotation",
        "return np.asarray(lower * signs), np.asarray(signs[:, None] * turn)",
        "* → /",
    ): SAME_MINUS,
    (
        "exports.yaml_text",
        "number",
        'return text.replace("e", ".0e", 1) if "e" in text and "." not in text else text',
        "1 → 2",
    ): "a number has one exponent",
    (
        "exports.refit",
        "_ellipsoid",
        "magnitude=float(shares @ [one.magnitude or 0.0 for one in flights]) or float(first.magnitude or 1.0),",
        "0.0 → 1.0",
    ): "flights without a length are fitted to 1 either way",
}
