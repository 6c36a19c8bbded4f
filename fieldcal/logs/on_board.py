"""The units on board a log: which signal tables each reads from, and what is known of it.

A unit is an IMU or a magnetometer. The primary ones make one unit, "imu", as they fly; a further IMU, "imu.1", is
calibrated with the primary magnetometer, a further magnetometer, "magnetometer.1", with the primary IMU.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence

from fieldcal.logs.applied import applied
from fieldcal.logs.facts import UnitFacts
from fieldcal.logs.interface import SIGNAL_COLUMNS, LogSummary, SensorSource
from fieldcal.logs.loaded import loaded
from fieldcal.names import SENSORS, Sensor
from fieldcal.reason_codes import ReasonCode
from fieldcal.schemas import signal_kind

PRIMARY = "imu"
"""The primary unit, by the table of its readings."""
UNIT_TABLES = {
    "imu": (Sensor.GYROSCOPE, Sensor.ACCELEROMETER),
    "magnetometer": (Sensor.MAGNETOMETER,),
}
"""Signal tables that a unit may have of its own, and the sensors whose readings they are."""
OF_THE_IMU = ("imu", "temperature")


def sensors_of(unit: str) -> tuple[Sensor, ...]:
    """A unit's own sensors: of the primary one all."""
    return SENSORS if unit == PRIMARY else UNIT_TABLES[signal_kind(unit)]


def signals_of(unit: str, tables: Collection[str]) -> dict[str, str]:
    """Signal as a unit's stages call it → the table, one of those that there are, with its readings."""
    kind = signal_kind(unit)
    own = OF_THE_IMU if kind == PRIMARY else (kind,)
    number = unit.removeprefix(kind)
    seen = {name: name + number if name in own else name for name in SIGNAL_COLUMNS}
    return {name: table for name, table in seen.items() if table in tables}


def units_on_board(
    sources: Sequence[SensorSource], further: Sequence[str], first_ns: int, last_ns: int
) -> list[UnitFacts]:
    """What is known of the primary unit and of those whose tables are `further`, between two times."""
    return [_unit(table, sources, first_ns, last_ns) for table in (PRIMARY, *further)]


def _unit(unit: str, sources: Sequence[SensorSource], first_ns: int, last_ns: int) -> UnitFacts:
    tables = signals_of(unit, {one.table for one in sources}).values()
    used = [one for one in sources if one.table in tables]
    own = [one for one in used if unit in (PRIMARY, one.table)]
    return {
        "table": unit,
        "devices": {str(one.sensor): one.unit_id for one in own},
        "applied": applied(used, first_ns, last_ns),
        "loaded": loaded(used),
    }


def tell_further_units(summary: LogSummary, log_name: str) -> None:
    """Finding on units beside the primary ones, where `summary.sources` tells of any."""
    further = [source for source in summary.sources if not source.primary]
    if further:
        units = sorted({(source.table, source.unit_id) for source in further})
        named = ", ".join(f"{table} ({unit_id})" for table, unit_id in units)
        summary.add(
            ReasonCode.FURTHER_UNITS,
            len(units),
            f"{log_name}: beside the primary units there are {len(units)} more on board, {named}; a night calibrates "
            "each by itself, fieldcal calibrate --unit one of them.",
        )
