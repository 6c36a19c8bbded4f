"""`fieldcal.calibrate`: one flight's constants, typed, with what refused them and how well they agree."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import polars as pl

from fieldcal.api.estimate import Estimate
from fieldcal.api.recording import Recording, as_recording
from fieldcal.api.sensor import SensorCalibration, not_calibrated, sensor_calibration
from fieldcal.api.vps_clock import Rates, VpsClock
from fieldcal.errors import Refused
from fieldcal.exports.calibration import Constants, Origin, Triad
from fieldcal.exports.flights import origin_of
from fieldcal.flight.calibrate import CalibratedLog, LogRead, identify, overruled, read, run_stages
from fieldcal.flight.rows import rows_frame
from fieldcal.geometry import sensor_model
from fieldcal.logs.on_board import PRIMARY
from fieldcal.names import JOINT_METHODS, SENSORS, Approach, Json, exactness
from fieldcal.reason_codes import ReasonCode
from fieldcal.remote.places import log_at
from fieldcal.schemas.rows import FlightDocument, Refusable, SyncRow
from fieldcal.stages.composition import ORIGIN, in_log
from fieldcal.stages.tables import matrix, seconds
from fieldcal.stages.vps import RATE_COLUMNS
from fieldcal.words.flights import is_consequence
from fieldcal.words.rows import standing

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from fieldcal.plots.calibration import SensorPlot

STAGES = {
    "magnetometer": ("magnetometer", "vectors"),
    "accelerometer": ("accelerometer_pass2", "vectors"),
    "gyroscope": ("gyro_output", "gyro_equation_pass2"),
}
"""Whose word it is, for the methods that estimate one step after the other."""


@dataclass(frozen=True)
class StageRun:
    """How one stage ended.

    Attributes
    ----------
    stage : str
    status : {"ok", "refused", "absent", "failed"}
        "refused": the recording does not determine it. "absent": there is nothing to do. "failed": an error of
        fieldcal's own.
    reason_code, reason : str or None
        Why it did not end well.
    measured : dict
        The numbers that decided, plain values.

    Examples
    --------
    >>> StageRun("vps_sync", "absent", "no_vps", "The log has no VPS.", {}).status
    'absent'
    """

    stage: str
    status: str
    reason_code: str | None
    reason: str | None
    measured: Mapping[str, Json]


@dataclass(frozen=True)
class Calibration:
    """One flight calibrated.

    ``calibration.gyroscope.scale.value`` is an array, or raises `Refused` with the reason. Of several methods the most
    exact that was not refused speaks for a sensor; `sensor` asks for a certain one.

    Attributes
    ----------
    recording : Recording
        What was calibrated.
    verdict : {"ok", "partial", "no_result", "quarantined", "rejected"}
        The recording's; "partial" also where a stage failed, "no_result" where no constant came out of it.
    reason : str or None
        Why it is not "ok".
    rows : DataFrame
        Table `calibration`: all methods, parameters and axes, refused ones too, with status and reason code.
    fits : DataFrame
        Table `fit`: Theil's inequality coefficient (Eq. 16) and rms error of each comparison.
    sync : VpsClock or None
        The VPS's clock; None without a VPS.
    runs : tuple of StageRun
        How each stage ended, in order.
    document : dict
        All of it as `fieldcal calibrate --json` prints it.

    Examples
    --------
    >>> import tempfile
    >>> import fieldcal
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     log = fieldcal.write_flights(folder, fieldcal.Experiment(duration_s=20.0))[0]
    ...     calibration = fieldcal.calibrate(log)
    >>> calibration.verdict, calibration.methods("gyroscope")
    ('ok', ('joint', 'output_error', 'equation_error'))
    >>> scale = calibration.magnetometer.scale
    >>> scale.value.shape, scale.unit, bool((scale.sd < 0.05 * abs(scale.value)).all())
    ((3,), 'norm/counts', True)
    """

    recording: Recording
    verdict: str
    reason: str | None
    rows: pl.DataFrame = field(repr=False)
    fits: pl.DataFrame = field(repr=False)
    sync: VpsClock | None
    runs: tuple[StageRun, ...] = field(repr=False)
    _log: CalibratedLog = field(repr=False)

    @property
    def document(self) -> FlightDocument:
        """Flight, calibration, fit, sync and run, named as the columns of those tables."""
        return self._log.document

    @property
    def magnetometer(self) -> SensorCalibration:
        """The magnetometer's constants."""
        return self.sensor("magnetometer")

    @property
    def accelerometer(self) -> SensorCalibration:
        """The accelerometer's constants."""
        return self.sensor("accelerometer")

    @property
    def gyroscope(self) -> SensorCalibration:
        """The gyroscope's constants."""
        return self.sensor("gyroscope")

    def methods(self, sensor: str) -> tuple[str, ...]:
        """Methods that have numbers for a sensor, refused ones too, the most exact first."""
        scales = self.rows.filter(pl.col("sensor") == sensor, pl.col("parameter") == "scale")
        found = scales["method"].unique().to_list()
        return tuple(sorted(found, key=lambda name: (exactness(name), name)))

    def sensor(self, sensor: str, method: str | None = None) -> SensorCalibration:
        """A sensor's constants by `method`, else by the most exact that was not refused.

        They hold for the readings as they were logged; where an autopilot had corrected those, `rows` and `constants`
        have the raw sensor's. Those of a method that is asked for by name are not refused for another's being chosen. A
        sensor that no method found numbers for is there too: its values raise `Refused` with the reason.

        Raises
        ------
        ValueError
            There is no such sensor, or the method has no numbers for it; those that have are named.
        """
        if sensor not in SENSORS:
            raise ValueError(f"sensor is one of {', '.join(SENSORS)}, not {sensor!r}")
        methods = self.methods(sensor)
        if method is not None and method not in methods:
            raise ValueError(f"no {method!r} for the {sensor}; there is: {', '.join(methods) or 'none'}")
        if method is not None:
            return self._by(sensor, method, by_name=True)
        found = [self._by(sensor, name) for name in methods]
        if not found:
            return not_calibrated(sensor, *self._why_none(sensor))
        return next((own for own in found if own.ok), found[0])

    def constants(self) -> Constants:
        """What to fly with after this flight alone: the sensors that were not refused, as of its temperature.

        `Warehouse.calibration_at` knows more: the trend over many flights.

        Raises
        ------
        Refused
            No sensor has constants; the first one's reason is told.
        """
        own = [self._of_raw(self.sensor(name)) for name in SENSORS]
        flight = self.document["flight"]
        triads = {s.sensor: s.triad(f"flight {flight['flight_id']}, {s.method}") for s in own if s.ok}
        if not triads:
            raise Refused(
                ReasonCode(own[0].scale.reason_code or ReasonCode.NO_CALIBRATION),
                f"No sensor has constants. {own[0].reason}",
            )
        started = flight["started_at"]
        as_of = "" if started is None else started.isoformat()
        ids = {row["sensor"]: row["unit_id"] for row in self.document["calibration"] if row["sensor"] in triads}
        rate_hz = flight["imu_rate_hz"]
        return Constants(
            flight["vehicle_id"], flight["imu_id"], triads, as_of, ids, self._origins(triads), imu_rate_hz=rate_hz
        )

    def report(self, path: Path | str) -> Path:
        """Write the flight's report, one HTML file that needs no network."""
        from fieldcal.report import log_report

        return log_report(self._log, Path(path))

    def plot(self) -> list[Axes]:
        """What the constants make of the readings, and how sure each method is of them: a column a sensor.

        Above: the calibrated vector's length against the local field or gravity, and the calibrated rates beside the
        VPS's. Below: each method's scale against the one in use, ±1 sd. Refused fits are shown as such.
        """
        from fieldcal.plots.calibration import plot_calibration

        flight = self.document["flight"]
        return plot_calibration([self._shown(s) for s in SENSORS], f"{flight['log_uri']}: {self.verdict}")

    def _origins(self, triads: Mapping[str, Triad]) -> dict[str, Origin]:
        """Where the readings of sensors came from, as stage `composition` was told."""
        measured = next((run.measured for run in self.runs if run.stage == "composition"), {})
        told = measured.get(ORIGIN)
        if not isinstance(told, Mapping):
            return {}
        return {name: origin_of(told, name, triad.temperature_degc) for name, triad in triads.items()}

    def _of_raw(self, own: SensorCalibration) -> SensorCalibration:
        """The same method's constants of the raw sensor, where an autopilot had corrected what it logged."""
        if own.method is None:
            return own
        rows = self.rows.filter(pl.col("sensor") == own.sensor, pl.col("method") == own.method)
        return sensor_calibration(rows, own.sensor, own.method, own.reason)

    def _by(self, sensor: str, method: str, *, by_name: bool = False) -> SensorCalibration:
        rows = in_log(self.rows.filter(pl.col("sensor") == sensor, pl.col("method") == method))
        if by_name:
            passed_over = pl.col("reason_code") == ReasonCode.OTHER_METHOD_CHOSEN
            rows = rows.with_columns(
                status=pl.when(passed_over).then(pl.lit("ok")).otherwise("status"),
                reason_code=pl.when(passed_over).then(None).otherwise("reason_code"),
            )
        refused = rows.filter(pl.col("status") != "ok")
        reason = None if refused.is_empty() else self._why(sensor, method, refused["reason_code"][0])
        return sensor_calibration(rows, sensor, method, reason)

    def _why(self, sensor: str, method: str, code: str | None) -> str:
        """The sentence behind a refused row's code: of the stage that wrote it, else of any that has this code."""
        names = ("joint",) if method in JOINT_METHODS else STAGES[sensor]
        own = [run for run in self.runs if run.stage in names and run.reason]
        same = [run for run in (*own, *self.runs) if run.reason_code == code and run.reason]
        return str(next((run.reason for run in (*same, *own)), f"reason code {code}."))

    def _why_none(self, sensor: str) -> tuple[str, str]:
        """Code and sentence for a sensor without numbers: the stage that had nothing to go on, or what it lacked."""
        stopped = [run for run in self.runs if run.status in ("refused", "failed")]
        causes = [run for run in stopped if not is_consequence(_refusable(run))]
        own = [run for run in causes if run.stage in STAGES[sensor]]
        for run in (*own, *causes):
            return run.reason_code or "refused", run.reason or f"stage {run.stage} ended {run.status}."
        return "not_calibrated", f"no stage calibrated the {sensor}."

    def _shown(self, sensor: str) -> SensorPlot:
        from fieldcal.plots.calibration import SensorPlot

        own = self.sensor(sensor)
        scales = [(name, self._by(sensor, name).scale) for name in self.methods(sensor)]
        rates = self._rates() if sensor == "gyroscope" else None
        t = z = None
        if rates is not None:
            t, z = rates
        elif own.method is not None and sensor != "gyroscope":
            t, logged = self.recording.readings(sensor)
            z = sensor_model.calibrate(logged, own.scale.refused_value(), own.bias.refused_value())
        length = None
        if sensor != "gyroscope" and self._log.settings:
            s = self._log.settings
            length = float(np.linalg.norm(s.field_ned)) if sensor == "magnetometer" else float(s.gravity_mps2)
        return SensorPlot(
            sensor=sensor,
            unit=own.bias.unit,
            t=t,
            z=z,
            length=length,
            vps=self._vps_rates() if sensor == "gyroscope" else None,
            scales=[
                (name, _diagonal(scale.refused_value()), _diagonal(scale.sd), _standing(scale))
                for name, scale in scales
            ],
            used=own.method,
            refused=own.reason,
        )

    @property
    def nominal_scale(self) -> dict[str, tuple[float, float, float]]:
        """Scale of each sensor's data sheet, by axis, where it is known: 1 where the log is in physical units.

        Examples
        --------
        >>> fieldcal.calibrate(log).nominal_scale  # doctest: +SKIP
        {'accelerometer': (1.0, 1.0, 1.0), 'gyroscope': (1.0, 1.0, 1.0)}
        """
        known = {} if self._log.settings is None else self._log.settings.nominal_scale
        return {str(sensor): own for sensor, own in known.items() if own is not None}

    def _rates(self) -> Rates | None:
        """Calibrated gyroscope in body axes, refused or not; None without numbers."""
        own = self.gyroscope
        s = self._log.settings
        if own.method is None or s is None:
            return None
        t, logged = self.recording.readings("gyroscope")
        axes = sensor_model.frd_from_sensor(s.rotation_body_from_sensor, s.body)
        z = sensor_model.calibrate(logged, own.scale.refused_value(), own.bias.refused_value())
        return t, z @ axes.T

    def _vps_rates(self) -> Rates | None:
        table = self._log.tables.get("vps_sync.vps_aligned")
        if table is None or table.is_empty():
            return None
        origin = int(self._log.tables["ingest.imu"]["t_ns"][0])
        return seconds(table["t_ns"], origin), matrix(table, RATE_COLUMNS)


def calibrate(
    log: Recording | Path | str,
    *,
    method: str | None = None,
    profile: str | None = None,
    parameters: Mapping[str, float | bool | str] | None = None,
    config: Path | str | None = None,
    vehicle: str | None = None,
    unit: str = PRIMARY,
) -> Calibration:
    """Calibrate the inertial sensors of one flight. Nothing is stored.

    The whole pipeline runs in memory on one thread: manoeuvres are found, readings smoothed, each vector triad's
    ellipsoid fitted (Eq. 5–8), the attitude estimated from both vectors, the gyroscope fitted to it (Eq. 10–15), the
    VPS's clock put on the IMU's, and all compared (Eq. 16). Results are those of a night.

    Parameters
    ----------
    log : Recording, Path or str
        A recording, or the path of a log as `read_log` takes it.
    method : {"auto", "serial", "joint"}, optional
        One step after the other, or all triads and the attitude in one likelihood; else what the configuration says.
    profile : {"full", "onboard", "paper"}, optional
        Presets of the stages.
    parameters : mapping, optional
        Stage parameters to overrule, by the names of fieldcal.toml.
    config, vehicle : optional
        As in `read_log`; with a recording they are its own.
    unit : str
        Which of several units on board, by the signal its readings are in: "imu" is the primary IMU and magnetometer,
        "imu.1" a further IMU (with the primary magnetometer), "magnetometer.1" a further magnetometer (with the primary
        IMU).

    Returns
    -------
    Calibration

    Raises
    ------
    ConfigurationError
        A wrong configuration, or an unknown parameter: the nearest known one is named.
    FieldcalError
        `not_found`, `not_readable`: there is no such log. `wrong_option`: there is no such unit in it.
    ValueError
        Unknown method; `config` or `vehicle` beside a recording.

    Notes
    -----
    What the flight does not determine is no exception here: its status says so, and asking for its value raises
    `Refused`. Polarity, local field and units are taken from the configuration or the log; nothing can check them.

    References
    ----------
    Grauer et al., AIAA 2009-2064.

    Examples
    --------
    >>> import tempfile
    >>> import fieldcal
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     log = fieldcal.write_flights(folder, fieldcal.Experiment(duration_s=20.0))[0]
    ...     calibration = fieldcal.calibrate(log, parameters={"smoothing_cutoff_hz": 5.0})
    >>> calibration.gyroscope.scale.value
    array([-0.00022..., 0.00028..., 0.00037...])
    >>> calibration.gyroscope.scale.unit
    'rad/s/counts'
    """
    if method not in (None, *Approach):
        raise ValueError(f"method is one of {', '.join(Approach)}, not {method!r}")
    changes = {name: _text(value) for name, value in (parameters or {}).items()}
    if isinstance(log, Recording):
        own = as_recording(log, config, vehicle).source
        wanted = overruled(own.vehicle, profile=profile, method=method, changes=changes)
        return _calibration(replace(own, vehicle=wanted), unit)
    job, configured = identify(log_at(log), None if config is None else Path(config), vehicle_id=vehicle)
    return _calibration(read(job, overruled(configured, profile=profile, method=method, changes=changes)), unit)


def _calibration(log: LogRead, unit: str) -> Calibration:
    result = run_stages(log, unit)
    document = result.document
    runs = tuple(
        StageRun(
            run["stage"],
            run["status"],
            run["reason_code"],
            _sentence(run["measured"].get("reason")),
            {name: number for name, number in run["measured"].items() if name != "reason"},
        )
        for run in document["run"]
    )
    flight, calibrations = document["flight"], rows_frame("calibration", document["calibration"])
    without = Calibration(
        Recording.of(log),
        flight["verdict"],
        flight["reason"],
        calibrations,
        rows_frame("fit", document["fit"]),
        None,
        runs,
        result,
    )
    return without if document["sync"] is None else _with_clock(without, document["sync"])


def _with_clock(c: Calibration, row: SyncRow) -> Calibration:
    run = next(run for run in c.runs if run.stage == "vps_sync")
    imu, vps = c._rates(), c._vps_rates()
    clock = VpsClock(
        row["status"],
        run.reason_code,
        run.reason,
        row["peak"],
        row["runner_up"],
        row,
        None if imu is None or vps is None else (imu, vps),
    )
    return replace(c, sync=clock)


def _refusable(run: StageRun) -> Refusable:
    return {"stage": run.stage, "reason_code": run.reason_code, "status": run.status}


def _sentence(told: Json) -> str | None:
    return None if told is None else str(told)


def _standing(scale: Estimate) -> str:
    """In two words: no code of a refusal has room in a picture."""
    return "ok" if scale.ok else standing("refused", scale.reason_code).partition(":")[0]


def _diagonal(x: np.ndarray) -> np.ndarray:
    return np.diagonal(x).copy() if x.ndim == 2 else x


def _text(value: float | bool | str) -> str:
    """A parameter as the command line takes it."""
    return str(value).lower() if isinstance(value, bool) else str(value)
