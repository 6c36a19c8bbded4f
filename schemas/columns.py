"""Every column, once: type, unit, frame, meaning."""

from __future__ import annotations

import pyarrow as pa

from fieldcal.schemas.column import AS_LOGGED, Column

_F64 = pa.float64()
_I32 = pa.int32()
_I64 = pa.int64()
_TEXT = pa.string()
_FLAG = pa.bool_()

_SENSOR_MEANING = {
    "gyroscope": "angular rate about",
    "accelerometer": "acceleration along",
    "magnetometer": "magnetic field along",
}


def _triad(
    sensor: str, prefix: str = "", remark: str = "as the log has it, sensor axes, no sign or scale applied"
) -> tuple[Column, ...]:
    return tuple(
        Column(
            f"{prefix}{sensor}_{axis}",
            _F64,
            AS_LOGGED,
            f"{_SENSOR_MEANING[sensor]} the sensor's {axis} axis, {remark}",
            sensor,
        )
        for axis in "xyz"
    )


# --- time and place in a recording
T_NS = Column(
    "t_ns", _I64, "ns", "time stamp of the sample on the clock of its own source, nanoseconds since that clock's epoch"
)
SEGMENT = Column("segment", _I32, "1", "number of the excited stretch of the flight, from 0, in order of time")
START_NS = Column("start_ns", _I64, "ns", "first sample of the segment, IMU clock")
END_NS = Column("end_ns", _I64, "ns", "last sample of the segment, IMU clock")
FROM_NS = Column("from_ns", _I64, "ns", "first sample that these constants had no part in, IMU clock")
RATE_RMS = Column(
    "rate_rms", _F64, AS_LOGGED, "rms of the logged angular rate vector over the segment, its mean removed", "gyroscope"
)
USED = Column("used", _FLAG, "", "whether the calibration uses this segment")

# --- readings
GYROSCOPE = _triad("gyroscope")
ACCELEROMETER = _triad("accelerometer")
MAGNETOMETER = _triad("magnetometer")
MAGNETOMETER_AT_IMU = tuple(
    Column(c.name, c.type, c.unit, c.meaning + ", interpolated to the IMU's time stamps", c.sensor)
    for c in MAGNETOMETER
)
SMOOTHED = tuple(
    column
    for sensor in ("gyroscope", "accelerometer", "magnetometer")
    for column in _triad(sensor, "smoothed_", "sensor axes, after the fixed-weight low-pass")
)
TEMPERATURE_DEGC = Column(
    "temperature_degc",
    _F64,
    "degC",
    "temperature of the IMU at that time; for a parameter its mean over the samples used",
)

# --- attitude and position
QUATERNION = (
    Column(
        "qx",
        _F64,
        "1",
        "first vector part of the unit quaternion, scalar last: body to world as logged, NED to body FRD in stages",
    ),
    Column("qy", _F64, "1", "second vector part of the unit quaternion"),
    Column("qz", _F64, "1", "third vector part of the unit quaternion"),
    Column("qw", _F64, "1", "scalar part of the unit quaternion"),
)
POSITION = tuple(
    Column(
        f"p{axis}_m", _F64, "m", f"{axis} coordinate of the body in the VPS's world frame; null where it is not logged"
    )
    for axis in "xyz"
)
LATITUDE_DEG = Column("latitude_deg", _F64, "deg", "geodetic latitude, WGS 84, north positive")
LONGITUDE_DEG = Column("longitude_deg", _F64, "deg", "longitude, WGS 84, east positive")
ALTITUDE_M = Column("altitude_m", _F64, "m", "altitude as the log has it (above the ellipsoid or mean sea level)")
GNSS_VELOCITY = (
    Column("velocity_north_mps", _F64, "m/s", "velocity over ground from satellite navigation, north"),
    Column("velocity_east_mps", _F64, "m/s", "the same, east"),
    Column("velocity_down_mps", _F64, "m/s", "the same, down"),
    Column("velocity_sd_mps", _F64, "m/s", "standard deviation that the receiver gives its speed; null: it gives none"),
)
CURRENT_A = Column(
    "current_a",
    _F64,
    "A",
    "current of battery or motors as the log has it; of a ROS BatteryState, negative while discharging, the magnitude",
)
THROTTLE = Column(
    "throttle", _F64, "1", "throttle, 0 to 1 of full; what is logged in another unit stands as logged and is not used"
)
ATTITUDE_SD_RAD = Column(
    "attitude_sd_rad",
    _F64,
    "rad",
    "standard deviation of the attitude: root of the mean of the three rotation-vector variances, body axes",
)
TASTE = Column(
    "taste",
    _F64,
    "1",
    "fault test of the two-vector attitude, chi-square with 1 degree of freedom when the readings agree",
)
ACCELERATION_EXCESS_MPS2 = Column(
    "acceleration_excess_mps2",
    _F64,
    "m/s^2",
    "length of the calibrated accelerometer vector less gravity: motion that spoils the vertical",
)
FIELD_EXCESS = Column(
    "field_excess",
    _F64,
    "1",
    "length of the calibrated magnetometer vector over the local field, less 1: other magnets",
)
ATTITUDE_WEIGHT = Column("weight", _F64, "1", "relative trust in the attitude, 0 to 1, from both excesses")
BODY_RATE = tuple(
    Column(
        f"rate_{axis}_radps",
        _F64,
        "rad/s",
        f"angular rate of the body about its {axis} axis (FRD) from the differentiated VPS attitude",
    )
    for axis in "xyz"
)

# --- covariance of a stage's parameters
ROW = Column("row", _I32, "1", "row of the covariance: 0, 1, 2 scale x, y, z; 3, 4, 5 bias x, y, z")
COLUMN = Column("column", _I32, "1", "column of the covariance, numbered as `row`")
COVARIANCE_VALUE = Column("value", _F64, "product of the units of row and column", "covariance of the two parameters")

# --- what leads every row of the history
FLIGHT_ID = Column(
    "flight_id",
    _TEXT,
    "",
    "first 16 hex digits of the sha256 of the log's content: the same log is the same flight wherever it lies",
)
VEHICLE_ID = Column("vehicle_id", _TEXT, "", "vehicle that flew (`drift`: the latest one that carried the unit)")
IMU_ID = Column("imu_id", _TEXT, "", "inertial unit on board; the vehicle's id where no other is configured")
UNIT_ID = Column(
    "unit_id",
    _TEXT,
    "",
    "the unit whose constants these are (of an agreement, a clock, a stage: that it is about): board, then the device "
    "id, frame or instance that tells it from others on board; the imu_id where the log tells of one alone",
)
IS_PRIMARY = Column("is_primary", _FLAG, "", "whether it was the flight's primary unit, by which the vehicle flew")
SESSION_ID = Column("session_id", _TEXT, "", "field session of the flight: the folder the log lay in")
STARTED_AT = Column(
    "started_at",
    pa.timestamp("us", tz="UTC"),
    "",
    "time of the first IMU sample, UTC; where its clock has no known epoch the date in the session's name, or null",
)
DATED_BY = Column(
    "dated_by",
    _TEXT,
    "",
    "what tells started_at: log (its clock), session (its folder's name), name (nothing does)",
)
SEQUENCE = Column(
    "sequence", _TEXT, "", "orders flights that started_at does not: names of session and log, their numbers padded"
)
LEAD = (FLIGHT_ID, VEHICLE_ID, IMU_ID, SESSION_ID, STARTED_AT, DATED_BY, SEQUENCE)
FLOWN_ORDER = (STARTED_AT.name, SEQUENCE.name, FLIGHT_ID.name)
"""Columns that flights are in the order of time by; those without a time come first."""

# --- flight
LOG_URI = Column("log_uri", _TEXT, "", "path of the log relative to the archive")
LOG_SHA256 = Column(
    "log_sha256", _TEXT, "", "sha256 of the log's content (folder of CSVs: over its files' names and hashes)"
)
LOG_FORMAT = Column("log_format", _TEXT, "", "format of the log: mcap, csv, ulog, dataflash, rosbag1, rosbag2")
DURATION_S = Column("duration_s", _F64, "s", "last less first IMU time stamp")
IMU_RATE_HZ = Column("imu_rate_hz", _F64, "Hz", "median rate of the IMU samples")
VPS_RATE_HZ = Column("vps_rate_hz", _F64, "Hz", "median rate of the VPS poses; null without VPS")
N_SAMPLES = Column(
    "n_samples", _I64, "1", "number of samples the row speaks of (`flight`: IMU samples kept; `fit`: samples compared)"
)
TEMPERATURE_MIN_DEGC = Column(
    "temperature_min_degc", _F64, "degC", "lowest logged IMU temperature; null when not logged"
)
TEMPERATURE_MEAN_DEGC = Column(
    "temperature_mean_degc", _F64, "degC", "mean logged IMU temperature; null when not logged"
)
TEMPERATURE_MAX_DEGC = Column(
    "temperature_max_degc", _F64, "degC", "highest logged IMU temperature; null when not logged"
)
VERDICT = Column(
    "verdict",
    _TEXT,
    "",
    "ok: all read, no stage failed; partial: samples lost; no_result: no constant came out of it; quarantined: "
    "contradictory; rejected: nothing usable",
)
FINDINGS = Column("findings", _TEXT, "", "what was found in the log, JSON list of {code, count, sentence}")
VERIFIABLE = Column("verifiable", _FLAG, "", "whether the log carries checksums that were checked")

# --- why
REASON_CODE = Column("reason_code", _TEXT, "", "short stable identifier of why it is not ok; null when it is")
REASON = Column(
    "reason", _TEXT, "", "why, as one sentence with the numbers that decided it; null when there is nothing to say"
)

# --- calibration
SENSOR = Column("sensor", _TEXT, "", "magnetometer, accelerometer or gyroscope")
METHOD = Column(
    "method",
    _TEXT,
    "",
    "estimator that made the row: ellipsoid, ellipsoid_robust, equation_error, output_error, joint, velocity, ...",
)
PARAMETER = Column(
    "parameter",
    _TEXT,
    "",
    "scale, bias: z = scale * logged + bias, sensor axes; zero = -bias/scale; zero_bias: z at the reference reading; "
    "zero_per_degc: slope of the zero; lever_arm, vps_lever_arm: from the point the vehicle turns about, or the VPS's "
    "point, to the sensor, body axes; gnss_lag of a satellite receiver's velocity, and gnss_lever_arm from the sensor "
    "to its antenna, body axes; delay behind the gyroscope or the trajectory; dip of the field; g_sensitivity of "
    "the reading to specific force (the zero is that at the flight's mean force); field_per_current, "
    "field_per_throttle: what the motors add to the reading; residual_...: of readings that an autopilot had corrected "
    "before it logged them, beside which the others are the raw sensor's; in `information` gain, zero: reading = gain "
    "* z + zero, so gain is 1/scale, and cross: an off-diagonal element of the matrix over its row's diagonal one",
)
AXIS = Column("axis", _TEXT, "", "sensor axis x, y or z; full form xx, xy, ...")
VALUE = Column("value", _F64, "named by column unit", "estimate of the parameter; null when refused without a number")
SD = Column("sd", _F64, "named by column unit", "one standard deviation of the estimate (`drift`: of value_at_25degc)")
UNIT = Column("unit", _TEXT, "", "unit of the numbers of the row that have none of their own")
RUN_KEY = Column(
    "run_key", _TEXT, "", "digest of inputs, parameters, code and versions that made the row", provenance=True
)

# --- moments
MAGNITUDE = Column(
    "magnitude",
    _F64,
    "`unit`",
    "length of the sensed vector, local field or gravity, that the readings are fitted to; null of the gyroscope",
)
LOGGED_UNIT = Column("logged_unit", _TEXT, "", "unit of the readings")
READING_RATE_HZ = Column("reading_rate_hz", _F64, "Hz", "readings a second, by their median interval")
BLOCK_SAMPLES = Column(
    "block_samples", _I64, "1", "attitudes from which one of the gyroscope's equations was formed; 0 of other sensors"
)
N_DIFFERENCES = Column("n_differences", _I64, "1", "third differences in the sums that tell the readings' noise")
SUMS = Column(
    "sums",
    _TEXT,
    "",
    "JSON object: polarity (3), centre taken off the readings (3), noise: sums of squared third differences (3), and "
    "sums, of products of the readings to the fourth order (34) or of the gyroscope's equations (33)",
)
# --- information, and pooled
PLACE = Column("place", _I64, "1", "number of the parameter among those of the flight and unit, from 0")
SENSOR_UNIT_ID = Column(
    "sensor_unit_id", _TEXT, "", "the sensor's own unit, where the units of a flight's sensors differ; else unit_id"
)
LINEARISED_AT = Column(
    "linearised_at",
    _F64,
    "named by column unit",
    "value p0 about which the flight's equations N (p - p0) = g are linear: the flight's joint estimate, or what the "
    "parameter was held at; readings are centred there, so that a few per cent of a scale change N by as much",
)
RIGHT_SIDE = Column(
    "right_side", _F64, "1 over column unit", "element of g: 0 where the flight alone, without its prior, is at p0"
)
INFORMATION = Column(
    "information",
    pa.list_(_F64),
    "1 over the units of the two parameters",
    "row of N up to its diagonal, by place: information on this parameter and each before it, the prior taken out, "
    "attitude, translation, dip and noise levels eliminated, coloured noise in it; all 0 where nothing is known",
)
POOLED_WITH = Column(
    "pooled_with",
    _TEXT,
    "",
    "unit_id in `information` of what was pooled: rows with the same share a covariance",
)
COVARIANCE_BEFORE = Column(
    "covariance",
    pa.list_(_F64),
    "product of the units of the two parameters",
    "of value_at_25degc with that of each parameter before it, by place, and with itself; null when refused",
)
WALK_PER_SQRT_DAY = Column(
    "walk_per_sqrt_day",
    _F64,
    "column unit per square root of a day",
    "how much it walks, by all its siblings",
)
SLOPE_SPREAD = Column("slope_spread", _F64, "column unit per degC", "scatter of slope_per_degc among siblings")
N_INNOVATIONS = Column(
    "n_innovations", _F64, "1", "sessions of all siblings that session_sd, walk_per_sqrt_day and slope_spread are from"
)
FLIGHTS_POOLED = Column("flights", pa.list_(_TEXT), "", "flight_id of each flight that was pooled, in order of time")
SHARES = Column(
    "shares",
    pa.list_(_F64),
    "1",
    "by flights: share of what was known of the parameter then that would not have been known without the flight",
)
DISTANCES = Column(
    "distances",
    pa.list_(_F64),
    "1",
    "by flights: distance of the scales at which its equations were made from the pooled ones, over that up to which "
    "they hold; beyond 1 it is left out",
)
LEFT_OUT = Column("left_out", pa.list_(_TEXT), "", "flight_id of each flight that contradicts the others, left out")

# --- fit
QUANTITY = Column(
    "quantity", _TEXT, "", "what is compared: attitude, quaternion_rate, attitude_propagated or body_rate"
)
REFERENCE = Column("reference", _TEXT, "", "what it is compared with: vps, quest or joint")
SIGNAL = Column("signal", _TEXT, "", "readings that were compared: raw or smoothed")
SAMPLE = Column("sample", _TEXT, "", "samples that were compared: all, or held_out of the estimation")
TIC = Column("tic", _F64, "1", "Theil inequality coefficient: 0 perfect, 1 no likeness")
TIC_BIAS = Column("tic_bias", _F64, "1", "share of the squared error that is a difference of means")
TIC_VARIANCE = Column("tic_variance", _F64, "1", "share of the squared error that is a difference of spread")
TIC_COVARIANCE = Column("tic_covariance", _F64, "1", "share of the squared error that is lack of correlation")
RMS = Column("rms", _F64, "named by column rms_unit", "rms of the difference; of the rotation angle for attitudes")
RMS_UNIT = Column("rms_unit", _TEXT, "", "unit of rms: deg for attitudes, rad/s for rates, 1/s for quaternion rates")

# --- sync
LAG_S = Column(
    "lag_s", _F64, "s", "VPS clock + lag = IMU clock, at the first IMU sample; contains the sensors' group delay"
)
LAG_MID_S = Column("lag_mid_s", _F64, "s", "the same in the middle of the flight")
LAG_SD_S = Column("lag_sd_s", _F64, "s", "standard deviation of lag_mid_s")
SKEW_PPM = Column(
    "skew_ppm", _F64, "ppm", "drift of the VPS clock against the IMU's, positive when the VPS clock is fast"
)
SKEW_SD_PPM = Column("skew_sd_ppm", _F64, "ppm", "standard deviation of skew_ppm")
PEAK = Column("peak", _F64, "1", "height of the correlation peak, 1 for equal signals")
RUNNER_UP = Column("runner_up", _F64, "1", "height of the next best peak: close to `peak` means ambiguous")
STATUS = Column(
    "status",
    _TEXT,
    "",
    "outcome: ok, refused, absent, failed, or withdrawn by a decision (`drift`: stable, drifting, step, outlier, "
    "insufficient; `pooled`: ok, step, drifting, refused, or insufficient where the last session contradicts the "
    "others)",
)

# --- run
STAGE = Column("stage", _TEXT, "", "stage of the pipeline")
MEASURED = Column("measured", _TEXT, "", "what the stage measured about its input and result, JSON object")
VERSIONS = Column(
    "versions",
    _TEXT,
    "",
    "versions of fieldcal, Python, numpy, scipy and polars that made the result, JSON object",
    provenance=True,
)

# --- faults
FAULT_NUMBER = Column("number", _F64, "as its reason says", "what decided: a share, a ratio or a reading")
FAULT_LIMIT = Column("limit", _F64, "as its reason says", "what the number was held against")
FATAL = Column("fatal", pa.bool_(), "", "no stage that needs the sensor runs")

# --- drift
N_FLIGHTS = Column("n_flights", _I64, "1", "flights the regression used")
VALUE_AT_25DEGC = Column("value_at_25degc", _F64, "named by column unit", "regressed value at 25 degC")
SLOPE_PER_DEGC = Column("slope_per_degc", _F64, "column unit per degC", "change with temperature")
SLOPE_PER_DEGC_SD = Column("slope_per_degc_sd", _F64, "column unit per degC", "standard deviation of slope_per_degc")
CURVE_PER_DEGC2, CURVE_PER_DEGC2_SD, CURVE_PER_DEGC3, CURVE_PER_DEGC3_SD = (
    Column(f"curve_per_degc{power}{suffix}", _F64, f"column unit per degC^{power}", meaning)
    for power, word in ((2, "square"), (3, "cube"))
    for suffix, meaning in (
        ("", f"coefficient of the {word} of temperature - 25 degC beside slope_per_degc; null: no bend is known"),
        ("_sd", f"standard deviation of curve_per_degc{power}"),
    )
)
CURVE_WITH_VALUE = Column(
    "curve_with_value",
    _F64,
    "square of column unit per degC^2",
    "covariance of curve_per_degc2 with value_at_25degc: w degC above 25 the variance of the value has 2 w^2 of it, "
    "2 w^3 of curve_with_slope and w^4 curve_per_degc2_sd^2 beside that of the line",
)
CURVE_WITH_SLOPE = Column(
    "curve_with_slope", _F64, "square of column unit per degC^3", "covariance of curve_per_degc2 with slope_per_degc"
)
SLOPE_PER_DAY = Column("slope_per_day", _F64, "column unit per day", "change with time")
SLOPE_PER_DAY_SD = Column("slope_per_day_sd", _F64, "column unit per day", "standard deviation of slope_per_day")
LAST_Z = Column(
    "last_z",
    _F64,
    "1",
    "distance of the last flight from the regression (`pooled`: of the last session from all others), in standard "
    "deviations",
)
CHANGE_AT = Column(
    "change_at",
    pa.timestamp("us", tz="UTC"),
    "",
    "start of the first flight after a detected step, UTC; null without one",
)
N_SESSIONS = Column("n_sessions", _I64, "1", "number of field sessions that count in the regression")
AS_OF = Column(
    "as_of",
    pa.timestamp("us", tz="UTC"),
    "",
    "start of the last flight that counts, UTC: value_at_25degc and slope_per_day are as of then",
)
BEST_KNOWN_DEGC = Column(
    "best_known_degc",
    _F64,
    "degC",
    "temperature at which value and slope_per_degc are independent: var(T) = var there + slope sd^2 (T - it)^2",
)
BEST_KNOWN_AT = Column(
    "best_known_at",
    pa.timestamp("us", tz="UTC"),
    "",
    "moment, UTC, at which value_at_25degc brought there and slope_per_day are independent: var(t) = var there + slope"
    " sd^2 (t - it)^2",
)
BORROWED_FROM = Column(
    "borrowed_from",
    _I64,
    "1",
    "siblings whose scatter between sessions and slope the value uses below five sessions; null: not needed, too few",
)
SESSION_SD = Column(
    "session_sd", _F64, "named by column unit", "scatter of the parameter between sessions beyond the flights' own sd"
)
CHANGE_SIZE = Column("change_size", _F64, "named by column unit", "size of the step at change_at; null without one")
CHANGE_SIZE_SD = Column("change_size_sd", _F64, "named by column unit", "standard deviation of change_size")
FLEET_Z = Column(
    "fleet_z",
    _F64,
    "1",
    "distance from the fleet's other units, in sd; of a VPS lag: of its scatter's logarithm; null with few siblings",
)

# --- decision
DECIDED_AT = Column("decided_at", pa.timestamp("us", tz="UTC"), "", "when it was decided, UTC", provenance=True)
DECISION = Column(
    "decision", _TEXT, "", "withdraw: what it names counts nowhere from then on; accept: it counts, again or as it did"
)
AUTHOR = Column("author", _TEXT, "", "who decided or exported", provenance=True)

# --- export
EXPORTED_AT = Column("exported_at", pa.timestamp("us", tz="UTC"), "", "when it was exported, UTC", provenance=True)
LATEST_FLIGHT_ID = Column(
    "latest_flight_id",
    _TEXT,
    "",
    "the vehicle's latest flight that the history had then; null: it had none",
    provenance=True,
)
EXPORT_FORMAT = Column("format", _TEXT, "", "whose format it is: px4, ardupilot, ros, kalibr, json, ...")
EXPORT_SHA256 = Column("text_sha256", _TEXT, "", "sha256 of the exported text")
AT_TEMPERATURE_DEGC = Column("at_degc", _F64, "degC", "temperature that the constants were asked for")
TARGET_NAME = Column(
    "name", _TEXT, "", "the autopilot's parameter; of other formats the constant and its axes, as zero_x or scale_xy"
)
SET_TO = Column("set_to", _F64, "as its target has it", "what it was exported as")
