"""What the units on board a flight are called: in the history, and among the steps of a night."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from fieldcal.config.configuration import Vehicle
from fieldcal.logs.facts import Facts
from fieldcal.logs.on_board import PRIMARY, sensors_of
from fieldcal.names import INERTIAL_FIRST, Sensor
from fieldcal.stages.stage import step_of


@dataclass(frozen=True)
class Unit:
    """A unit on board. `table`: of its readings (`logs.on_board`). `unit_id`: that of its IMU or magnetometer, and of
    what is said of it as a whole. `ids`: of each sensor that is its own: only of these its rows speak."""

    table: str
    unit_id: str
    ids: Mapping[Sensor, str]

    @property
    def is_primary(self) -> bool:
        """Whether the vehicle flew with it."""
        return self.table == PRIMARY

    def step(self, stage: str) -> str:
        """A stage of this unit among the steps of its flight: "joint", of a further one "joint@imu.1"."""
        return step_of(stage, self.table)


def units_of(facts: Facts, vehicle: Vehicle, imu_id: str) -> list[Unit]:
    """The units that are calibrated, the primary one first; the further ones unless the vehicle's are not asked for.

    A unit is called by its board, then by its device id, frame or instance. The board is the `imu_id` that is
    configured, else the autopilot's serial number, else the vehicle; where the log tells of one unit, that is all.
    """
    configured = imu_id != vehicle.vehicle_id
    board = imu_id if configured else facts["board_id"] or imu_id
    on_board = facts["units_on_board"] or [{"table": PRIMARY, "devices": {}, "applied": {}, "loaded": {}}]
    units = []
    for one in on_board[: None if vehicle.units_on_board == "all" else 1]:
        devices = {sensor: one["devices"].get(sensor) or None for sensor in sensors_of(one["table"])}
        ids = {sensor: board if device is None else f"{board}/{device}" for sensor, device in devices.items()}
        of_all = next((ids[sensor] for sensor in INERTIAL_FIRST if devices.get(sensor) is not None), board)
        units.append(Unit(one["table"], of_all, ids))
    return units
