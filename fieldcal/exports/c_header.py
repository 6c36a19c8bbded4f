"""A C99 header: the whole model as doubles, with one function that applies it."""

from __future__ import annotations

import json

import numpy as np

from fieldcal.exports.calibration import Constants, Export
from fieldcal.names import INERTIAL_FIRST

APPLY = """\
/* out = S (raw - Z) at temperature_degc; d = T - T0: S = scale + scale_per_degc d, Z = zero + zero_per_degc d
   + zero_per_degc2 d^2 + zero_per_degc3 d^3. */
static inline void fieldcal_apply(const fieldcal_triad *c, const double raw[3], double temperature_degc, double out[3])
{
    const double warmer = temperature_degc - c->temperature_degc;
    for (int i = 0; i < 3; i++) {
        out[i] = 0.0;
        for (int j = 0; j < 3; j++) {
            const double scale = c->scale[i][j] + warmer * c->scale_per_degc[i][j];
            const double bend = c->zero_per_degc2[j] + warmer * c->zero_per_degc3[j];
            out[i] += scale * (raw[j] - c->zero[j] - warmer * (c->zero_per_degc[j] + warmer * bend));
        }
    }
}
"""


def c_header(constants: Constants) -> Export:
    """`fieldcal_<sensor>` and `fieldcal_apply`; sensor axes as logged."""
    parts = [
        f"/* fieldcal: {_comment(constants.vehicle_id)}, IMU {_comment(constants.imu_id)},"
        f" as of {constants.as_of or 'unknown'}. Sensor axes as logged. */",
        "#ifndef FIELDCAL_CONSTANTS_H",
        "#define FIELDCAL_CONSTANTS_H",
        "",
        "typedef struct {",
        "    double temperature_degc; /* T0 */",
        "    double scale[3][3];",
        "    double zero[3];",
        "    double scale_per_degc[3][3];",
        "    double zero_per_degc[3];",
        "    double zero_per_degc2[3];",
        "    double zero_per_degc3[3];",
        "} fieldcal_triad;",
        "",
    ]
    for sensor in INERTIAL_FIRST:
        if (triad := constants.triads.get(sensor)) is None:
            continue
        parts += [
            f"/* raw in {_comment(triad.logged_unit)}, result in {_comment(triad.unit)} */",
            f"static const fieldcal_triad fieldcal_{sensor} = {{",
            f"    {float(triad.temperature_degc)!r},",
            f"    {_array(triad.scale)},",
            f"    {_array(triad.zero)},",
            f"    {_array(triad.scale_per_degc)},",
            f"    {_array(triad.zero_per_degc)},",
            f"    {_array(triad.zero_per_degc2)},",
            f"    {_array(triad.zero_per_degc3)},",
            "};",
            "",
        ]
    return Export("\n".join([*parts, APPLY, "#endif"]) + "\n", ())


def _array(values: np.ndarray) -> str:
    return "{" + ", ".join(_array(v) if v.ndim else repr(float(v)) for v in np.asarray(values)) + "}"


def _comment(text: str) -> str:
    """Text that cannot end the comment it stands in."""
    return json.dumps(text, ensure_ascii=True).replace("*/", "* /").strip('"')
