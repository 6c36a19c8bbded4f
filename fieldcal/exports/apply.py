"""`fieldcal apply`: a log's readings through the constants its vehicle flies with. The log is only read."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import polars as pl

from fieldcal.config.configuration import Vehicle
from fieldcal.config.flight_settings import FlightSettings
from fieldcal.errors import FieldcalError
from fieldcal.exports.calibrated_files import TABLE_OF, write_calibrated
from fieldcal.exports.calibration import Constants, Triad
from fieldcal.geometry.rotation import Array
from fieldcal.logs import ingest
from fieldcal.logs.facts import Facts
from fieldcal.names import INERTIAL_FIRST, Sensor, Verdict
from fieldcal.reason_codes import ReasonCode
from fieldcal.stages.tables import matrix, triad


@dataclass(frozen=True)
class CalibratedReadings:
    """Readings of a log put through constants, and what was known for it.

    Attributes
    ----------
    readings : dict of str to (array, array)
        Sensor → stamps (n,) int64 ns on the log's own clock, and z (n, 3) in the unit of its constants, sensor axes as
        logged, gravity sign as declared.
    temperature : DataFrame or None
        The log's temperatures, °C, where each sample's own was followed.
    settings : FlightSettings
        The flight's settings: axes, signs, units.
    constants : Constants
        What was applied.
    warnings : tuple of str
        Sensors that were left out, and temperatures beyond those flown.

    Examples
    --------
    >>> import tempfile
    >>> import fieldcal
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     log = fieldcal.write_flights(folder, fieldcal.Experiment(duration_s=20.0))[0]
    ...     calibrated = fieldcal.apply(log, fieldcal.calibrate(log))
    ...     written, _ = calibrated.write(f"{folder}/calibrated.mcap")
    >>> t_ns, z = calibrated.readings["magnetometer"]
    >>> z.shape, calibrated.constants.triads["magnetometer"].unit, [path.name for path in written]
    ((3700, 3), 'norm', ['calibrated.mcap'])
    """

    readings: dict[str, tuple[np.ndarray, Array]]
    temperature: pl.DataFrame | None
    settings: FlightSettings
    constants: Constants
    warnings: tuple[str, ...]

    def write(self, output: Path | str) -> tuple[list[Path], tuple[str, ...]]:
        """Write the readings, whatever the log's own format; the files, and what the format cannot say.

        Parameters
        ----------
        output : Path or str
            ``NAME.mcap``: one file of ROS 2 Imu and MagneticField in body axes (REP-103). ``NAME.csv``,
            ``NAME.parquet``: one table, a row a stamp, in the sensor axes as logged. A name without an ending: a folder
            for imu.parquet and magnetometer.parquet, as the signals of a warehouse.

        Raises
        ------
        FieldcalError
            `wrong_option`: the name has another ending.
        """
        return write_calibrated(self, Path(output))


def apply_constants(
    log: str,
    vehicle: Vehicle,
    signals: Mapping[str, pl.DataFrame],
    facts: Facts,
    constants: Constants,
    *,
    follow_temperature: bool,
) -> CalibratedReadings:
    """Calibrate the readings of a log, called `log` in messages, as `ingest.read_flight` gives them: at the constants'
    temperature, or at each sample's own where the log has temperatures.

    Raises
    ------
    FieldcalError
        `no_calibration`; `unit_mismatch`: the log's readings are in another unit than the constants; `not_usable`:
        nothing can be read.
    """
    if not Verdict(facts["verdict"]).usable:
        raise FieldcalError(ReasonCode.NOT_USABLE, f"{log}: {facts['reason']}")
    settings = ingest.settings_of(facts, vehicle)
    temperature = signals.get("temperature") if follow_temperature else None
    readings: dict[str, tuple[np.ndarray, Array]] = {}
    warnings: list[str] = []
    for name in INERTIAL_FIRST:
        table = signals.get(TABLE_OF[name])
        if table is None or table.is_empty() or table[f"{name}_x"].null_count() == table.height:
            continue
        constant = constants.triads.get(name)
        if constant is None:
            warnings.append(f"{name}: no constants, so it is left out.")
            continue
        if constant.logged_unit != settings.units[name]:
            raise FieldcalError(
                ReasonCode.UNIT_MISMATCH,
                f"{log}: the {name} is in {settings.units[name]}, the constants are for {constant.logged_unit};"
                " give the vehicle whose log this is (--vehicle), or its units in fieldcal.toml.",
            )
        t_ns = table["t_ns"].to_numpy()
        raw = raw_readings(matrix(table, triad(name)), Sensor(name), settings)
        readings[name] = t_ns, constant.apply(raw, _temperature_at(t_ns, temperature))
        warnings += _outside(name, constant, temperature)
    if not readings:
        raise FieldcalError(ReasonCode.NO_CALIBRATION, f"{log}: no sensor of this log has constants.")
    return CalibratedReadings(readings, signals.get("temperature"), settings, constants, tuple(warnings))


def raw_readings(logged: Array, sensor: Sensor, settings: FlightSettings) -> Array:
    """Readings (n, 3) as the sensor gave them, in the axes of the logged ones: what an autopilot had done to them by
    its parameters is undone."""
    p, o = settings.applied_matrix[sensor], settings.applied_offset[sensor]
    return logged if p is None or o is None else np.linalg.solve(np.array(p), (logged - np.array(o)).T).T


def _temperature_at(t_ns: np.ndarray, temperature: pl.DataFrame | None) -> Array | None:
    if temperature is None or temperature.is_empty():
        return None
    known = temperature.filter(pl.col("temperature_degc").is_finite())
    if known.is_empty():
        return None
    origin = int(known["t_ns"][0])
    seconds = (t_ns - origin) * 1e-9
    return np.interp(seconds, (known["t_ns"].to_numpy() - origin) * 1e-9, known["temperature_degc"].to_numpy())


def _outside(name: str, constant: Triad, temperature: pl.DataFrame | None) -> list[str]:
    """A warning where the log is colder or warmer than what the slopes were found on."""
    if temperature is None or constant.flown_degc is None or temperature.is_empty():
        return []
    known = temperature["temperature_degc"].drop_nulls().to_numpy()
    if len(known) == 0 or (known.min() >= constant.flown_degc[0] and known.max() <= constant.flown_degc[1]):
        return []
    low, high = known.min(), known.max()
    return [
        f"{name}: {low:.1f} to {high:.1f} °C goes beyond the {constant.flown_degc[0]:.1f} to"
        f" {constant.flown_degc[1]:.1f} °C flown."
    ]
