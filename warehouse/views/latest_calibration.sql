-- One row a unit, sensor, parameter and axis: the value at the reference temperature, its sd and its slope, where they
-- come from (source) and why. source = 'drift': the unit's trend as of its last flight, which draws a noisy single
-- flight towards the history by its sd; with two to four sessions the siblings lend the scatter and the slope.
-- source = 'flight': the latest value that was not refused, where there is no trend yet, or where it lies more than
-- {unconfirmed_sd} sd off the trend: what may be the first flight after a step is never averaged away. With a slope it
-- is brought to the reference temperature R, else taken as it is, whatever its temperature. sd goes with
-- best_known_degc: var(T) = sd^2 + slope_per_degc_sd^2 ((T - best)^2 - (R - best)^2). Of several methods in a flight
-- the most exact counts. source = 'pooled': what all flights know together (table pooled), those whose rows are refused
-- too, where it is known better so, or not at all otherwise; where one of trend and pooled has a bend over temperature
-- and the other a straight line, the bend. A pooled bend is in the variance too: w = T - R, 2 w^2 curve_with_value +
-- 2 w^3 curve_with_slope + w^4 curve_per_degc2_sd^2 more; of a trend's bend that is not known.
CREATE VIEW latest_calibration AS
WITH latest AS (
    SELECT
        unit_id, sensor, parameter, axis,
        arg_max(
            struct_pack(
                vehicle_id, imu_id, is_primary, method, value, sd, unit, at_degc := c.temperature_degc, flight_id,
                started_at, sequence
            ),
            row(
                coalesce(started_at, TIMESTAMPTZ '-infinity'), coalesce(sequence, ''), flight_id,
                CASE method {exactness} ELSE 0 END,
                method
            )
        ) AS l
    FROM calibration AS c
    WHERE status = 'ok' AND value IS NOT NULL
    GROUP BY unit_id, sensor, parameter, axis
),
beside AS (
    SELECT
        k.unit_id, k.sensor, k.parameter, k.axis, l, d,
        d.value_at_25degc IS NOT NULL AND (
            d.status <> 'insufficient' AND coalesce(d.n_sessions, {enough_sessions}) >= {enough_sessions}
            OR d.borrowed_from IS NOT NULL
        ) AS trend,
        coalesce(
            d.slope_per_degc * (l.at_degc - {reference_degc})
            + coalesce(d.curve_per_degc2, 0) * (l.at_degc - {reference_degc}) ^ 2
            + coalesce(d.curve_per_degc3, 0) * (l.at_degc - {reference_degc}) ^ 3,
            0
        ) AS warmer,
        coalesce(d.slope_per_degc_sd, 0) AS slope_sd,
        coalesce(d.best_known_degc, {reference_degc}) AS best
    FROM latest AS k
    LEFT JOIN drift AS d
        ON d.unit_id = k.unit_id AND d.sensor = k.sensor AND d.method = l.method AND d.parameter = k.parameter
        AND d.axis = k.axis AND d.unit IS NOT DISTINCT FROM l.unit
),
judged AS (
    SELECT
        *,
        -- A flight that the table has not seen yet, or has set aside, is measured here.
        greatest(
            abs(coalesce(d.last_z, 0)),
            CASE
                WHEN l.started_at > d.as_of THEN abs(l.value - d.value_at_25degc - warmer) / sqrt(
                    coalesce(l.sd, 0) ^ 2 + coalesce(d.session_sd, 0) ^ 2
                    + greatest(
                        d.sd ^ 2
                        + slope_sd ^ 2 * ((coalesce(l.at_degc, best) - best) ^ 2 - ({reference_degc} - best) ^ 2),
                        1e-300
                    )
                )
                ELSE 0
            END
        ) AS off
    FROM beside
),
chosen AS (
    SELECT *, trend AND NOT off > {unconfirmed_sd} AS by_trend, trend AND off > {unconfirmed_sd} AS beyond FROM judged
),
alone AS (
    SELECT
        l.vehicle_id, l.imu_id, unit_id, l.is_primary, sensor, l.method, parameter, axis,
        CASE WHEN by_trend THEN d.value_at_25degc WHEN beyond THEN l.value - warmer ELSE l.value END AS value_at_25degc,
        CASE
            WHEN by_trend THEN d.sd
            WHEN beyond THEN sqrt(l.sd ^ 2 + (slope_sd * coalesce(l.at_degc - {reference_degc}, 0)) ^ 2)
            ELSE l.sd
        END AS sd,
        CASE WHEN trend THEN d.slope_per_degc END AS slope_per_degc,
        CASE WHEN trend THEN d.slope_per_degc_sd END AS slope_per_degc_sd,
        CASE WHEN trend THEN d.curve_per_degc2 END AS curve_per_degc2,
        CASE WHEN trend THEN d.curve_per_degc3 END AS curve_per_degc3,
        l.unit, l.at_degc AS temperature_degc, l.flight_id, l.started_at, l.sequence,
        CASE WHEN by_trend THEN 'drift' ELSE 'flight' END AS source,
        CASE WHEN by_trend THEN d.best_known_degc ELSE l.at_degc END AS best_known_degc,
        CASE WHEN trend THEN d.session_sd END AS session_sd,
        CASE WHEN trend THEN d.temperature_min_degc END AS temperature_min_degc,
        CASE WHEN trend THEN d.temperature_max_degc END AS temperature_max_degc,
        d.status AS drift_status, beyond,
        CASE
            WHEN beyond THEN printf(
                'The latest flight is %.1f sd off the trend of %d flights: spoiled, or the first after a step. Its own value is given.',
                off, d.n_flights
            )
            WHEN by_trend AND d.borrowed_from IS NOT NULL THEN printf(
                'Mean of %d sessions, weighted by the scatter of %d siblings, whose slope brings them to {reference_degc} degC.',
                d.n_sessions, d.borrowed_from
            )
            WHEN by_trend THEN concat(
                'Trend of ', d.n_flights, ' flights',
                CASE d.status
                    WHEN 'step' THEN strftime(d.change_at AT TIME ZONE 'UTC', ', after the step of %Y-%m-%d')
                    WHEN 'drifting' THEN strftime(d.as_of AT TIME ZONE 'UTC', ', drifting, as of %Y-%m-%d')
                    WHEN 'outlier' THEN ', unlike the rest of the fleet'
                    ELSE ''
                END,
                '.'
            )
            WHEN d.n_sessions IS NOT NULL THEN concat(
                'The latest flight as it is: ', d.n_sessions, ' session', CASE WHEN d.n_sessions = 1 THEN '' ELSE 's' END,
                ' tell no trend yet.'
            )
            ELSE 'The latest flight as it is: no trend was made yet.'
        END AS why
    FROM chosen
),
together AS (
    SELECT a, p, coalesce(a.temperature_degc - {reference_degc}, 0) AS w
    FROM alone AS a
    FULL JOIN (
        SELECT * FROM pooled WHERE status IN ('ok', 'step', 'drifting') AND parameter IN ('scale', 'zero', 'lever_arm', 'delay')
    ) AS p
        ON a.unit_id = p.unit_id AND a.sensor = p.sensor AND a.parameter = p.parameter AND a.axis = p.axis
        AND a.unit IS NOT DISTINCT FROM p.unit
    WHERE a.unit_id IS NOT NULL OR p.parameter IN ('scale', 'zero')
),
better AS (
    -- A single flight is of a single session, whose scatter its own sd does not have, of its temperature, and of its day.
    SELECT
        a, p,
        a.unit_id IS NULL OR NOT a.beyond AND CASE
            WHEN a.source = 'flight' THEN coalesce(
                p.sd ^ 2 + coalesce(p.slope_per_degc_sd, 0) ^ 2 * (
                    (coalesce(a.temperature_degc, {reference_degc}) - p.best_known_degc) ^ 2
                    - ({reference_degc} - p.best_known_degc) ^ 2
                ) + coalesce(
                    2 * w ^ 2 * p.curve_with_value + 2 * w ^ 3 * p.curve_with_slope + w ^ 4 * p.curve_per_degc2_sd ^ 2, 0
                ) < a.sd ^ 2 + p.session_sd ^ 2 + p.walk_per_sqrt_day ^ 2
                    * coalesce(greatest(epoch(p.started_at) - epoch(a.started_at), 0) / 86400, 0),
                false
            )
            WHEN (a.curve_per_degc2 IS NULL) <> (p.curve_per_degc2 IS NULL) THEN p.curve_per_degc2 IS NOT NULL
            ELSE coalesce(p.sd <= a.sd, false)
        END AS by_all
    FROM together
)
SELECT
    CASE WHEN by_all THEN p.vehicle_id ELSE a.vehicle_id END AS vehicle_id,
    CASE WHEN by_all THEN p.imu_id ELSE a.imu_id END AS imu_id,
    CASE WHEN by_all THEN p.unit_id ELSE a.unit_id END AS unit_id,
    CASE WHEN by_all THEN p.is_primary ELSE a.is_primary END AS is_primary,
    CASE WHEN by_all THEN p.sensor ELSE a.sensor END AS sensor,
    CASE WHEN by_all THEN 'joint' ELSE a.method END AS method,
    CASE WHEN by_all THEN p.parameter ELSE a.parameter END AS parameter,
    CASE WHEN by_all THEN p.axis ELSE a.axis END AS axis,
    CASE WHEN by_all THEN p.value_at_25degc ELSE a.value_at_25degc END AS value_at_25degc,
    CASE WHEN by_all THEN p.sd ELSE a.sd END AS sd,
    CASE WHEN by_all THEN p.slope_per_degc ELSE a.slope_per_degc END AS slope_per_degc,
    CASE WHEN by_all THEN p.slope_per_degc_sd ELSE a.slope_per_degc_sd END AS slope_per_degc_sd,
    CASE WHEN by_all THEN p.curve_per_degc2 ELSE a.curve_per_degc2 END AS curve_per_degc2,
    CASE WHEN NOT by_all THEN a.curve_per_degc3 END AS curve_per_degc3,
    CASE WHEN by_all THEN p.unit ELSE a.unit END AS unit,
    CASE WHEN by_all THEN {reference_degc} ELSE a.temperature_degc END AS temperature_degc,
    CASE WHEN by_all THEN p.flight_id ELSE a.flight_id END AS flight_id,
    CASE WHEN by_all THEN p.started_at ELSE a.started_at END AS started_at,
    CASE WHEN by_all THEN p.sequence ELSE a.sequence END AS sequence,
    CASE WHEN by_all THEN 'pooled' ELSE a.source END AS source,
    CASE WHEN by_all THEN p.best_known_degc ELSE a.best_known_degc END AS best_known_degc,
    CASE WHEN by_all THEN p.session_sd ELSE a.session_sd END AS session_sd,
    CASE WHEN by_all THEN p.temperature_min_degc ELSE a.temperature_min_degc END AS temperature_min_degc,
    CASE WHEN by_all THEN p.temperature_max_degc ELSE a.temperature_max_degc END AS temperature_max_degc,
    a.drift_status,
    CASE WHEN by_all THEN p.reason ELSE a.why END AS why,
    CASE WHEN by_all THEN p.curve_per_degc2_sd END AS curve_per_degc2_sd,
    CASE WHEN by_all THEN p.curve_with_value END AS curve_with_value,
    CASE WHEN by_all THEN p.curve_with_slope END AS curve_with_slope
FROM better
ORDER BY unit_id, sensor, parameter, axis;
