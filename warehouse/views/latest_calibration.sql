-- One row a unit, sensor, parameter and axis: the value at the reference temperature, its sd and its slope, where they
-- come from (source) and why. source = 'drift': the unit's trend as of its last flight, which draws a noisy single
-- flight towards the history by its sd; with two to four sessions the siblings lend the scatter and the slope.
-- source = 'flight': the latest value that was not refused, where there is no trend yet, or where it lies more than
-- {unconfirmed_sd} sd off the trend: what may be the first flight after a step is never averaged away. With a slope it
-- is brought to the reference temperature R, else taken as it is, whatever its temperature. sd goes with
-- best_known_degc: var(T) = sd^2 + slope_per_degc_sd^2 ((T - best)^2 - (R - best)^2). Of several methods in a flight
-- the most exact counts.
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
)
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
    d.status AS drift_status,
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
ORDER BY unit_id, sensor, parameter, axis;
