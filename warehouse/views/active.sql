-- What an autopilot had loaded in each flight, as its log tells: a row a sensor and parameter, and the latest export
-- that wrote this value, to float32; of flights with a clock of their own one from before them.
CREATE VIEW active AS
WITH stages AS (
    SELECT
        vehicle_id, flight_id, session_id, started_at, dated_by, sequence, unit_id, is_primary,
        json_extract(measured, '$.origin.loaded') AS loaded
    FROM run
    WHERE stage = 'composition' AND measured LIKE '%"loaded"%'
),
sensors AS (
    SELECT s.*, unnest(json_keys(s.loaded)) AS sensor FROM stages AS s
),
slots AS (
    SELECT *, json_extract(loaded, concat('$.', sensor)) AS slot FROM sensors
),
parameters AS (
    SELECT *, unnest(json_keys(slot, '$.parameters')) AS name FROM slots
),
own AS (
    SELECT DISTINCT flight_id, sensor, unit_id, is_primary FROM calibration
)
SELECT
    p.started_at, p.vehicle_id, p.session_id, p.flight_id, p.sequence,
    coalesce(o.unit_id, p.unit_id) AS unit_id, p.is_primary, p.sensor,
    json_extract_string(p.slot, '$.autopilot') AS autopilot,
    json_extract(p.slot, '$.device_id')::BIGINT AS device_id,
    p.name,
    json_extract(p.slot, concat('$.parameters."', p.name, '"'))::DOUBLE AS set_to,
    (
        SELECT max(e.exported_at)
        FROM export AS e
        WHERE
            e.vehicle_id = p.vehicle_id AND e.sensor = p.sensor AND e.name = p.name
            AND (p.dated_by IS DISTINCT FROM 'log' OR e.exported_at <= p.started_at)
            AND abs(e.set_to - json_extract(p.slot, concat('$.parameters."', p.name, '"'))::DOUBLE)
            <= {same_value} * greatest(abs(e.set_to), {same_value})
    ) AS exported_at
FROM parameters AS p
LEFT JOIN own AS o
    ON o.flight_id = p.flight_id AND o.sensor = p.sensor AND o.is_primary = p.is_primary
    AND (p.is_primary OR o.unit_id = p.unit_id)
ORDER BY p.started_at NULLS FIRST, p.vehicle_id, p.sequence, p.flight_id, p.sensor, p.name;
