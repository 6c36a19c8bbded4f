-- What did not come out, and why: logs that are not ok, stages and parameters that were refused or failed.
CREATE VIEW refusals AS
SELECT
    started_at, vehicle_id, imu_id, NULL AS unit_id, session_id, flight_id, 'log' AS level, log_uri AS what, verdict AS status,
    reason_code, reason AS detail
FROM flight
WHERE verdict <> 'ok'
UNION ALL
SELECT
    started_at, vehicle_id, imu_id, unit_id, session_id, flight_id, 'stage', stage, status, reason_code, measured
FROM run
WHERE status IN ('refused', 'failed')
UNION ALL
SELECT
    started_at, vehicle_id, imu_id, unit_id, session_id, flight_id, 'parameter',
    concat_ws(' ', sensor, method, parameter, axis), status, reason_code,
    CASE WHEN value IS NOT NULL THEN printf('%.6g +- %.3g %s', value, sd, unit) END
FROM calibration
WHERE status <> 'ok'
ORDER BY started_at NULLS FIRST, flight_id, level, unit_id, what;
