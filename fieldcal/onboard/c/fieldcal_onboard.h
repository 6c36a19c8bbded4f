/* fieldcal on board: constants of magnetometer, accelerometer and gyroscope from streams of readings, with their
   standard deviations, or a refusal (Grauer et al., AIAA 2009-2064; mathematics: fieldcal's documentation, "On board").

   C99. State is fixed and the caller's; nothing is allocated, nothing recurses, every loop is bounded. Of libm sqrtf,
   sinf, cosf and atan2f are called. A reading is float; sums are pairs of floats (the rounding that a sum lost is kept beside it);
   double is used only where equations are solved, on request, from the sums.

   Units: whatever the readings are logged in; lengths (field, gravity) in the unit wanted for the result. The model is
   z = scale * logged + bias (Eq. 5), in sensor axes. Quaternions are scalar last, body from inertial (Eq. 1). */
#ifndef FIELDCAL_ONBOARD_H
#define FIELDCAL_ONBOARD_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "fieldcal_onboard_config.h"

#if defined(__FAST_MATH__)
#error "fieldcal_onboard: -ffast-math removes the rounding that sums are corrected by; compile this file without it"
#endif

#if FIELDCAL_FULL_MATRIX
#define FIELDCAL_SUMS 34
#define FIELDCAL_PARAMETERS 9
#else
#define FIELDCAL_SUMS 24 /* fourth-order moments that an axis-aligned ellipsoid needs */
#define FIELDCAL_PARAMETERS 6
#endif
#define FIELDCAL_RATE_SUMS 33
#define FIELDCAL_DUMP_BYTES(sums) (56u + (8u * (unsigned)(sums)))

/* What became of a call. Codes of refusals are those of fieldcal's history, in parentheses. */
typedef enum {
    FIELDCAL_OK = 0,
    FIELDCAL_NOT_FED = 1,             /* a reading is not finite, or too large for its fourth power: left out */
    FIELDCAL_TOO_FEW = 2,             /* samples (too_few_samples) */
    FIELDCAL_DEGENERATE = 3,          /* no ellipsoid (ellipsoid_degenerate) */
    FIELDCAL_TOO_LITTLE_MOTION = 4,   /* condition number above its limit (too_little_motion) */
    FIELDCAL_SCALE_UNCERTAIN = 5,     /* relative sd of a scale above its limit (scale_uncertain) */
    FIELDCAL_NOT_A_SPHERE = 6,        /* the calibrated length varies too much (not_a_sphere) */
    FIELDCAL_NOT_EXCITED = 7,         /* the gyroscope's axis did not turn (gyro_not_excited) */
    FIELDCAL_WRONG_SIGN = 8,          /* a scale's sign contradicts the polarity (polarity_contradiction) */
    FIELDCAL_NOT_MERGEABLE = 9,       /* other block length, or something was forgotten */
    FIELDCAL_BAD_DUMP = 10,           /* not a dump, damaged, or of another sensor or build */
    FIELDCAL_WRONG_ARGUMENT = 11,
    FIELDCAL_CONTRADICTS = 12 /* the attitudes do not turn as the gyroscope does (gyro_contradicts_attitude) */
} fieldcal_code;

typedef enum { FIELDCAL_MAGNETOMETER = 0, FIELDCAL_ACCELEROMETER = 1, FIELDCAL_GYROSCOPE = 2 } fieldcal_sensor;

/* A sum and the rounding that it lost: its value is high + low. */
typedef struct {
    float high;
    float low;
} fieldcal_sum;

/* The readings' own noise, while the vehicle moves: third differences of means over a few neighbouring readings. */
typedef struct {
    uint32_t in_mean; /* readings that are averaged */
    uint32_t differences;
    fieldcal_sum sum[3]; /* of the squared differences, times in_mean */
    float mean[3];
    uint32_t in_this; /* readings in mean so far */
    float last[3][3]; /* the last three means, newest first */
    uint32_t held;    /* of them that are there */
} fieldcal_noise;

/* --- Vector triads: moments of the readings, and the ellipsoid that they draw -------------------------------------- */

typedef struct {
    uint32_t samples;
    float centre[3]; /* what is taken off each reading; the first one unless given */
    fieldcal_sum sum[FIELDCAL_SUMS];
    fieldcal_noise noise;
} fieldcal_moments;

/* What is asked of the triad. */
typedef struct {
    float magnitude;          /* length of the sensed vector */
    float polarity[3];        /* 1 or -1: lengths cannot tell */
    bool full;                /* symmetric scale matrix instead of three scales; needs FIELDCAL_FULL_MATRIX */
    float correlated_samples; /* over how many samples what is not the sensor's own noise stays alike */
    float max_condition;
    float max_scale_sd; /* relative */
    float max_residual; /* rms of length / magnitude - 1 */
} fieldcal_limits;

typedef struct {
    fieldcal_code code;
    float scale[3][3];
    float scale_sd[3][3];
    float bias[3];
    float bias_sd[3];
    float covariance[6][6]; /* of scale xx, yy, zz and bias x, y, z */
    float condition;        /* of the column-normalised sensitivities: 1.6 for the whole sphere */
    float residual_rms;     /* of length / magnitude - 1 */
    float noise_sd[3];      /* of a reading, logged units, as the residuals show it */
    float excess;           /* variance of the residuals over that of the noise where it is averaged */
    uint32_t samples;
} fieldcal_ellipsoid;

/* in_mean: readings in about 20 ms, 1 to 16; centre NULL: the first reading. */
void fieldcal_moments_start(fieldcal_moments *moments, uint32_t in_mean, const float *centre);
fieldcal_code fieldcal_moments_feed(fieldcal_moments *moments, const float reading[3]);
void fieldcal_moments_gap(fieldcal_moments *moments); /* the next reading does not follow on the last */
fieldcal_code fieldcal_moments_merge(fieldcal_moments *into, const fieldcal_moments *from);
fieldcal_code fieldcal_moments_solve(const fieldcal_moments *moments, const fieldcal_limits *limits,
                                     fieldcal_ellipsoid *fit);

/* --- Attitude from two vectors (Wahba's problem, Eq. 9) ----------------------------------------------------------- */

/* Observed b and reference r, not of unit length necessarily; sigma: noise of each direction, rad. */
fieldcal_code fieldcal_attitude_quest(float b[2][3], float r[2][3], const float sigma[2], float q[4]);
/* The first vector exact. */
fieldcal_code fieldcal_attitude_triad(float b[2][3], float r[2][3], float q[4]);
/* Eq. 2 and 4: from the field and gravity-signed acceleration, small angles. */
fieldcal_code fieldcal_attitude_euler(const float field[3], const float gravity[3], float declination, float q[4]);

/* --- Gyroscope: recursive least squares on the four kinematic equations (Eq. 10), in information form --------------- */

typedef struct {
    uint32_t samples;
    float centre[3];
    fieldcal_noise noise;
    fieldcal_sum sum[FIELDCAL_RATE_SUMS]; /* weight, weight^2, pairs; x y xx xy yy x+x' y+y' xx' yy' xy'+yx' an axis */
    uint32_t block_samples; /* attitudes from which one derivative is formed */
    float forgetting;       /* factor a block; 1: nothing is forgotten */
    uint32_t in_block;
    uint32_t first_us;
    uint32_t last_us;
    float last_q[4];
    float q_sum[4];
    float slope_sum[4];
    float rate_sum[3];
    float last_x[3];
    float last_y[3];
    bool follows; /* the block before this one is in last_x, last_y */
} fieldcal_rates;

typedef struct {
    fieldcal_code code[3];
    float scale[3];
    float scale_sd[3];
    float bias[3];
    float bias_sd[3];
    float covariance[3]; /* of scale and bias, an axis */
    float residual_rms[3];
    float correlation[3]; /* of neighbouring residuals */
    uint32_t samples;
} fieldcal_gyroscope_fit;

/* block_samples 3 to 256; forgetting in (0, 1]; in_mean and centre as above. */
fieldcal_code fieldcal_rates_start(fieldcal_rates *rates, uint32_t block_samples, float forgetting, uint32_t in_mean,
                                   const float *centre);
/* t_us: a clock that may wrap; more than max_gap_us after the last sample a new block begins. */
fieldcal_code fieldcal_rates_feed(fieldcal_rates *rates, uint32_t t_us, uint32_t max_gap_us, const float q[4],
                                  const float reading[3]);
void fieldcal_rates_gap(fieldcal_rates *rates); /* the next sample does not follow on the last */
fieldcal_code fieldcal_rates_merge(fieldcal_rates *into, const fieldcal_rates *from);
void fieldcal_rates_solve(const fieldcal_rates *rates, const float polarity[3], float max_scale_sd,
                          fieldcal_gyroscope_fit *fit);

/* --- Dumps: the sums, little-endian, with a checksum. The size written, or 0 where the buffer is too small. Loaded into
   a state that was started. */

size_t fieldcal_moments_dump(const fieldcal_moments *moments, fieldcal_sensor sensor, uint8_t *buffer, size_t size);
fieldcal_code fieldcal_moments_load(fieldcal_moments *moments, fieldcal_sensor sensor, const uint8_t *buffer, size_t size);
size_t fieldcal_rates_dump(const fieldcal_rates *rates, uint8_t *buffer, size_t size);
fieldcal_code fieldcal_rates_load(fieldcal_rates *rates, const uint8_t *buffer, size_t size);

/* --- The duty: everything of one IMU, by the vehicle's configuration ------------------------------------------------ */

typedef struct {
    fieldcal_moments magnetometer;
    fieldcal_moments accelerometer;
    fieldcal_rates gyroscope;
    float scale[2][3][3]; /* of magnetometer and accelerometer, once they are known: attitudes are made with them */
    float bias[2][3];
    bool known;
} fieldcal_board;

typedef struct {
    fieldcal_ellipsoid magnetometer;
    fieldcal_ellipsoid accelerometer;
    fieldcal_gyroscope_fit gyroscope;
} fieldcal_result;

void fieldcal_start(fieldcal_board *board);
/* One sample of the IMU; magnetometer NULL where it has no new reading. The gyroscope's equations are fed from when the
   vector triads are known: by fieldcal_solve, or fieldcal_set_vectors with earlier constants; not where another
   acceleration or field makes a vector too long or too short. */
fieldcal_code fieldcal_feed(fieldcal_board *board, uint32_t t_us, const float gyroscope[3], const float accelerometer[3],
                            const float *magnetometer);
void fieldcal_set_vectors(fieldcal_board *board, float magnetometer_scale[3][3], const float magnetometer_bias[3],
                          float accelerometer_scale[3][3], const float accelerometer_bias[3]);
void fieldcal_solve(fieldcal_board *board, fieldcal_result *result);
void fieldcal_reset(fieldcal_board *board);

#endif
