-- Comparisons of every flight that was not withdrawn, the worst Theil inequality coefficient first.
CREATE VIEW worst_tic AS
SELECT
    t.tic, t.rms, t.rms_unit, t.quantity, t.method, t.reference, t.signal, t.sample, t.n_samples,
    t.vehicle_id, t.imu_id, t.unit_id, t.session_id, t.flight_id, t.started_at, f.log_uri, f.verdict
FROM fit AS t
LEFT JOIN flight AS f USING (vehicle_id, flight_id)
WHERE
    t.tic IS NOT NULL
    AND t.flight_id NOT IN (
        SELECT flight_id
        FROM decision
        WHERE coalesce(unit_id, sensor, parameter, axis) IS NULL
        GROUP BY flight_id
        HAVING arg_max(decision, decided_at) = 'withdraw'
    )
ORDER BY t.tic DESC, t.flight_id, t.unit_id, t.quantity, t.method, t.reference;
