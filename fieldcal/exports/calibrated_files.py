"""Calibrated readings as files, by the ending of their name: MCAP for ROS, CSV or Parquet in one table, a folder of
Parquet as a warehouse keeps signals."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import polars as pl

from fieldcal.errors import FieldcalError
from fieldcal.geometry import sensor_model
from fieldcal.geometry.earth_field import UNIT_IN_TESLA
from fieldcal.geometry.frames import FRD_FROM_FLU
from fieldcal.logs.mcap.write import imu_channel, magnetic_field_channel, temperature_channel, write_mcap
from fieldcal.names import INERTIAL_FIRST, Sensor
from fieldcal.reason_codes import ReasonCode
from fieldcal.stages.tables import columns_of, triad
from fieldcal.warehouse.errors import disk
from fieldcal.warehouse.files import make_folder, write_bytes
from fieldcal.warehouse.store import TableWriter, write_frame

if TYPE_CHECKING:
    from fieldcal.exports.apply import CalibratedReadings

TABLE_OF: dict[str, str] = {Sensor.GYROSCOPE: "imu", Sensor.ACCELEROMETER: "imu", Sensor.MAGNETOMETER: "magnetometer"}
FLU_FROM_FRD = FRD_FROM_FLU.T
SPECIFIC_FORCE = {"gravity": -1.0, "specific_force": 1.0}
TEMPERATURE = "temperature_degc"
CSV_NAMES = {
    **{f"gyroscope_{axis}": f"g{axis}" for axis in "xyz"},
    **{f"accelerometer_{axis}": f"a{axis}" for axis in "xyz"},
    **{f"magnetometer_{axis}": f"m{axis}" for axis in "xyz"},
    TEMPERATURE: "temp",
}
"""Columns as fieldcal reads them without a configuration."""


def write_calibrated(c: CalibratedReadings, place: Path) -> tuple[list[Path], tuple[str, ...]]:
    """The files that were written, and what their format cannot say.

    Raises
    ------
    FieldcalError
        `wrong_option`: the name has an ending that is none of these.
    """
    ending = place.suffix.lower()
    if ending == ".mcap":
        return [place], write_ros(c, place)
    if ending == "":
        return write_folder(c, place), ()
    if ending not in (".csv", ".parquet"):
        raise FieldcalError(
            ReasonCode.WRONG_OPTION,
            f"{place.name}: calibrated readings are written as .mcap, .csv or .parquet, or into a folder, named without"
            " an ending.",
        )
    make_folder(place.absolute().parent)
    if ending == ".csv":
        write_bytes(place, csv_text(c).encode())
    else:
        write_frame(one_table(c), place, _facts(c))
    return [place], ()


def one_table(c: CalibratedReadings) -> pl.DataFrame:
    """All readings, a row a stamp, in the sensor axes as logged; null where a sensor has none at a stamp."""
    parts = [pl.DataFrame({"t_ns": t_ns, **columns_of(z, triad(name))}) for name, (t_ns, z) in c.readings.items()]
    if c.temperature is not None and not c.temperature.is_empty():
        parts.append(c.temperature.select("t_ns", TEMPERATURE))
    table = parts[0]
    for part in parts[1:]:
        table = table.join(part, on="t_ns", how="full", coalesce=True)
    return table.sort("t_ns").with_columns(pl.col(pl.Float64).fill_nan(None))


def csv_text(c: CalibratedReadings) -> str:
    """The table with a row of units under its header; time in seconds, to the nanosecond."""
    table = one_table(c)
    units = {name: c.constants.triads[name].unit for name in c.readings}
    t_ns = table["t_ns"]
    seconds = pl.DataFrame({"whole": t_ns // 10**9, "part": t_ns % 10**9}).select(
        t_s=pl.format("{}.{}", "whole", pl.col("part").cast(pl.String).str.zfill(9))
    )
    rest = table.drop("t_ns").rename({name: CSV_NAMES[name] for name in table.columns if name in CSV_NAMES})
    told = ["s", *("degC" if name == TEMPERATURE else units[name[:-2]] for name in table.columns if name != "t_ns")]
    header = ",".join(["t_s", *rest.columns])
    return f"{header}\n{','.join(told)}\n" + pl.concat([seconds, rest], how="horizontal").write_csv(
        include_header=False
    )


def write_folder(c: CalibratedReadings, folder: Path) -> list[Path]:
    """imu.parquet and magnetometer.parquet: the signal tables with calibrated values, in the sensor axes as logged."""
    with disk(folder, "made"):
        folder.mkdir(parents=True, exist_ok=True)
    metadata = _facts(c)
    units: dict[str, str] = {name: c.constants.triads[name].unit for name in c.readings}
    written = []
    for table in ("imu", "magnetometer"):
        own = [name for name in c.readings if TABLE_OF[name] == table]
        if not own:
            continue
        t_ns = c.readings[own[0]][0]
        columns = {"t_ns": t_ns}
        for name in INERTIAL_FIRST:
            if TABLE_OF[name] == table:
                values = c.readings[name][1] if name in own else np.full((len(t_ns), 3), np.nan)
                columns |= columns_of(values, triad(name))
        path = folder / f"{table}.parquet"
        frame = pl.DataFrame(columns).with_columns(pl.col(pl.Float64).fill_nan(None))
        with TableWriter(table, path, units=units, metadata=metadata) as writer:
            writer.write(frame)
        written.append(path)
    return written


def write_ros(c: CalibratedReadings, path: Path) -> tuple[str, ...]:
    """One MCAP of `sensor_msgs/Imu` and `MagneticField` by REP-103 and 145: body axes forward, left, up; specific
    force; rad/s, m/s² and tesla. What it cannot say is returned."""
    body = FLU_FROM_FRD @ sensor_model.frd_from_sensor(c.settings.rotation_body_from_sensor, c.settings.body)
    channels, warnings = [], []
    gyroscope, accelerometer = c.readings.get(Sensor.GYROSCOPE), c.readings.get(Sensor.ACCELEROMETER)
    either = gyroscope or accelerometer
    if either is not None:
        nothing = np.full((len(either[0]), 3), np.nan)
        sign = SPECIFIC_FORCE[c.settings.gravity_sign]
        rate = nothing if gyroscope is None else gyroscope[1] @ body.T
        force = nothing if accelerometer is None else sign * accelerometer[1] @ body.T
        channels.append(imu_channel(either[0], None, rate, force, topic="/imu/data", frame_id="base_link"))
    if (magnetometer := c.readings.get(Sensor.MAGNETOMETER)) is not None:
        unit = c.constants.triads[Sensor.MAGNETOMETER].unit
        factor, topic = UNIT_IN_TESLA.get(unit), "/imu/mag"
        if factor is None:
            factor, topic = 1.0, "/imu/mag_norm"
            warnings.append(
                f"magnetometer: in units of the local field, whose strength is not configured; {topic} is not in tesla."
            )
        field = factor * magnetometer[1] @ body.T
        channels.append(magnetic_field_channel(magnetometer[0], None, field, topic=topic, frame_id="base_link"))
    if c.temperature is not None and not c.temperature.is_empty():
        t_ns, warm = c.temperature["t_ns"].to_numpy(), c.temperature["temperature_degc"].to_numpy()
        channels.append(temperature_channel(t_ns, None, warm, frame_id="base_link"))
    with disk(path, "written"):
        path.parent.mkdir(parents=True, exist_ok=True)
        unfinished = path.with_name(path.name + ".part")
        write_mcap(unfinished, channels, metadata={"body": "flu", "gravity_sign": "specific_force"})
        unfinished.replace(path)
    return tuple(warnings)


def _facts(c: CalibratedReadings) -> dict[str, str]:
    """What a file of calibrated readings says of itself."""
    return {
        "calibrated": "z = scale * logged + bias, sensor axes as logged, gravity sign as declared",
        "vehicle_id": c.constants.vehicle_id,
        "imu_id": c.constants.imu_id,
        "constants_as_of": c.constants.as_of,
        "gravity_sign": c.settings.gravity_sign,
    }
