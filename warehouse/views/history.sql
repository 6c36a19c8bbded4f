-- Every parameter of every flight with the flight's log and verdict, oldest first.
CREATE VIEW history AS
SELECT
    c.started_at, c.vehicle_id, c.imu_id, c.unit_id, c.session_id, c.flight_id, c.sensor, c.method, c.parameter, c.axis,
    c.value, c.sd, c.unit, c.temperature_degc, c.status, c.reason_code, f.verdict, f.log_uri, c.run_key
FROM calibration AS c
LEFT JOIN flight AS f USING (vehicle_id, flight_id)
ORDER BY c.started_at NULLS FIRST, c.vehicle_id, c.sequence, c.flight_id, c.unit_id, c.sensor, c.method, c.parameter, c.axis;
