-- What does not count, and why: logs that are not ok, stages and parameters that were refused, failed or withdrawn.
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
    concat_ws(' ', sensor, method, parameter, axis), status,
    CASE WHEN status = 'withdrawn' THEN 'withdrawn' ELSE reason_code END,
    CASE
        WHEN status = 'withdrawn' THEN (
            SELECT arg_max(printf('%s (%s, %s)', d.reason, d.author, strftime(d.decided_at, '%Y-%m-%d')), d.decided_at)
            FROM decision AS d
            WHERE
                d.flight_id = c.flight_id AND d.decision = 'withdraw'
                AND coalesce(d.unit_id, c.unit_id) = c.unit_id AND coalesce(d.sensor, c.sensor) = c.sensor
                AND coalesce(d.parameter, c.parameter) = c.parameter AND coalesce(d.axis, c.axis) = c.axis
        )
        WHEN value IS NOT NULL THEN printf('%.6g +- %.3g %s', value, sd, unit)
    END
FROM calibration AS c
WHERE status <> 'ok'
ORDER BY started_at NULLS FIRST, flight_id, level, unit_id, what;
