"""Which estimates of a flight count: between the methods for each sensor, and against the VPS."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import polars as pl

from fieldcal.estimation.smoothing import low_pass
from fieldcal.estimation.statistics import least_squares_covariance
from fieldcal.geometry import sensor_model
from fieldcal.geometry.rotation import Array
from fieldcal.names import JOINT_METHODS, SENSORS, Approach, Json, Method, Sensor, Status
from fieldcal.reason_codes import ReasonCode
from fieldcal.stages.beside.motor_field import allow_for_motor_field
from fieldcal.stages.inputs import Tables
from fieldcal.stages.joint.judgement import LARGEST_PRIOR_DISTANCE_SD
from fieldcal.stages.results import StageResult, fatal_fault
from fieldcal.stages.tables import AXES, calibration_rows, constants, matrix, seconds, triad
from fieldcal.stages.vps import RATE_COLUMNS, bridged

if TYPE_CHECKING:
    from fieldcal.config.stage_settings import ChoiceSettings

# The joint estimate gives way only where its gyroscope drifts from the VPS by more than this times what the serial
# chain's does.
LARGEST_DRIFT_RATIO = 1.5
# Scales against those that the VPS's rates show: so many sd off, and by at least this share, they contradict it.
CONTRADICTED_SD, CONTRADICTED_SHARE = 5.0, 0.03
# Low-pass of both sides' rates, Hz and s on either side: a VPS that smooths shows faster turns too small. Then it is
# nothing from f_c + π/side, 1.5 Hz, on: so many rows a second are enough.
CUTOFF_HZ, SIDE_S, RATE_HZ = 0.7, 4.0, 15.0


def choose(tables: Tables, s: ChoiceSettings) -> StageResult:
    """Every method's constants, fit, VPS → calibration: all rows, those that do not count refused with the reason."""
    parts = [tables[name] for name in ("vectors", "gyroscope", "joint") if name in tables]
    if not parts:
        return StageResult(
            status=Status.REFUSED, reason_code=ReasonCode.NOTHING_CALIBRATED, reason="No method gave constants."
        )
    rows = _with_motor_field(pl.concat(parts), tables.get("motor_faults"), float(np.linalg.norm(s.field_ned)))
    measured: dict[str, Json] = {}
    rows = _implausible(rows, s)
    for name in ("vps_faults", "joint_faults"):
        rows = _of_wrong_clocks(rows, tables.get(name))
    against = _contradicted(rows, tables, s)
    measured["scale_by_vps"] = {method: [list(pair) for pair in pairs] for method, pairs in against.items()}
    for method, pairs in against.items():
        scales = rows.filter(sensor=Sensor.GYROSCOPE, method=method, parameter="scale", status=str(Status.OK))
        published = set(scales["axis"].to_list())
        axes = [axis for axis, (off, sd) in zip(AXES, pairs, strict=True) if _off(off, sd) and axis in published]
        if axes:
            rows = _refused(rows, Sensor.GYROSCOPE, [method], axes, ReasonCode.VPS_CONTRADICTS)
    contradictions = tables.get("joint_faults")
    chosen: dict[str, Json] = {}
    for sensor in SENSORS:
        if s.method[sensor] != Approach.AUTO:
            continue
        own = rows.filter(sensor=sensor, parameter="scale")
        methods = own["method"].unique().to_list()
        if not set(JOINT_METHODS) & set(methods):
            chosen[sensor] = Approach.SERIAL
            fault = None if contradictions is None else fatal_fault(contradictions, (sensor,))
            if fault is not None:
                rows = _refused(rows, sensor, methods, None, ReasonCode(fault["reason_code"]))
                chosen[sensor] = None
            continue
        serial = [name for name in methods if name not in JOINT_METHODS]
        if sensor == Sensor.GYROSCOPE and _joint_drifts(rows, tables):
            rows = _refused(rows, sensor, [Method.JOINT], None, ReasonCode.OTHER_METHOD_CHOSEN)
            chosen[sensor] = Approach.SERIAL
        else:
            rows = _refused(rows, sensor, serial, None, ReasonCode.OTHER_METHOD_CHOSEN)
            chosen[sensor] = Approach.JOINT
    measured["chosen"] = chosen
    return StageResult({"calibration": rows}, measured=measured)


def _implausible(rows: pl.DataFrame, s: ChoiceSettings) -> pl.DataFrame:
    """Every method's gyroscope or accelerometer refused whose scale is further from the logged unit's than any part is
    made: a fit that went wrong somewhere is not right along the other axes."""
    for sensor in (Sensor.GYROSCOPE, Sensor.ACCELEROMETER):
        nominal = s.nominal_scale[sensor]
        if nominal is None:
            continue
        scales = rows.filter(sensor=sensor, parameter="scale").filter(pl.col("axis").is_in(AXES))
        for (method,), own in scales.partition_by("method", as_dict=True).items():
            size = np.abs([nominal[AXES.index(axis)] for axis in own["axis"]])
            off = np.abs(np.abs(own["value"].to_numpy() / size) - 1.0)
            if np.any(off > LARGEST_PRIOR_DISTANCE_SD * (s.prior_scale_sd + own["sd"].to_numpy() / size)):
                rows = _refused(rows, sensor, [str(method)], None, ReasonCode.PRIOR_CONTRADICTED)
    return rows


def _of_wrong_clocks(rows: pl.DataFrame, faults: pl.DataFrame | None) -> pl.DataFrame:
    """Every method's gyroscope refused where the VPS shows that the stamps are not seconds."""
    code = ReasonCode.CLOCK_RATES_DIFFER
    if faults is None or faults.filter(reason_code=str(code)).is_empty():
        return rows
    return _refused(rows, Sensor.GYROSCOPE, rows["method"].unique().to_list(), None, code)


def _with_motor_field(rows: pl.DataFrame, faults: pl.DataFrame | None, strength: float) -> pl.DataFrame:
    """The joint magnetometer's rows with what the motors may have spoilt; the ellipsoid's have it already."""
    found = None if faults is None else faults.filter(reason_code=str(ReasonCode.MOTOR_FIELD))
    if found is None or found.is_empty():
        return rows
    own = (pl.col("sensor") == Sensor.MAGNETOMETER) & pl.col("method").is_in(JOINT_METHODS)
    widened = allow_for_motor_field(rows.filter(own), float(found["number"][0]), strength)
    return pl.concat([rows.filter(~own), widened])


def _refused(
    rows: pl.DataFrame, sensor: Sensor, methods: list[str], axes: list[str] | None, code: ReasonCode
) -> pl.DataFrame:
    """Rows with those of a sensor's methods (of these axes) refused; those refused already keep their own reason."""
    which = (pl.col("sensor") == sensor) & pl.col("method").is_in(methods) & (pl.col("status") == Status.OK)
    if axes is not None:
        which &= pl.col("axis").str.slice(0, 1).is_in(axes)
    return rows.with_columns(
        status=pl.when(which).then(pl.lit(str(Status.REFUSED))).otherwise(pl.col("status")),
        reason_code=pl.when(which).then(pl.lit(str(code))).otherwise(pl.col("reason_code")),
    ).select(calibration_rows([]).columns)


def _joint_drifts(rows: pl.DataFrame, tables: Tables) -> bool:
    """Whether the VPS speaks for the serial gyroscope against the joint one, both of them published."""
    published = rows.filter(sensor=Sensor.GYROSCOPE, status=str(Status.OK))["method"].to_list()
    if "fit" not in tables or Method.OUTPUT_ERROR not in published or Method.JOINT not in published:
        return False
    drift = tables["fit"].filter(quantity="attitude_propagated", reference="vps", signal="raw", sample="all")
    rms = dict(drift.select("method", "rms").iter_rows())
    joint, serial = rms.get(Method.JOINT), rms.get(Method.OUTPUT_ERROR)
    return joint is not None and serial is not None and joint > LARGEST_DRIFT_RATIO * serial


def _off(off: float, sd: float) -> bool:
    return abs(off) > max(CONTRADICTED_SD * sd, CONTRADICTED_SHARE)


def _contradicted(rows: pl.DataFrame, tables: Tables, s: ChoiceSettings) -> dict[str, list[tuple[float, float]]]:
    """Of each method's gyroscope, by axis: relative error of the scale by the VPS's rates, and its sd with the
    constant's own. Nothing without a VPS."""
    vps, samples = tables.get("vps_aligned"), tables.get("samples")
    if vps is None or samples is None or len(vps) < 100:
        return {}
    out = {}
    axes = sensor_model.frd_from_sensor(s.rotation_body_from_sensor, s.body)
    origin = int(samples["t_ns"][0])
    t, at = seconds(samples["t_ns"], origin), seconds(vps["t_ns"], origin)
    near = bridged(t, at)
    interval_s = float(np.median(np.diff(at)))
    thinned = np.flatnonzero(near)[:: max(1, int(1.0 / (RATE_HZ * interval_s)))]
    reference = low_pass(matrix(vps, RATE_COLUMNS) @ axes, CUTOFF_HZ, interval_s, side_s=SIDE_S)[thinned]
    for method in rows.filter(sensor=Sensor.GYROSCOPE)["method"].unique().to_list():
        found = constants(rows, Sensor.GYROSCOPE, Method(method), refused_too=True)
        if found is None or not np.isfinite(found[0]).all():
            continue
        rate = sensor_model.calibrate(matrix(samples, triad("gyroscope")), *found)
        own = low_pass(np.column_stack([np.interp(at, t, c) for c in rate.T]), CUTOFF_HZ, interval_s, side_s=SIDE_S)
        scale = rows.filter(sensor=Sensor.GYROSCOPE, method=method, parameter="scale")
        relative = {row["axis"]: (row["sd"] or np.inf) / abs(row["value"]) for row in scale.iter_rows(named=True)}
        out[str(method)] = [
            (off, float(np.hypot(sd, relative.get(axis, np.inf))))
            for axis, (off, sd) in zip(AXES, _slopes(own[thinned], reference), strict=True)
        ]
    return out


def _slopes(own: Array, reference: Array) -> list[tuple[float, float]]:
    """Own rates on the reference's, axis by axis beside the other two and a constant: slope less 1, and its sd."""
    x = np.column_stack([reference, np.ones(len(reference))])
    out = []
    for i in range(3):
        solution = np.linalg.lstsq(x, own[:, i], rcond=None)[0]
        residual = own[:, i] - x @ solution
        _, covariance = least_squares_covariance(x[:, None, :], residual[:, None])
        out.append((float(solution[i] - 1.0), float(np.sqrt(max(covariance[i, i], 0.0)))))
    return out
