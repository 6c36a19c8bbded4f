"""Reports that people look at: fleet, vehicle and flight, each one offline HTML file."""

from fieldcal.report.write import (
    fleet_report,
    flight_report,
    log_report,
    vehicle_report,
    write_fleet_report,
    write_flight_report,
    write_night_reports,
    write_vehicle_report,
)

__all__ = [
    "fleet_report",
    "flight_report",
    "log_report",
    "vehicle_report",
    "write_fleet_report",
    "write_flight_report",
    "write_night_reports",
    "write_vehicle_report",
]
