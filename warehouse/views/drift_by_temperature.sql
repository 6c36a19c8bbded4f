-- How parameters go with temperature: weighted mean and spread in bins of 5 degC, values that were not refused.
CREATE VIEW drift_by_temperature AS
SELECT
    imu_id, unit_id, sensor, method, parameter, axis, unit,
    5 * floor(c.temperature_degc / 5) AS temperature_from_degc,
    avg(c.temperature_degc) AS temperature_degc,
    count(*) AS n_flights,
    coalesce(sum(c.value / (c.sd * c.sd)) FILTER (c.sd > 0) / sum(1 / (c.sd * c.sd)) FILTER (c.sd > 0), avg(c.value)) AS value,
    stddev_samp(c.value) AS spread,
    min(started_at) AS first_at,
    max(started_at) AS last_at
FROM calibration AS c
WHERE status = 'ok' AND c.value IS NOT NULL AND c.temperature_degc IS NOT NULL
GROUP BY ALL
ORDER BY imu_id, unit_id, sensor, method, parameter, axis, temperature_from_degc;
