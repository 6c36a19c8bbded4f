-- One row an IMU, sensor, parameter and axis: the value at 25 degC, its sd and its slope. From the drift table where it
-- has a trend (source = 'drift'), else the latest value that was not refused (source = 'flight'; it is taken as it is,
-- whatever its temperature). Of several methods in a flight the most exact counts.
CREATE VIEW latest_calibration AS
WITH latest AS (
    SELECT
        imu_id, sensor, parameter, axis,
        arg_max(
            struct_pack(vehicle_id, method, value, sd, unit, at_degc := c.temperature_degc, flight_id, started_at),
            row(
                coalesce(started_at, TIMESTAMPTZ '-infinity'), flight_id,
                CASE method
                    WHEN 'joint' THEN 5 WHEN 'output_error' THEN 4 WHEN 'ellipsoid_robust' THEN 3 WHEN 'ellipsoid' THEN 2
                    WHEN 'equation_error' THEN 1 ELSE 0
                END,
                method
            )
        ) AS l
    FROM calibration AS c
    WHERE status = 'ok' AND value IS NOT NULL
    GROUP BY imu_id, sensor, parameter, axis
)
SELECT
    l.vehicle_id, k.imu_id, k.sensor, l.method, k.parameter, k.axis,
    coalesce(d.value_at_25degc, l.value) AS value_at_25degc,
    CASE WHEN d.value_at_25degc IS NULL THEN l.sd ELSE d.sd END AS sd,
    d.slope_per_degc, d.slope_per_degc_sd,
    l.unit, l.at_degc AS temperature_degc, l.flight_id, l.started_at,
    CASE WHEN d.value_at_25degc IS NULL THEN 'flight' ELSE 'drift' END AS source
FROM latest AS k
LEFT JOIN drift AS d
    ON d.imu_id = k.imu_id AND d.sensor = k.sensor AND d.method = l.method AND d.parameter = k.parameter
    AND d.axis = k.axis AND d.status <> 'insufficient'
ORDER BY k.imu_id, k.sensor, k.parameter, k.axis;
