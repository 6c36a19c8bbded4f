-- What to fly with at a temperature: SELECT * FROM calibration_at(12.5)
CREATE MACRO calibration_at(temperature_degc) AS TABLE
SELECT
    l.vehicle_id, l.imu_id, l.sensor, l.method, l.parameter, l.axis,
    l.value_at_25degc + coalesce(l.slope_per_degc, 0) * (temperature_degc - 25) AS value,
    sqrt(l.sd ^ 2 + (coalesce(l.slope_per_degc_sd, 0) * (temperature_degc - 25)) ^ 2) AS sd,
    l.unit, l.flight_id, l.started_at, l.source
FROM latest_calibration AS l
ORDER BY l.imu_id, l.sensor, l.parameter, l.axis;
