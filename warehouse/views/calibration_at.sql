-- What to fly with at a temperature: SELECT * FROM calibration_at(12.5). sd is that of the value; the next power-up
-- scatters about it by session_sd. A bend over temperature (curve_per_degc2, _degc3) is in the value; its sd is in that
-- of the value where the source is pooled, of a trend's it is not.
CREATE MACRO calibration_at(temperature_degc) AS TABLE
SELECT
    l.vehicle_id, l.imu_id, l.unit_id, l.is_primary, l.sensor, l.method, l.parameter, l.axis,
    l.value_at_25degc + coalesce(l.slope_per_degc, 0) * (temperature_degc - {reference_degc})
    + coalesce(l.curve_per_degc2, 0) * (temperature_degc - {reference_degc}) ^ 2
    + coalesce(l.curve_per_degc3, 0) * (temperature_degc - {reference_degc}) ^ 3 AS value,
    CASE WHEN l.sd IS NOT NULL THEN  -- greatest(NULL, 0) is 0
        sqrt(
            greatest(
                l.sd ^ 2 + coalesce(l.slope_per_degc_sd, 0) ^ 2
                * (
                    (temperature_degc - coalesce(l.best_known_degc, {reference_degc})) ^ 2
                    - ({reference_degc} - coalesce(l.best_known_degc, {reference_degc})) ^ 2
                )
                + coalesce(
                    2 * (temperature_degc - {reference_degc}) ^ 2 * l.curve_with_value
                    + 2 * (temperature_degc - {reference_degc}) ^ 3 * l.curve_with_slope
                    + (temperature_degc - {reference_degc}) ^ 4 * l.curve_per_degc2_sd ^ 2,
                    0
                ),
                0
            )
        )
    END AS sd,
    l.unit, l.flight_id, l.started_at, l.sequence, l.source, l.session_sd,
    concat(
        l.why,
        CASE
            WHEN l.slope_per_degc IS NULL THEN ' No slope on temperature.'
            WHEN temperature_degc < l.temperature_min_degc OR temperature_degc > l.temperature_max_degc
                THEN printf(
                    ' %.1f degC is outside the %.1f to %.1f degC flown.',
                    temperature_degc::DOUBLE, l.temperature_min_degc, l.temperature_max_degc
                )
            ELSE ''
        END
    ) AS why
FROM latest_calibration AS l
ORDER BY l.unit_id, l.sensor, l.parameter, l.axis;
