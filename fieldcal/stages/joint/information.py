"""What a flight says of its constants as rows of `information`: of the joint estimate, of triads by a VPS's trajectory,
and of the raw sensor where an autopilot had corrected what it logged."""

from __future__ import annotations

from collections.abc import Collection, Mapping

import numpy as np
import polars as pl

from fieldcal.errors import FieldcalError
from fieldcal.estimation.by_pose.triad import TriadByPose
from fieldcal.estimation.joint.fit import JointFit
from fieldcal.estimation.joint.information import (
    CROSS_AXIS,
    DELAY,
    G_SENSITIVITY,
    GAIN,
    LEVER_ARM,
    SLOPE,
    ZERO,
    observed,
)
from fieldcal.estimation.joint.problem import CROSS
from fieldcal.estimation.normal_equations import Name, NormalEquations
from fieldcal.geometry.rotation import Array
from fieldcal.names import Sensor, Status
from fieldcal.reason_codes import ReasonCode
from fieldcal.stages.joint.judgement import (
    MAX_GYRO_NOISE_SHARE,
    MAX_LEVEL_SCALE_SD,
    SCALE_ALONE,
    axis_noise_share,
    stays_level,
)
from fieldcal.stages.tables import AXES

Codes = Mapping[Sensor, Collection[ReasonCode | None]]
SCHEMA: dict[str, pl.DataType | type[pl.DataType]] = {
    "place": pl.Int64,
    "sensor": pl.String,
    "parameter": pl.String,
    "axis": pl.String,
    "unit": pl.String,
    "linearised_at": pl.Float64,
    "right_side": pl.Float64,
    "information": pl.List(pl.Float64),
    "temperature_degc": pl.Float64,
    "status": pl.String,
    "reason_code": pl.String,
}


def information_of(
    fit: JointFit,
    codes: Codes,
    by_pose: Mapping[Sensor, TriadByPose | FieldcalError],
    axes: Array,
    *,
    units: Mapping[Sensor, tuple[str, str]],
    temperature_degc: float | None,
) -> pl.DataFrame:
    """Rows of a fit and of the triads that a VPS's trajectory gave.

    `codes`: why axes of the sensors that the method is chosen for are refused; others have no rows. What contradicts
    itself is refused here too, what is only uncertain is not. `axes` (3, 3) turns sensor axes into body axes; `units`:
    calibrated and logged."""
    found = observed(fit, axes)
    for sensor, triad in by_pose.items():
        if isinstance(triad, TriadByPose) and sensor in codes:
            found = beside(found.of([n for n in found.names if n[0] != sensor]), information_by_pose(triad, sensor))
    found = found.of([name for name in found.names if name[0] in codes])
    refused = _hidden(fit, codes, found.names) | _contradicted(fit, codes)
    return table_of(
        found, [refused.get(name) or refused.get((name[0], "", "")) for name in found.names], units
    ).with_columns(temperature_degc=pl.lit(temperature_degc, pl.Float64))


def _contradicted(fit: JointFit, codes: Codes) -> dict[Name, ReasonCode]:
    """Why a sensor (parameter and axis empty), or the gain of a gyroscope's axis that read little but noise, counts
    nowhere."""
    out: dict[Name, ReasonCode] = {}
    for sensor, own in codes.items():
        if (code := next((code for code in own if code is not None and code not in SCALE_ALONE), None)) is not None:
            out[sensor, "", ""] = code
    for axis, share in zip(AXES, axis_noise_share(fit), strict=True):
        if share > MAX_GYRO_NOISE_SHARE:
            out[Sensor.GYROSCOPE, GAIN, axis] = ReasonCode.AXIS_NOT_TURNED
    return out


def _hidden(fit: JointFit, codes: Codes, names: Collection[Name]) -> dict[Name, ReasonCode]:
    """Of a vehicle that stays level: what is not told as a row counts nowhere, since a tilt that nobody sees moves it
    by per cents, the same way in every such flight, which no number of them averages out."""
    if not stays_level(fit):
        return {}
    untold = {(str(sensor), axis): code for sensor, own in codes.items() for axis, code in zip(AXES, own, strict=True)}
    whole = {sensor for sensor, own in codes.items() if not any(own)}
    zero_share = dict.fromkeys(AXES, np.inf)
    if "magnetometer" in fit.layout:
        sd = np.sqrt(np.diagonal(fit.constants("magnetometer")[2])[3:])
        zero_share = dict(zip(AXES, sd / np.linalg.norm(fit.model.readings.field_ned), strict=True))
    out: dict[Name, ReasonCode] = {}
    for name in names:
        sensor, parameter, axis = name
        if parameter == GAIN:
            hidden = untold.get((sensor, axis)) is not None
        elif parameter == ZERO:
            hidden = sensor == Sensor.MAGNETOMETER and not zero_share[axis] <= MAX_LEVEL_SCALE_SD
        else:
            hidden = parameter == CROSS_AXIS and sensor not in whole
        if hidden:
            out[name] = untold.get((sensor, axis)) or ReasonCode.SCALE_UNCERTAIN
    return out


def information_by_pose(triad: TriadByPose, sensor: Sensor) -> NormalEquations:
    """Of a vector triad by a trajectory, which knew nothing beforehand: the inverse covariance."""
    cross = [(i, j) for i, j in CROSS[sensor] if triad.matrix[i, j] != 0.0]
    matrix, zero = triad.matrix, -np.linalg.solve(triad.matrix, triad.bias)
    diagonal, inverse = np.diagonal(matrix), np.linalg.inv(matrix)
    names = [(str(sensor), parameter, axis) for parameter in (GAIN, ZERO) for axis in AXES]
    names += [(str(sensor), CROSS_AXIS, AXES[i] + AXES[j]) for i, j in cross]
    jacobian = np.zeros((len(names), 12))
    for i in range(3):
        jacobian[i, 4 * i] = -1.0 / diagonal[i] ** 2
    jacobian[3:6] = -inverse @ np.hstack([np.kron(np.eye(3), zero), np.eye(3)])
    for row, (i, j) in enumerate(cross, start=6):
        jacobian[row, 3 * i + j], jacobian[row, 4 * i] = 1.0 / diagonal[i], -matrix[i, j] / diagonal[i] ** 2
    at = [0, 4, 8, 9, 10, 11, *(3 * i + j for i, j in cross)]
    covariance = jacobian[:, at] @ triad.covariance[np.ix_(at, at)] @ jacobian[:, at].T
    sd = np.sqrt(np.diagonal(covariance))
    information = np.linalg.inv(covariance / np.outer(sd, sd)) / np.outer(sd, sd)
    reference = np.r_[1.0 / diagonal, zero, [matrix[i, j] / diagonal[i] for i, j in cross]]
    return NormalEquations(tuple(names), reference, np.zeros(len(names)), information)


def beside(one: NormalEquations, other: NormalEquations) -> NormalEquations:
    """Two that know nothing of each other as one."""
    p, q = len(one.names), len(other.names)
    information = np.block([[one.information, np.zeros((p, q))], [np.zeros((q, p)), other.information]])
    reference, right = np.r_[one.reference, other.reference], np.r_[one.right, other.right]
    return NormalEquations((*one.names, *other.names), reference, right, information)


def table_of(
    found: NormalEquations, refused: Collection[ReasonCode | None], units: Mapping[Sensor, tuple[str, str]]
) -> pl.DataFrame:
    """Rows, without a temperature; `units`: calibrated and logged of each sensor."""
    triangle = found.triangle()
    rows = [
        {
            "place": place,
            "sensor": name[0],
            "parameter": name[1],
            "axis": name[2],
            "unit": _unit(name[1], *units[Sensor(name[0])]),
            "linearised_at": float(found.reference[place]),
            "right_side": float(found.right[place]),
            "information": triangle[place],
            "temperature_degc": None,
            "status": Status.OK if code is None else Status.REFUSED,
            "reason_code": code,
        }
        for place, (name, code) in enumerate(zip(found.names, refused, strict=True))
    ]
    return pl.DataFrame(rows, schema=SCHEMA)


def _unit(parameter: str, calibrated: str, logged: str) -> str:
    if parameter == GAIN:
        divisor = f"({calibrated})" if "/" in calibrated else calibrated
        return "1" if calibrated == logged else f"{logged}/{divisor}"
    of_slope = f"({logged})/degC" if "/" in logged else f"{logged}/degC"
    others = {SLOPE: of_slope, CROSS_AXIS: "1", LEVER_ARM: "m", DELAY: "s", G_SENSITIVITY: f"{logged} per m/s^2"}
    return others.get(parameter, logged)


def equations_of(rows: pl.DataFrame) -> NormalEquations:
    """Of the rows of one unit of a flight, in any order."""
    own = rows.sort("place")
    names = list(own.select("sensor", "parameter", "axis").iter_rows())
    numbers = (own["linearised_at"], own["right_side"], own["information"].explode())
    return NormalEquations.of_triangle(names, *(column.to_numpy() for column in numbers))


def kept(rows: pl.DataFrame, names: Collection[Name]) -> pl.DataFrame:
    """The rows of these parameters, whatever the others are."""
    found = equations_of(rows)
    own = [name for name in found.names if name in names]
    return rewritten(rows, found.of(own)) if len(own) < len(found.names) else rows


def rewritten(rows: pl.DataFrame, found: NormalEquations) -> pl.DataFrame:
    """Rows with the numbers of `found`, whose names are some of theirs."""
    values = {
        "place": np.arange(len(found.names)),
        "linearised_at": found.reference,
        "right_side": found.right,
    }
    names = pl.DataFrame(
        list(found.names), schema=dict.fromkeys(("sensor", "parameter", "axis"), pl.String), orient="row"
    )
    new = names.with_columns(
        **{name: pl.Series(column) for name, column in values.items()},
        information=pl.Series(found.triangle()),
    )
    same = rows.select("sensor", "parameter", "axis", "unit", "temperature_degc", "status", "reason_code")
    return new.join(same, on=["sensor", "parameter", "axis"], how="left", maintain_order="left").select(list(SCHEMA))


def of_raw(
    found: NormalEquations,
    sensor: Sensor,
    matrix: Array,
    offset: Array,
    per_degc: Array,
    matrix_sd: float,
    offset_sd: Array,
) -> NormalEquations:
    """Of the raw sensor, whose readings an autopilot had made logged = matrix · raw + offset (3,), which follows the
    temperature by `per_degc` (3,); each known to an sd."""
    at = {name[1:]: place for place, name in enumerate(found.names) if name[0] == sensor}
    inverse, mix = np.linalg.inv(matrix), np.eye(3)
    crosses = {(i, j): at.get((CROSS_AXIS, AXES[i] + AXES[j])) for i, j in CROSS[sensor]}
    crossed = [(i, j, place) for (i, j), place in crosses.items() if place is not None]
    for i, j, place in crossed:
        mix[i, j] = found.reference[place]
    product = mix @ matrix
    value, jacobian = found.reference.copy(), np.eye(len(found.names))
    doubt = np.zeros(len(found.names))
    for parameter, shift, sd in ((ZERO, offset, offset_sd), (SLOPE, per_degc, np.zeros(3))):
        if (parameter, "x") in at:
            three = [at[parameter, axis] for axis in AXES]
            value[three] = inverse @ (found.reference[three] - shift)
            jacobian[np.ix_(three, three)] = inverse
            doubt[three] = inverse**2 @ sd**2
    if (G_SENSITIVITY, "xx") in at:
        nine = [at[G_SENSITIVITY, a + b] for a in AXES for b in AXES]
        jacobian[np.ix_(nine, nine)] = np.kron(inverse, np.eye(3))
        value[nine] = jacobian[np.ix_(nine, nine)] @ found.reference[nine]
    for i, axis in enumerate(AXES):
        gain, own = at[GAIN, axis], product[i, i]
        value[gain], jacobian[gain, gain] = found.reference[gain] / own, 1.0 / own
        doubt[gain] = (value[gain] * matrix_sd) ** 2
        for j in (j for k, j, _ in crossed if k == i):
            jacobian[gain, at[CROSS_AXIS, axis + AXES[j]]] = -found.reference[gain] * matrix[j, i] / own**2
    for i, j, place in crossed:
        value[place] = product[i, j] / product[i, i]
        doubt[place] = matrix_sd**2
        for k, other in ((k, p) for n, k, p in crossed if n == i):
            jacobian[place, other] = matrix[k, j] / product[i, i] - product[i, j] * matrix[k, i] / product[i, i] ** 2
    changed = found.as_function(found.names, value, jacobian)
    return changed.doubted(np.diag(doubt)) if doubt.any() else changed
