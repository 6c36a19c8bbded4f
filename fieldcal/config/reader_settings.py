"""What readers of logs see of a vehicle's configuration: its signals follow from the log and from this alone."""

from __future__ import annotations

from fieldcal.config.configuration import Vehicle, VehicleTable
from fieldcal.config.values import Table
from fieldcal.names import Json

MAPS = tuple(n for n, key in VehicleTable.model_fields.items() if isinstance(key.default, Table) and n != "parameters")
"""Tables of a vehicle, one a log format that needs one; `parameters` are the stages'."""
READ = (*MAPS, "units", "simulated")


def reader_settings(vehicle: Vehicle) -> dict[str, Json]:
    """Plain JSON of the keys in `READ`."""
    return vehicle.model_dump(mode="json", include=set(READ))
