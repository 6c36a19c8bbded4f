/* fieldcal on board: see fieldcal_onboard.h. */
#include "fieldcal_onboard.h"

#include <math.h>
#include <string.h>

/* C99 has no static_assert: an array of negative size stops the compiler. */
#define FIELDCAL_ASSERT(name, holds) typedef char fieldcal_assert_##name[(holds) ? 1 : -1]
FIELDCAL_ASSERT(floats_are_four_bytes, sizeof(float) == 4u);
FIELDCAL_ASSERT(doubles_hold_two_floats, sizeof(double) == 8u);
FIELDCAL_ASSERT(block_is_long_enough, (FIELDCAL_BLOCK_SAMPLES) >= 3);
FIELDCAL_ASSERT(block_is_short_enough, (FIELDCAL_BLOCK_SAMPLES) <= 256);

#define MOMENTS (FIELDCAL_SUMS + 1) /* with their number in front */
#define P FIELDCAL_PARAMETERS
#define Q 10 /* xx yy zz yz xz xy x y z 1, the terms of a quadric */

static const float LARGEST = 1.0e8f;       /* of a reading less its centre: its fourth power is a float */
static const uint32_t FEWEST_SAMPLES = 50u;
static const uint32_t FEWEST_BLOCKS = 10u;
static const double THIRD_DIFFERENCE = 20.0; /* 1 + 9 + 9 + 1: its variance over the noise's */
#define MOST_STEPS 40 /* Newton's take four to six */
static const double CHANCE = 3.0;            /* sd of excess that are taken for chance */
static const double MOST_LEFT = 0.4;         /* residual over what the gyroscope explains, rms */
static const double LEAST_EXCESS = 0.01;     /* of readings that no noise is seen of, but their converter's */

/* Exponents of x, y, z of every moment; those beyond the first 25 only a full matrix needs. Degrees fall from the end. */
static const uint8_t EXPONENTS[MOMENTS][3] = {
    {0, 0, 0}, {1, 0, 0}, {0, 1, 0}, {0, 0, 1}, {2, 0, 0}, {0, 2, 0}, {0, 0, 2}, {0, 1, 1}, {1, 0, 1}, {1, 1, 0},
    {3, 0, 0}, {2, 1, 0}, {2, 0, 1}, {1, 2, 0}, {0, 3, 0}, {0, 2, 1}, {1, 0, 2}, {0, 1, 2}, {0, 0, 3}, {4, 0, 0},
    {0, 4, 0}, {0, 0, 4}, {0, 2, 2}, {2, 0, 2}, {2, 2, 0},
#if FIELDCAL_FULL_MATRIX
    {1, 1, 1}, {3, 1, 0}, {3, 0, 1}, {1, 3, 0}, {0, 3, 1}, {1, 0, 3}, {0, 1, 3}, {2, 1, 1}, {1, 2, 1}, {1, 1, 2},
#endif
};

/* Where the moment of given exponents stands. */
static const uint8_t PLACE[5][5][5] = {
    {{0, 3, 6, 18, 21}, {2, 7, 17, 31, 0}, {5, 15, 22, 0, 0}, {14, 29, 0, 0, 0}, {20, 0, 0, 0, 0}},
    {{1, 8, 16, 30, 0}, {9, 25, 34, 0, 0}, {13, 33, 0, 0, 0}, {28, 0, 0, 0, 0}, {0, 0, 0, 0, 0}},
    {{4, 12, 23, 0, 0}, {11, 32, 0, 0, 0}, {24, 0, 0, 0, 0}, {0, 0, 0, 0, 0}, {0, 0, 0, 0, 0}},
    {{10, 27, 0, 0, 0}, {26, 0, 0, 0, 0}, {0, 0, 0, 0, 0}, {0, 0, 0, 0, 0}, {0, 0, 0, 0, 0}},
    {{19, 0, 0, 0, 0}, {0, 0, 0, 0, 0}, {0, 0, 0, 0, 0}, {0, 0, 0, 0, 0}, {0, 0, 0, 0, 0}},
};

/* The terms of a quadric among the moments. */
static const uint8_t TERMS[Q] = {4, 5, 6, 7, 8, 9, 1, 2, 3, 0};

/* --- Sums ----------------------------------------------------------------------------------------------------------- */

#if FIELDCAL_DOUBLE_SUMS
/* For comparison, and for processors that have double in hardware. */
static void add(fieldcal_sum *sum, float term)
{
    const double value = ((double)sum->high + (double)sum->low) + (double)term;
    sum->high = (float)value;
    sum->low = (float)(value - (double)sum->high);
}
#else
/* Knuth's two-sum: what rounding took from the sum is kept. */
static void add(fieldcal_sum *sum, float term)
{
    const float before = sum->high;
    const float after = before + term;
    const float taken = after - before;
    sum->low += (before - (after - taken)) + (term - taken);
    sum->high = after;
}
#endif

static double value_of(const fieldcal_sum *sum)
{
    return (double)sum->high + (double)sum->low;
}

static void set(fieldcal_sum *sum, double value)
{
    sum->high = (float)value;
    sum->low = (float)(value - (double)sum->high);
}

static bool is_finite(float x)
{
    return (x - x) == 0.0f;
}

static double root(double x)
{
    double y = 0.0;
    if (x > 1.0e-36) {
        y = (double)sqrtf((float)x);
        y = 0.5 * (y + (x / y));
        y = 0.5 * (y + (x / y)); /* twice the digits each time */
    }
    return y;
}

static void noise_gap(fieldcal_noise *noise)
{
    noise->held = 0u;
    noise->in_this = 0u;
}

static void noise_start(fieldcal_noise *noise, uint32_t in_mean)
{
    (void)memset(noise, 0, sizeof(*noise));
    noise->in_mean = ((in_mean >= 1u) && (in_mean <= 16u)) ? in_mean : 1u;
}

/* Third differences: motion, which is smooth, drops out; of noise 20 times the variance is left. */
static void noise_feed(fieldcal_noise *noise, const float x[3])
{
    const float share = (float)noise->in_mean;
    for (int i = 0; i < 3; i++) {
        noise->mean[i] = (noise->in_this == 0u) ? x[i] : (noise->mean[i] + x[i]);
    }
    noise->in_this += 1u;
    if (noise->in_this < noise->in_mean) {
        return;
    }
    noise->in_this = 0u;
    for (int i = 0; i < 3; i++) {
        const float mean = noise->mean[i] / share;
        if (noise->held == 3u) {
            const float d = (mean - noise->last[2][i]) - (3.0f * (noise->last[0][i] - noise->last[1][i]));
            add(&noise->sum[i], share * (d * d));
        }
        noise->last[2][i] = noise->last[1][i];
        noise->last[1][i] = noise->last[0][i];
        noise->last[0][i] = mean;
    }
    if (noise->held == 3u) {
        noise->differences += 1u;
    } else {
        noise->held += 1u;
    }
}

static void noise_merge(fieldcal_noise *into, const fieldcal_noise *from)
{
    for (int i = 0; i < 3; i++) {
        set(&into->sum[i], value_of(&into->sum[i]) + value_of(&from->sum[i]));
    }
    into->differences += from->differences;
    noise_gap(into);
}

/* --- Moments -------------------------------------------------------------------------------------------------------- */

void fieldcal_moments_start(fieldcal_moments *moments, uint32_t in_mean, const float *centre)
{
    (void)memset(moments, 0, sizeof(*moments));
    noise_start(&moments->noise, in_mean);
    if (centre != NULL) {
        for (int i = 0; i < 3; i++) {
            moments->centre[i] = centre[i];
        }
    } else {
        moments->centre[0] = NAN; /* the first reading will be it */
    }
}

void fieldcal_moments_gap(fieldcal_moments *moments)
{
    noise_gap(&moments->noise);
}

fieldcal_code fieldcal_moments_feed(fieldcal_moments *m, const float reading[3])
{
    if (!is_finite(reading[0]) || !is_finite(reading[1]) || !is_finite(reading[2]) || (m->samples == UINT32_MAX)) {
        noise_gap(&m->noise);
        return FIELDCAL_NOT_FED;
    }
    if (!is_finite(m->centre[0])) {
        for (int i = 0; i < 3; i++) {
            m->centre[i] = reading[i];
        }
    }
    const float r[3] = {reading[0] - m->centre[0], reading[1] - m->centre[1], reading[2] - m->centre[2]};
    const float x = r[0];
    const float y = r[1];
    const float z = r[2];
    if (!((x < LARGEST) && (x > -LARGEST) && (y < LARGEST) && (y > -LARGEST) && (z < LARGEST) && (z > -LARGEST))) {
        noise_gap(&m->noise);
        return FIELDCAL_NOT_FED;
    }
    const float xx = x * x;
    const float yy = y * y;
    const float zz = z * z;
    fieldcal_sum *s = m->sum;
    add(&s[0], x);
    add(&s[1], y);
    add(&s[2], z);
    add(&s[3], xx);
    add(&s[4], yy);
    add(&s[5], zz);
    add(&s[6], y * z);
    add(&s[7], x * z);
    add(&s[8], x * y);
    add(&s[9], xx * x);
    add(&s[10], xx * y);
    add(&s[11], xx * z);
    add(&s[12], yy * x);
    add(&s[13], yy * y);
    add(&s[14], yy * z);
    add(&s[15], zz * x);
    add(&s[16], zz * y);
    add(&s[17], zz * z);
    add(&s[18], xx * xx);
    add(&s[19], yy * yy);
    add(&s[20], zz * zz);
    add(&s[21], yy * zz);
    add(&s[22], xx * zz);
    add(&s[23], xx * yy);
#if FIELDCAL_FULL_MATRIX
    const float xy = x * y;
    const float xz = x * z;
    const float yz = y * z;
    add(&s[24], xy * z);
    add(&s[25], xx * xy);
    add(&s[26], xx * xz);
    add(&s[27], yy * xy);
    add(&s[28], yy * yz);
    add(&s[29], zz * xz);
    add(&s[30], zz * yz);
    add(&s[31], xx * yz);
    add(&s[32], yy * xz);
    add(&s[33], zz * xy);
#endif
    noise_feed(&m->noise, r);
    m->samples += 1u;
    return FIELDCAL_OK;
}

static void totals(const fieldcal_moments *moments, double m[MOMENTS])
{
    m[0] = (double)moments->samples;
    for (int k = 1; k < MOMENTS; k++) {
        m[k] = value_of(&moments->sum[k - 1]);
    }
}

static uint8_t place_of(const uint8_t exponents[3], int axis, uint8_t lowered)
{
    uint8_t e[3] = {exponents[0], exponents[1], exponents[2]};
    e[axis] = (uint8_t)(e[axis] - lowered);
    return PLACE[e[0]][e[1]][e[2]];
}

/* Moments about a point `by` further on: exact, as the binomial theorem is. From the end, so that what each is made of
   is still as it was. */
static void translate(double m[MOMENTS], const double by[3])
{
    for (int axis = 0; axis < 3; axis++) {
        for (int k = MOMENTS - 1; k > 0; k--) {
            const uint8_t degree = EXPONENTS[k][axis];
            double power = 1.0;
            for (uint8_t j = 1u; j <= degree; j++) {
                power *= -by[axis] * (double)(degree - j + 1) / (double)j;
                m[k] += power * m[place_of(EXPONENTS[k], axis, j)];
            }
        }
    }
}

/* Moments without what noise of variance v added to their expectation (Hermite polynomials of the readings). */
static void without_noise(const double m[MOMENTS], const double v[3], double out[MOMENTS])
{
    (void)memcpy(out, m, MOMENTS * sizeof(double));
    for (int axis = 0; axis < 3; axis++) {
        for (int k = MOMENTS - 1; k > 0; k--) {
            const uint8_t degree = EXPONENTS[k][axis];
            if (degree >= 2u) {
                const double pairs = 0.5 * (double)degree * (double)(degree - 1);
                out[k] -= pairs * v[axis] * out[place_of(EXPONENTS[k], axis, 2u)];
            }
            if (degree == 4u) {
                out[k] += 3.0 * v[axis] * v[axis] * out[place_of(EXPONENTS[k], axis, 4u)];
            }
        }
    }
}

/* Derivative of `without_noise` by a common factor of v, at what it gave. */
static void noise_slope(const double m[MOMENTS], const double v[3], double out[MOMENTS])
{
    for (int k = 0; k < MOMENTS; k++) {
        out[k] = 0.0;
        for (int axis = 0; axis < 3; axis++) {
            const uint8_t degree = EXPONENTS[k][axis];
            if (degree >= 2u) {
                const double pairs = 0.5 * (double)degree * (double)(degree - 1);
                out[k] -= pairs * v[axis] * m[place_of(EXPONENTS[k], axis, 2u)];
            }
        }
    }
}

/* The moment of the product of two quadrics. */
static double between(const double m[MOMENTS], const double a[Q], const double b[Q])
{
    double sum = 0.0;
    for (int i = 0; i < Q; i++) {
        if (a[i] != 0.0) {
            const uint8_t *p = EXPONENTS[TERMS[i]];
            double own = 0.0;
            for (int j = 0; j < Q; j++) {
                if (b[j] != 0.0) {
                    const uint8_t *e = EXPONENTS[TERMS[j]];
                    own += b[j] * m[PLACE[p[0] + e[0]][p[1] + e[1]][p[2] + e[2]]];
                }
            }
            sum += a[i] * own;
        }
    }
    return sum;
}

fieldcal_code fieldcal_moments_merge(fieldcal_moments *into, const fieldcal_moments *from)
{
    if (from->samples == 0u) {
        return FIELDCAL_OK;
    }
    if (!is_finite(into->centre[0])) {
        (void)memcpy(into->centre, from->centre, sizeof(into->centre));
    }
    double m[MOMENTS];
    double by[3];
    totals(from, m);
    for (int i = 0; i < 3; i++) {
        by[i] = (double)into->centre[i] - (double)from->centre[i];
    }
    translate(m, by);
    for (int k = 1; k < MOMENTS; k++) {
        set(&into->sum[k - 1], value_of(&into->sum[k - 1]) + m[k]);
    }
    into->samples += from->samples;
    noise_merge(&into->noise, &from->noise);
    return FIELDCAL_OK;
}

/* --- Small matrices ------------------------------------------------------------------------------------------------- */

/* A symmetric matrix as L D L', in place; false where it is not positive definite. */
static bool factor(double a[P][P])
{
    for (int j = 0; j < P; j++) {
        const double diagonal = a[j][j];
        double pivot = diagonal;
        for (int k = 0; k < j; k++) {
            pivot -= a[j][k] * a[j][k] * a[k][k];
        }
        if (!(pivot > (1.0e-13 * diagonal))) {
            return false;
        }
        a[j][j] = pivot;
        for (int i = j + 1; i < P; i++) {
            double s = a[i][j];
            for (int k = 0; k < j; k++) {
                s -= a[i][k] * a[j][k] * a[k][k];
            }
            a[i][j] = s / pivot;
        }
    }
    return true;
}

static void solve(double l[P][P], double x[P])
{
    for (int i = 0; i < P; i++) {
        for (int k = 0; k < i; k++) {
            x[i] -= l[i][k] * x[k];
        }
    }
    for (int i = 0; i < P; i++) {
        x[i] /= l[i][i];
    }
    for (int i = P - 1; i >= 0; i--) {
        for (int k = i + 1; k < P; k++) {
            x[i] -= l[k][i] * x[k];
        }
    }
}

/* Jacobi: a (n by n, symmetric) becomes the diagonal of its eigenvalues; v, where wanted, its eigenvectors by columns. */
static void eigen(int n, double a[P][P], double v[3][3])
{
    for (int sweep = 0; sweep < 12; sweep++) {
        bool turned = false;
        for (int p = 0; p < (n - 1); p++) {
            for (int q = p + 1; q < n; q++) {
                const double size = fabs(a[p][p]) + fabs(a[q][q]);
                if (fabs(a[p][q]) > (1.0e-15 * size)) {
                    turned = true;
                    const double tau = (a[q][q] - a[p][p]) / (2.0 * a[p][q]);
                    const double t = ((tau >= 0.0) ? 1.0 : -1.0) / (fabs(tau) + root(1.0 + (tau * tau)));
                    const double c = 1.0 / root(1.0 + (t * t));
                    const double s = t * c;
                    for (int k = 0; k < n; k++) {
                        const double x = a[k][p];
                        const double y = a[k][q];
                        a[k][p] = (c * x) - (s * y);
                        a[k][q] = (s * x) + (c * y);
                    }
                    for (int k = 0; k < n; k++) {
                        const double x = a[p][k];
                        const double y = a[q][k];
                        a[p][k] = (c * x) - (s * y);
                        a[q][k] = (s * x) + (c * y);
                    }
                    for (int k = 0; (v != NULL) && (k < 3); k++) {
                        const double x = v[k][p];
                        const double y = v[k][q];
                        v[k][p] = (c * x) - (s * y);
                        v[k][q] = (s * x) + (c * y);
                    }
                }
            }
        }
        if (!turned) {
            break;
        }
    }
}

/* --- Adjusted least-squares ellipsoid (Kukush, Markovsky and Van Huffel 2004) --------------------------------------- */

/* Coefficient `t` of the quadric's free direction `u`: the trace of its square part is held. */
static double direction(int u, int t)
{
    double value = 0.0;
    if (u < 2) {
        value = (t == u) ? 1.0 : ((t == 2) ? -1.0 : 0.0);
    } else {
#if FIELDCAL_FULL_MATRIX
        const int own = u + 1;
#else
        const int own = u + 4; /* no mixed terms */
#endif
        value = (t == own) ? 1.0 : 0.0;
    }
    return value;
}

static void direction_of(int u, double d[Q])
{
    for (int t = 0; t < Q; t++) {
        d[t] = direction(u, t);
    }
}

/* Which free directions are fitted: of a full build an axis-aligned fit leaves the mixed terms out, by a unit row. */
static bool is_fitted(int u, bool full)
{
    return full || (P == 6) || (u < 2) || (u > 4);
}

/* The quadric of given trace with the least mean square, from moments without noise. */
static bool least_quadric(const double m[MOMENTS], bool full, double quadric[Q])
{
    static const double SPHERE[Q] = {1.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0};
    double h[P][P];
    double x[P];
    double a[Q];
    double b[Q];
    for (int i = 0; i < P; i++) {
        direction_of(i, a);
        const bool fitted = is_fitted(i, full);
        x[i] = fitted ? -between(m, a, SPHERE) : 0.0;
        for (int j = 0; j <= i; j++) {
            direction_of(j, b);
            const double unit = (i == j) ? 1.0 : 0.0;
            h[i][j] = (fitted && is_fitted(j, full)) ? between(m, a, b) : unit;
            h[j][i] = h[i][j];
        }
    }
    if (!factor(h)) {
        return false;
    }
    solve(h, x);
    for (int t = 0; t < Q; t++) {
        quadric[t] = SPHERE[t];
        for (int i = 0; i < P; i++) {
            quadric[t] += x[i] * direction(i, t);
        }
    }
    return true;
}

/* scale and bias for unit length from the quadric y'Ay + b'y + d = 0; false where it is no ellipsoid. */
static bool triad_of(const double quadric[Q], double scale[3][3], double bias[3])
{
    double a[P][P] = {{0.0}};
    double axes[3][3] = {{1.0, 0.0, 0.0}, {0.0, 1.0, 0.0}, {0.0, 0.0, 1.0}};
    double along[3];
    double centre[3];
    double g = -quadric[9];
    for (int i = 0; i < 3; i++) {
        a[i][i] = quadric[i];
    }
    a[1][2] = 0.5 * quadric[3];
    a[0][2] = 0.5 * quadric[4];
    a[0][1] = 0.5 * quadric[5];
    a[2][1] = a[1][2];
    a[2][0] = a[0][2];
    a[1][0] = a[0][1];
    eigen(3, a, axes);
    for (int i = 0; i < 3; i++) {
        if (!(a[i][i] > 1.0e-6)) { /* of a trace of 3 */
            return false;
        }
        along[i] = 0.0;
        for (int k = 0; k < 3; k++) {
            along[i] -= 0.5 * axes[k][i] * quadric[6 + k];
        }
        g += along[i] * along[i] / a[i][i];
        along[i] /= a[i][i];
    }
    if (!(g > 0.0)) {
        return false;
    }
    for (int i = 0; i < 3; i++) {
        centre[i] = (axes[i][0] * along[0]) + (axes[i][1] * along[1]) + (axes[i][2] * along[2]);
        for (int j = 0; j < 3; j++) {
            scale[i][j] = 0.0;
            for (int k = 0; k < 3; k++) {
                scale[i][j] += axes[i][k] * root(a[k][k] / g) * axes[j][k];
            }
        }
    }
    for (int i = 0; i < 3; i++) {
        bias[i] = -((scale[i][0] * centre[0]) + (scale[i][1] * centre[1]) + (scale[i][2] * centre[2]));
    }
    return true;
}

/* out += product of two linear functions (x, y, z, 1). */
static void multiply(const double a[4], const double b[4], double out[Q])
{
    for (int i = 0; i < 3; i++) {
        out[i] += a[i] * b[i];
        out[6 + i] += (a[i] * b[3]) + (a[3] * b[i]);
    }
    out[3] += (a[1] * b[2]) + (a[2] * b[1]);
    out[4] += (a[0] * b[2]) + (a[2] * b[0]);
    out[5] += (a[0] * b[1]) + (a[1] * b[0]);
    out[9] += a[3] * b[3];
}

/* Derivative of a quadric by an axis, a linear function. */
static void derivative(const double r[Q], int axis, double out[4])
{
    static const uint8_t MIXED[3][3] = {{0, 5, 4}, {5, 1, 3}, {4, 3, 2}};
    for (int j = 0; j < 3; j++) {
        out[j] = ((j == axis) ? 2.0 : 1.0) * r[MIXED[axis][j]];
    }
    out[3] = r[6 + axis];
}

/* The two axes that a parameter's scale joins: xx yy zz (yz xz xy). */
static const uint8_t JOINS[6][2] = {{0, 0}, {1, 1}, {2, 2}, {1, 2}, {0, 2}, {0, 1}};

/* Covariance of the parameters (scales, then bias, for unit length): N^-1 V N^-1 / n. N: moments of the sensitivities of
   r = (|h|^2 - 1)/2, h = scale y + bias, without noise. V: variance of the estimating equations by noise v of y, in its
   square and fourth power. Gives the condition number of N, columns normalised; 0 where N is not positive definite. */
static double covariance_of(const double raw[MOMENTS], const double clean[MOMENTS], const double v[3], bool full,
                            double scale[3][3], const double bias[3], double cov[P][P])
{
    double h[3][4];
    double gradient[3][4];
    double rows[P][Q] = {{0.0}};
    double inverse[P][P];
    double work[P][P];
    double variance = 0.0;
    for (int i = 0; i < 3; i++) {
        for (int j = 0; j < 3; j++) {
            h[i][j] = scale[i][j];
        }
        h[i][3] = bias[i];
    }
    for (int i = 0; i < 3; i++) {
        double square[Q] = {0.0};
        static const double ONE[Q] = {0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0};
        for (int j = 0; j < 4; j++) {
            gradient[i][j] = (scale[i][0] * h[0][j]) + (scale[i][1] * h[1][j]) + (scale[i][2] * h[2][j]);
        }
        multiply(gradient[i], gradient[i], square);
        variance += v[i] * between(raw, square, ONE);
    }
    for (int p = 0; p < (P - 3); p++) {
        const uint8_t i = JOINS[p][0];
        const uint8_t j = JOINS[p][1];
        double along[4] = {0.0, 0.0, 0.0, 0.0};
        along[j] = 1.0;
        multiply(h[i], along, rows[p]);
        if (i != j) {
            along[j] = 0.0;
            along[i] = 1.0;
            multiply(h[j], along, rows[p]);
        }
    }
    for (int i = 0; i < 3; i++) {
        for (int j = 0; j < 4; j++) {
            rows[P - 3 + i][6 + j] = h[i][j];
        }
    }
    for (int p = 0; p < P; p++) {
        for (int q = 0; q <= p; q++) {
            const bool fitted = (full || (P == 6) || (((p < 3) || (p > 5)) && ((q < 3) || (q > 5))));
            const double unit = (p == q) ? 1.0 : 0.0;
            inverse[p][q] = fitted ? between(clean, rows[p], rows[q]) : unit;
            inverse[q][p] = inverse[p][q];
            cov[p][q] = fitted ? (variance * between(raw, rows[p], rows[q])) : 0.0;
        }
    }
    for (int p = 0; p < P; p++) {
        if (!(inverse[p][p] > 0.0)) {
            return 0.0;
        }
    }
    for (int p = 0; p < P; p++) {
        for (int q = 0; q < P; q++) {
            work[p][q] = inverse[p][q] / root(inverse[p][p] * inverse[q][q]);
        }
    }
    eigen(P, work, NULL);
    double least = work[0][0];
    double most = work[0][0];
    for (int p = 1; p < P; p++) {
        least = (work[p][p] < least) ? work[p][p] : least;
        most = (work[p][p] > most) ? work[p][p] : most;
    }
    /* What noise does to a sensitivity goes with what it does to r. */
    for (int p = 0; p < P; p++) {
        double second[Q] = {0.0};
        for (int i = 0; i < 3; i++) {
            double slope[4];
            derivative(rows[p], i, slope);
            for (int j = 0; j < 4; j++) {
                slope[j] *= v[i];
            }
            multiply(slope, gradient[i], second);
        }
        (void)memcpy(rows[p], second, sizeof(second));
    }
    for (int p = 0; p < P; p++) {
        for (int q = 0; q <= p; q++) {
            const bool fitted = (full || (P == 6) || (((p < 3) || (p > 5)) && ((q < 3) || (q > 5))));
            cov[p][q] += fitted ? between(raw, rows[p], rows[q]) : 0.0;
            cov[q][p] = cov[p][q];
        }
    }
    if (!(least > 0.0) || !factor(inverse)) {
        return 0.0;
    }
    for (int twice = 0; twice < 2; twice++) { /* N^-1 (N^-1 V)' */
        for (int p = 0; p < P; p++) {
            solve(inverse, cov[p]);
        }
        for (int p = 0; p < P; p++) {
            for (int q = 0; q < p; q++) {
                const double above = cov[q][p];
                cov[q][p] = cov[p][q];
                cov[p][q] = above;
            }
        }
    }
    return root(most / least);
}

/* What is known of the fit, in logged units: y = (z - centre) / spread. */
static void in_logged_units(const fieldcal_limits *limits, double spread, const double centre[3], double scale[3][3],
                            const double bias[3], double cov[P][P], fieldcal_ellipsoid *fit)
{
    static const uint8_t PARAMETER[3][3] = {{0, 5, 4}, {5, 1, 3}, {4, 3, 2}};
    const double f = (double)limits->magnitude;
    const double unit = f / spread;
    double t[9][P] = {{0.0}};
    for (int i = 0; i < 3; i++) {
        const double sign = (double)limits->polarity[i];
        double b = f * bias[i];
        t[i][i] = sign * unit;
        t[3 + i][P - 3 + i] = sign * f;
        for (int j = 0; j < 3; j++) {
            const double own = unit * scale[i][j];
            b -= own * centre[j];
            fit->scale[i][j] = (float)(sign * own);
            if (PARAMETER[i][j] < (P - 3)) {
                t[3 + i][PARAMETER[i][j]] -= sign * unit * centre[j];
            }
        }
        fit->bias[i] = (float)(sign * b);
        if (P > 6) {
            t[6 + i][3 + i] = unit;
        }
    }
    double out[9][9];
    for (int a = 0; a < 9; a++) {
        for (int b = 0; b < 9; b++) {
            out[a][b] = 0.0;
            for (int p = 0; p < P; p++) {
                if (t[a][p] != 0.0) {
                    for (int q = 0; q < P; q++) {
                        out[a][b] += t[a][p] * cov[p][q] * t[b][q];
                    }
                }
            }
        }
    }
    for (int i = 0; i < 3; i++) {
        fit->bias_sd[i] = (float)root(out[3 + i][3 + i]);
        for (int j = 0; j < 3; j++) {
            const int k = (i == j) ? i : (3 + PARAMETER[i][j]);
            fit->scale_sd[i][j] = (float)root(out[k][k]);
        }
    }
    for (int a = 0; a < 6; a++) {
        for (int b = 0; b < 6; b++) {
            fit->covariance[a][b] = (float)out[a][b];
        }
    }
}

fieldcal_code fieldcal_moments_solve(const fieldcal_moments *moments, const fieldcal_limits *limits,
                                     fieldcal_ellipsoid *fit)
{
    double raw[MOMENTS];
    double clean[MOMENTS];
    double slope[MOMENTS];
    double mean[3];
    double centre[3];
    double v[3];
    double quadric[Q];
    double scale[3][3];
    double bias[3];
    double cov[P][P];
    (void)memset(fit, 0, sizeof(*fit));
    fit->samples = moments->samples;
    fit->code = FIELDCAL_TOO_FEW;
    if ((limits->full && (P == 6)) || !(limits->magnitude > 0.0f)) {
        fit->code = FIELDCAL_WRONG_ARGUMENT;
        return fit->code;
    }
    if (moments->samples < FEWEST_SAMPLES) {
        return fit->code;
    }
    fit->code = FIELDCAL_DEGENERATE;
    const double n = (double)moments->samples;
    totals(moments, raw);
    for (int i = 0; i < 3; i++) {
        mean[i] = raw[1 + i] / n;
        centre[i] = (double)moments->centre[i] + mean[i];
    }
    translate(raw, mean);
    const double spread = root((raw[4] + raw[5] + raw[6]) / (3.0 * n));
    if (!(spread > 0.0)) {
        return fit->code;
    }
    const double powers[5] = {1.0 / n, 1.0 / (n * spread), 1.0 / (n * spread * spread),
                              1.0 / (n * spread * spread * spread), 1.0 / (n * spread * spread * spread * spread)};
    for (int k = 0; k < MOMENTS; k++) {
        raw[k] *= powers[EXPONENTS[k][0] + EXPONENTS[k][1] + EXPONENTS[k][2]];
    }
    const bool measured = moments->noise.differences >= FEWEST_SAMPLES;
    for (int i = 0; i < 3; i++) {
        const double from_noise = THIRD_DIFFERENCE * (double)moments->noise.differences * spread * spread;
        v[i] = measured ? (value_of(&moments->noise.sum[i]) / from_noise) : 1.0e-6;
        v[i] = (v[i] > 1.0e-12) ? v[i] : 1.0e-12;
    }
    /* How axes share the noise their differences say; how much there is, the residuals: the factor of v at which nothing
       of them is left. The least mean square is concave in it: Newton's steps, halved where they leave too little of the
       moments. */
    double factor_of_v = 0.0;
    double least = 0.0;
    double most = -1.0; /* not known */
    bool found = false;
    for (int step = 0; (step < MOST_STEPS) && !found; step++) {
        const double w[3] = {factor_of_v * v[0], factor_of_v * v[1], factor_of_v * v[2]};
        double next = 0.5 * (least + factor_of_v);
        without_noise(raw, w, clean);
        if (least_quadric(clean, limits->full, quadric)) {
            noise_slope(clean, v, slope);
            const double left = between(clean, quadric, quadric);
            next = factor_of_v - (left / between(slope, quadric, quadric));
            if (left >= 0.0) {
                least = factor_of_v;
            } else {
                most = factor_of_v;
            }
            next = (next > least) ? next : least;
            found = (fabs(next - factor_of_v) <= (1.0e-9 * next)) || (step == (MOST_STEPS - 1));
        } else if (step == 0) {
            return fit->code;
        } else {
            most = factor_of_v;
        }
        if (!found && (most >= 0.0) && (next >= most)) {
            next = 0.5 * (least + most);
        }
        factor_of_v = next;
    }
    if (!found) {
        return fit->code;
    }
    if (!triad_of(quadric, scale, bias)) {
        return fit->code;
    }
    fit->excess = measured ? (float)factor_of_v : 1.0f;
    for (int i = 0; i < 3; i++) {
        v[i] *= factor_of_v;
        fit->noise_sd[i] = (float)(root(v[i]) * spread);
    }
    const double g = 3.0 / ((scale[0][0] * scale[0][0]) + (scale[1][1] * scale[1][1]) + (scale[2][2] * scale[2][2]) +
                            (2.0 * ((scale[0][1] * scale[0][1]) + (scale[0][2] * scale[0][2]) +
                                    (scale[1][2] * scale[1][2]))));
    fit->residual_rms = (float)(0.5 * root(between(raw, quadric, quadric)) / g);
    fit->condition = (float)covariance_of(raw, clean, v, limits->full, scale, bias, cov);
    if (!(fit->condition > 0.0f)) {
        fit->code = FIELDCAL_TOO_LITTLE_MOTION;
        return fit->code;
    }
    /* What is beyond the sensor's noise, more than by chance, stays alike over samples. */
    const double excess = measured ? factor_of_v : 1.0;
    const double alike = (limits->correlated_samples > 1.0f) ? (double)limits->correlated_samples : 1.0;
    double beyond = 0.0;
    if (measured) {
        const double chance = CHANCE * root((2.0 / n) + (1.54 / (double)moments->noise.differences));
        beyond = (excess > (1.0 + chance)) ? (excess - 1.0 - chance) : 0.0;
    }
    const double level = (((excess - beyond) > 1.0) ? (excess - beyond) : 1.0) + (beyond * alike);
    const double inflation = level / (n * ((excess > LEAST_EXCESS) ? excess : LEAST_EXCESS));
    for (int p = 0; p < P; p++) {
        for (int q = 0; q < P; q++) {
            cov[p][q] *= inflation;
        }
    }
    in_logged_units(limits, spread, centre, scale, bias, cov, fit);
    fit->code = FIELDCAL_OK;
    if (!(fit->condition <= limits->max_condition)) {
        fit->code = FIELDCAL_TOO_LITTLE_MOTION;
    }
    for (int i = 0; (i < 3) && (fit->code == FIELDCAL_OK); i++) {
        if (!(fit->scale_sd[i][i] <= (limits->max_scale_sd * fabsf(fit->scale[i][i])))) {
            fit->code = FIELDCAL_SCALE_UNCERTAIN;
        }
    }
    if ((fit->code == FIELDCAL_OK) && !(fit->residual_rms <= limits->max_residual)) {
        fit->code = FIELDCAL_NOT_A_SPHERE;
    }
    return fit->code;
}

/* --- Attitude ------------------------------------------------------------------------------------------------------- */

static float dot(const float a[3], const float b[3])
{
    return (a[0] * b[0]) + (a[1] * b[1]) + (a[2] * b[2]);
}

static void cross(const float a[3], const float b[3], float out[3])
{
    out[0] = (a[1] * b[2]) - (a[2] * b[1]);
    out[1] = (a[2] * b[0]) - (a[0] * b[2]);
    out[2] = (a[0] * b[1]) - (a[1] * b[0]);
}

static bool make_unit(float v[3])
{
    const float length = sqrtf(dot(v, v));
    if (!(length > 1.0e-15f) || !is_finite(length)) {
        return false;
    }
    for (int i = 0; i < 3; i++) {
        v[i] /= length;
    }
    return true;
}

/* Two observations in closed form (Markley 2002): no characteristic equation, which floats do not solve well. */
static fieldcal_code of_two(float b[2][3], float r[2][3], float w0, float w1, float q[4])
{
    float normal_b[3];
    float normal_r[3];
    float c0[3];
    float c1[3];
    float turn[3];
    float both[3];
    if (!make_unit(b[0]) || !make_unit(b[1]) || !make_unit(r[0]) || !make_unit(r[1])) {
        return FIELDCAL_WRONG_ARGUMENT;
    }
    cross(b[0], b[1], normal_b);
    cross(r[0], r[1], normal_r);
    if ((dot(normal_r, normal_r) < 1.0e-6f) || (dot(normal_b, normal_b) < 1.0e-6f) || !make_unit(normal_b) ||
        !make_unit(normal_r)) {
        return FIELDCAL_WRONG_ARGUMENT; /* along one line */
    }
    /* Half turns about an axis of the reference keep away from the turn that the formula does not reach: the normals are
       brought together where they are least apart. */
    int axis = 3;
    float best = dot(normal_b, normal_r);
    for (int i = 0; i < 3; i++) {
        const float turned = (2.0f * normal_b[i] * normal_r[i]) - dot(normal_b, normal_r);
        if ((dot(normal_b, normal_r) < 0.0f) && (turned > best)) {
            best = turned;
            axis = i;
        }
    }
    for (int i = 0; (axis < 3) && (i < 3); i++) {
        if (i != axis) {
            r[0][i] = -r[0][i];
            r[1][i] = -r[1][i];
            normal_r[i] = -normal_r[i];
        }
    }
    const float one = 1.0f + dot(normal_b, normal_r);
    cross(normal_b, normal_r, turn);
    cross(b[0], r[0], c0);
    cross(b[1], r[1], c1);
    float alpha = one * ((w0 * dot(b[0], r[0])) + (w1 * dot(b[1], r[1])));
    float beta = 0.0f;
    for (int i = 0; i < 3; i++) {
        const float c = (w0 * c0[i]) + (w1 * c1[i]);
        both[i] = normal_b[i] + normal_r[i];
        alpha += turn[i] * c;
        beta += both[i] * c;
    }
    const float gamma = sqrtf((alpha * alpha) + (beta * beta));
    const float along_turn = (alpha >= 0.0f) ? (gamma + alpha) : beta;
    const float along_both = (alpha >= 0.0f) ? beta : (gamma - alpha);
    float p[4];
    for (int i = 0; i < 3; i++) {
        p[i] = (along_turn * turn[i]) + (along_both * both[i]);
    }
    p[3] = along_turn * one;
    if (axis < 3) { /* the half turn undone */
        const int j = (axis + 1) % 3;
        const int k = (axis + 2) % 3;
        q[axis] = p[3];
        q[3] = -p[axis];
        q[j] = -p[k];
        q[k] = p[j];
    } else {
        (void)memcpy(q, p, sizeof(p));
    }
    const float length = sqrtf((q[0] * q[0]) + (q[1] * q[1]) + (q[2] * q[2]) + (q[3] * q[3]));
    for (int i = 0; i < 4; i++) {
        q[i] /= length;
    }
    return is_finite(length) ? FIELDCAL_OK : FIELDCAL_WRONG_ARGUMENT;
}

fieldcal_code fieldcal_attitude_quest(float b[2][3], float r[2][3], const float sigma[2], float q[4])
{
    const float p0 = 1.0f / (sigma[0] * sigma[0]);
    const float p1 = 1.0f / (sigma[1] * sigma[1]);
    return of_two(b, r, p0 / (p0 + p1), p1 / (p0 + p1), q);
}

fieldcal_code fieldcal_attitude_triad(float b[2][3], float r[2][3], float q[4])
{
    return of_two(b, r, 1.0f, 0.0f, q); /* all weight on the first: Wahba's solution is TRIAD's */
}

fieldcal_code fieldcal_attitude_euler(const float field[3], const float gravity[3], float declination, float q[4])
{
    const float length = sqrtf(dot(gravity, gravity));
    if (!(length > 0.0f)) {
        return FIELDCAL_WRONG_ARGUMENT;
    }
    const float side = gravity[1] / length;
    const float nose = gravity[0] / length;
    const float room_side = 1.0f - (side * side);
    const float room_nose = 1.0f - (nose * nose);
    const float half[3] = {
        0.5f * atan2f(side, sqrtf((room_side > 0.0f) ? room_side : 0.0f)), /* Eq. 4: the sine's angle */
        -0.5f * atan2f(nose, sqrtf((room_nose > 0.0f) ? room_nose : 0.0f)),
        0.5f * (declination - atan2f(field[1], field[0])), /* Eq. 2 */
    };
    const float sf = sinf(half[0]);
    const float cf = cosf(half[0]);
    const float st = sinf(half[1]);
    const float ct = cosf(half[1]);
    const float sp = sinf(half[2]);
    const float cp = cosf(half[2]);
    q[0] = (sf * ct * cp) - (cf * st * sp);
    q[1] = (cf * st * cp) + (sf * ct * sp);
    q[2] = (cf * ct * sp) - (sf * st * cp);
    q[3] = (cf * ct * cp) + (sf * st * sp);
    return is_finite(q[3]) ? FIELDCAL_OK : FIELDCAL_WRONG_ARGUMENT;
}

/* --- Gyroscope ------------------------------------------------------------------------------------------------------ */

enum { WEIGHT = 0, SQUARES = 1, PAIRS = 2, AXIS = 3, OF_AXIS = 10 };
enum { X = 0, Y = 1, XX = 2, XY = 3, YY = 4, LAG_X = 5, LAG_Y = 6, LAG_XX = 7, LAG_YY = 8, LAG_XY = 9 };

fieldcal_code fieldcal_rates_start(fieldcal_rates *g, uint32_t block_samples, float forgetting, uint32_t in_mean,
                                   const float *centre)
{
    (void)memset(g, 0, sizeof(*g));
    noise_start(&g->noise, in_mean);
    if ((block_samples < 3u) || (block_samples > 256u) || !(forgetting > 0.0f) || !(forgetting <= 1.0f)) {
        return FIELDCAL_WRONG_ARGUMENT;
    }
    g->block_samples = block_samples;
    g->forgetting = forgetting;
    g->centre[0] = NAN;
    if (centre != NULL) {
        (void)memcpy(g->centre, centre, sizeof(g->centre));
    }
    return FIELDCAL_OK;
}

void fieldcal_rates_gap(fieldcal_rates *g)
{
    noise_gap(&g->noise);
    g->in_block = 0u;
    g->follows = false;
}

static void forget(fieldcal_sum *sum, float share)
{
    sum->high *= share;
    sum->low *= share;
}

/* One equation an axis: y = scale x + bias, y the rate of the attitudes of a block, x the readings' mean. */
static void add_equation(fieldcal_rates *g, const float x[3], const float y[3])
{
    if (g->forgetting < 1.0f) {
        for (int k = 0; k < FIELDCAL_RATE_SUMS; k++) {
            forget(&g->sum[k], (k == SQUARES) ? (g->forgetting * g->forgetting) : g->forgetting);
        }
    }
    add(&g->sum[WEIGHT], 1.0f);
    add(&g->sum[SQUARES], 1.0f);
    if (g->follows) {
        add(&g->sum[PAIRS], 1.0f);
    }
    for (int i = 0; i < 3; i++) {
        fieldcal_sum *s = &g->sum[AXIS + (OF_AXIS * i)];
        add(&s[X], x[i]);
        add(&s[Y], y[i]);
        add(&s[XX], x[i] * x[i]);
        add(&s[XY], x[i] * y[i]);
        add(&s[YY], y[i] * y[i]);
        if (g->follows) {
            add(&s[LAG_X], x[i] + g->last_x[i]);
            add(&s[LAG_Y], y[i] + g->last_y[i]);
            add(&s[LAG_XX], x[i] * g->last_x[i]);
            add(&s[LAG_YY], y[i] * g->last_y[i]);
            add(&s[LAG_XY], (x[i] * g->last_y[i]) + (y[i] * g->last_x[i]));
        }
        g->last_x[i] = x[i];
        g->last_y[i] = y[i];
    }
    g->follows = true;
}

/* The block is whole: slope and mean of its attitudes give the body rate 2 Xi' q_dot (Eq. 10); the readings' mean has
   the weights that a slope gives to what it is the slope of. */
static void close_block(fieldcal_rates *g)
{
    const float m = (float)g->block_samples;
    const float squares = m * ((m * m) - 1.0f) / 12.0f;
    const float interval = 1.0e-6f * (float)(uint32_t)(g->last_us - g->first_us) / (m - 1.0f);
    const float length = sqrtf((g->q_sum[0] * g->q_sum[0]) + (g->q_sum[1] * g->q_sum[1]) +
                               (g->q_sum[2] * g->q_sum[2]) + (g->q_sum[3] * g->q_sum[3]));
    g->in_block = 0u;
    if ((interval > 0.0f) && (length > (0.5f * m))) {
        float e[4];
        float d[4];
        for (int i = 0; i < 4; i++) {
            e[i] = g->q_sum[i] / length;
            d[i] = 2.0f * g->slope_sum[i] / (squares * interval);
        }
        const float y[3] = {
            (e[3] * d[0]) - (d[3] * e[0]) - ((e[1] * d[2]) - (e[2] * d[1])),
            (e[3] * d[1]) - (d[3] * e[1]) - ((e[2] * d[0]) - (e[0] * d[2])),
            (e[3] * d[2]) - (d[3] * e[2]) - ((e[0] * d[1]) - (e[1] * d[0])),
        };
        const float x[3] = {g->rate_sum[0] / squares, g->rate_sum[1] / squares, g->rate_sum[2] / squares};
        add_equation(g, x, y);
    } else {
        g->follows = false;
    }
}

/* Weight of reading k of a block, times the sum of squares of its slope. */
static float share_of(uint32_t k, uint32_t m)
{
    return 0.25f * (float)((k * (m - k)) + ((k + 1u) * (m - 1u - k)));
}

fieldcal_code fieldcal_rates_feed(fieldcal_rates *g, uint32_t t_us, uint32_t max_gap_us, const float q[4],
                                  const float reading[3])
{
    float x[3];
    bool sound = true;
    for (int i = 0; i < 3; i++) {
        sound = sound && is_finite(reading[i]) && is_finite(q[i]);
    }
    if (!sound || !is_finite(q[3]) || (g->samples == UINT32_MAX)) {
        fieldcal_rates_gap(g);
        return FIELDCAL_NOT_FED;
    }
    if (!is_finite(g->centre[0])) {
        (void)memcpy(g->centre, reading, sizeof(g->centre));
    }
    if ((g->samples > 0u) && ((uint32_t)(t_us - g->last_us) > max_gap_us)) {
        fieldcal_rates_gap(g);
    }
    for (int i = 0; i < 3; i++) {
        x[i] = reading[i] - g->centre[i];
    }
    noise_feed(&g->noise, x);
    if (g->in_block == 0u) {
        g->first_us = t_us;
        for (int i = 0; i < 4; i++) {
            g->q_sum[i] = 0.0f;
            g->slope_sum[i] = 0.0f;
            g->last_q[i] = q[i];
        }
        for (int i = 0; i < 3; i++) {
            g->rate_sum[i] = 0.0f;
        }
    }
    const float same = (q[0] * g->last_q[0]) + (q[1] * g->last_q[1]) + (q[2] * g->last_q[2]) + (q[3] * g->last_q[3]);
    const float sign = (same < 0.0f) ? -1.0f : 1.0f;
    const float from_middle = (float)g->in_block - (0.5f * ((float)g->block_samples - 1.0f));
    const float share = share_of(g->in_block, g->block_samples);
    for (int i = 0; i < 4; i++) {
        g->last_q[i] = sign * q[i];
        g->q_sum[i] += g->last_q[i];
        g->slope_sum[i] += from_middle * g->last_q[i];
    }
    for (int i = 0; i < 3; i++) {
        g->rate_sum[i] += share * x[i];
    }
    g->last_us = t_us;
    g->samples += 1u;
    g->in_block += 1u;
    if (g->in_block == g->block_samples) {
        close_block(g);
    }
    return FIELDCAL_OK;
}

fieldcal_code fieldcal_rates_merge(fieldcal_rates *into, const fieldcal_rates *from)
{
    if ((into->forgetting < 1.0f) || (from->forgetting < 1.0f) || (into->block_samples != from->block_samples)) {
        return FIELDCAL_NOT_MERGEABLE;
    }
    if (from->samples == 0u) {
        return FIELDCAL_OK;
    }
    if (!is_finite(into->centre[0])) {
        (void)memcpy(into->centre, from->centre, sizeof(into->centre));
    }
    const double weight = value_of(&from->sum[WEIGHT]);
    const double pairs = value_of(&from->sum[PAIRS]);
    for (int k = 0; k < AXIS; k++) {
        set(&into->sum[k], value_of(&into->sum[k]) + value_of(&from->sum[k]));
    }
    for (int i = 0; i < 3; i++) {
        const double by = (double)from->centre[i] - (double)into->centre[i]; /* x there + by = x here */
        fieldcal_sum *to = &into->sum[AXIS + (OF_AXIS * i)];
        double s[OF_AXIS];
        for (int k = 0; k < OF_AXIS; k++) {
            s[k] = value_of(&from->sum[AXIS + (OF_AXIS * i) + k]);
        }
        s[XX] += by * ((2.0 * s[X]) + (by * weight));
        s[XY] += by * s[Y];
        s[LAG_XX] += by * (s[LAG_X] + (by * pairs));
        s[LAG_XY] += by * s[LAG_Y];
        s[X] += by * weight;
        s[LAG_X] += 2.0 * by * pairs;
        for (int k = 0; k < OF_AXIS; k++) {
            set(&to[k], value_of(&to[k]) + s[k]);
        }
    }
    into->samples += from->samples;
    noise_merge(&into->noise, &from->noise);
    fieldcal_rates_gap(into);
    return FIELDCAL_OK;
}

/* Share of a reading's noise that its mean over a block keeps. */
static double noise_kept(uint32_t m)
{
    const double squares = (double)m * (((double)m * (double)m) - 1.0) / 12.0;
    double kept = 0.0;
    for (uint32_t k = 0u; k < m; k++) {
        const double share = (double)share_of(k, m) / squares;
        kept += share * share;
    }
    return kept;
}

void fieldcal_rates_solve(const fieldcal_rates *g, const float polarity[3], float max_scale_sd,
                          fieldcal_gyroscope_fit *fit)
{
    (void)memset(fit, 0, sizeof(*fit));
    fit->samples = g->samples;
    const double weight = value_of(&g->sum[WEIGHT]);
    const double pairs = value_of(&g->sum[PAIRS]);
    for (int i = 0; i < 3; i++) {
        fit->code[i] = FIELDCAL_TOO_FEW;
        if (!(weight >= (double)FEWEST_BLOCKS) || !(pairs > 1.0)) {
            continue;
        }
        double s[OF_AXIS];
        for (int k = 0; k < OF_AXIS; k++) {
            s[k] = value_of(&g->sum[AXIS + (OF_AXIS * i) + k]);
        }
        const double mean_x = s[X] / weight;
        const double mean_y = s[Y] / weight;
        const double xx = (s[XX] / weight) - (mean_x * mean_x);
        const double xy = (s[XY] / weight) - (mean_x * mean_y);
        const double yy = (s[YY] / weight) - (mean_y * mean_y);
        double noise = 0.0;
        if (g->noise.differences >= FEWEST_SAMPLES) {
            noise = value_of(&g->noise.sum[i]) / (THIRD_DIFFERENCE * (double)g->noise.differences) *
                    noise_kept(g->block_samples);
        }
        const double clean = xx - noise; /* noise in the regressor would pull the scale towards zero */
        if (!(clean > (0.5 * xx)) || !(xx > 0.0)) {
            fit->code[i] = FIELDCAL_NOT_EXCITED;
            continue;
        }
        const double scale = xy / clean;
        const double bias = mean_y - (scale * mean_x);
        const double spare = weight - 2.0;
        double variance = (yy - (2.0 * scale * xy) + (scale * scale * xx)) * weight / spare;
        variance = (variance > 0.0) ? variance : 0.0;
        const double neighbours = (s[LAG_YY] - (scale * s[LAG_XY]) + (scale * scale * s[LAG_XX]) - (bias * s[LAG_Y]) +
                                   (scale * bias * s[LAG_X])) / pairs + (bias * bias);
        double correlation = (variance > 0.0) ? (neighbours / variance) : 0.0;
        correlation = (correlation < 0.95) ? correlation : 0.95;
        correlation = (correlation > -0.95) ? correlation : -0.95;
        const double alike = (correlation > 0.0) ? ((1.0 + correlation) / (1.0 - correlation)) : 1.0;
        const double per_weight = variance * alike * value_of(&g->sum[SQUARES]) / (weight * weight);
        const double scale_variance = per_weight * xx / (clean * clean);
        const double at = mean_x + (double)g->centre[i];
        fit->scale[i] = (float)scale;
        fit->bias[i] = (float)(bias - (scale * (double)g->centre[i]));
        fit->scale_sd[i] = (float)root(scale_variance);
        fit->bias_sd[i] = (float)root(per_weight + (at * at * scale_variance));
        fit->covariance[i] = (float)(-at * scale_variance);
        fit->residual_rms[i] = (float)root(variance);
        fit->correlation[i] = (float)correlation;
        fit->code[i] = FIELDCAL_OK;
        if (!(fit->scale_sd[i] <= (max_scale_sd * fabsf(fit->scale[i])))) {
            fit->code[i] = FIELDCAL_SCALE_UNCERTAIN;
        } else if (variance > (MOST_LEFT * MOST_LEFT * scale * scale * clean)) {
            fit->code[i] = FIELDCAL_CONTRADICTS;
        } else if ((fit->scale[i] * polarity[i]) < 0.0f) {
            fit->code[i] = FIELDCAL_WRONG_SIGN;
        } else {
            /* it stands */
        }
    }
}

/* --- Dumps ---------------------------------------------------------------------------------------------------------- */

static const uint8_t MAGIC[4] = {0x46u, 0x43u, 0x4Du, 0x31u}; /* FCM1 */

static uint32_t checksum(const uint8_t *bytes, size_t size)
{
    uint32_t crc = 0xFFFFFFFFu; /* CRC-32, as zlib's */
    for (size_t k = 0u; k < size; k++) {
        crc ^= bytes[k];
        for (int bit = 0; bit < 8; bit++) {
            crc = ((crc & 1u) != 0u) ? ((crc >> 1) ^ 0xEDB88320u) : (crc >> 1);
        }
    }
    return ~crc;
}

static uint8_t *put(uint8_t *to, uint32_t word)
{
    for (int k = 0; k < 4; k++) {
        to[k] = (uint8_t)((word >> (8 * k)) & 0xFFu);
    }
    return &to[4];
}

static uint8_t *put_float(uint8_t *to, float value)
{
    uint32_t word;
    (void)memcpy(&word, &value, sizeof(word));
    return put(to, word);
}

static uint8_t *put_sum(uint8_t *to, const fieldcal_sum *sum)
{
    return put_float(put_float(to, sum->high), sum->low);
}

static uint32_t get(const uint8_t **from)
{
    const uint8_t *b = *from;
    *from = &b[4];
    return (uint32_t)b[0] | ((uint32_t)b[1] << 8) | ((uint32_t)b[2] << 16) | ((uint32_t)b[3] << 24);
}

static float get_float(const uint8_t **from)
{
    const uint32_t word = get(from);
    float value;
    (void)memcpy(&value, &word, sizeof(value));
    return value;
}

static void get_sum(const uint8_t **from, fieldcal_sum *sum)
{
    sum->high = get_float(from);
    sum->low = get_float(from);
}

/* magic; sensor, sums, block (2); samples; differences; centre; noise; sums; checksum */
static size_t dump(const fieldcal_sum *sum, uint8_t sums, const fieldcal_noise *noise, const float centre[3],
                   fieldcal_sensor sensor, uint32_t block, uint32_t samples, uint8_t *buffer, size_t size)
{
    const size_t whole = FIELDCAL_DUMP_BYTES(sums);
    if (size < whole) {
        return 0u;
    }
    uint8_t *to = buffer;
    (void)memcpy(to, MAGIC, sizeof(MAGIC));
    to = put(&to[4], (uint32_t)sensor | ((uint32_t)sums << 8) | (block << 16));
    to = put(put(to, samples), noise->differences);
    for (int i = 0; i < 3; i++) {
        to = put_float(to, centre[i]);
    }
    for (int i = 0; i < 3; i++) {
        to = put_sum(to, &noise->sum[i]);
    }
    for (int k = 0; k < (int)sums; k++) {
        to = put_sum(to, &sum[k]);
    }
    (void)put(to, checksum(buffer, whole - 4u));
    return whole;
}

static fieldcal_code load(fieldcal_sum *sum, uint8_t sums, fieldcal_noise *noise, float centre[3],
                          fieldcal_sensor sensor, uint32_t *block, uint32_t *samples, const uint8_t *buffer, size_t size)
{
    const size_t whole = FIELDCAL_DUMP_BYTES(sums);
    if (size < whole) {
        return FIELDCAL_BAD_DUMP;
    }
    const uint8_t *from = &buffer[whole - 4u];
    if ((memcmp(buffer, MAGIC, sizeof(MAGIC)) != 0) || (get(&from) != checksum(buffer, whole - 4u))) {
        return FIELDCAL_BAD_DUMP;
    }
    from = &buffer[4];
    const uint32_t head = get(&from);
    if ((head & 0xFFFFu) != ((uint32_t)sensor | ((uint32_t)sums << 8))) {
        return FIELDCAL_BAD_DUMP;
    }
    *block = head >> 16;
    *samples = get(&from);
    noise->differences = get(&from);
    noise_gap(noise);
    for (int i = 0; i < 3; i++) {
        centre[i] = get_float(&from);
    }
    for (int i = 0; i < 3; i++) {
        get_sum(&from, &noise->sum[i]);
    }
    for (int k = 0; k < (int)sums; k++) {
        get_sum(&from, &sum[k]);
    }
    return FIELDCAL_OK;
}

size_t fieldcal_moments_dump(const fieldcal_moments *m, fieldcal_sensor sensor, uint8_t *buffer, size_t size)
{
    return dump(m->sum, FIELDCAL_SUMS, &m->noise, m->centre, sensor, 0u, m->samples, buffer, size);
}

fieldcal_code fieldcal_moments_load(fieldcal_moments *m, fieldcal_sensor sensor, const uint8_t *buffer, size_t size)
{
    uint32_t block = 0u;
    return load(m->sum, FIELDCAL_SUMS, &m->noise, m->centre, sensor, &block, &m->samples, buffer, size);
}

size_t fieldcal_rates_dump(const fieldcal_rates *g, uint8_t *buffer, size_t size)
{
    if (g->forgetting < 1.0f) {
        return 0u; /* what was forgotten cannot be merged */
    }
    return dump(g->sum, FIELDCAL_RATE_SUMS, &g->noise, g->centre, FIELDCAL_GYROSCOPE, g->block_samples, g->samples,
                buffer, size);
}

fieldcal_code fieldcal_rates_load(fieldcal_rates *g, const uint8_t *buffer, size_t size)
{
    uint32_t block = 0u;
    const fieldcal_code code = load(g->sum, FIELDCAL_RATE_SUMS, &g->noise, g->centre, FIELDCAL_GYROSCOPE, &block,
                                    &g->samples, buffer, size);
    if (code != FIELDCAL_OK) {
        return code;
    }
    if ((block < 3u) || (block > 256u)) {
        return FIELDCAL_BAD_DUMP;
    }
    g->block_samples = block;
    g->forgetting = 1.0f;
    fieldcal_rates_gap(g);
    return FIELDCAL_OK;
}

/* --- The duty ------------------------------------------------------------------------------------------------------- */

void fieldcal_start(fieldcal_board *board)
{
    (void)memset(board, 0, sizeof(*board));
    fieldcal_moments_start(&board->magnetometer, FIELDCAL_MAGNETOMETER_IN_MEAN, NULL);
    fieldcal_moments_start(&board->accelerometer, FIELDCAL_ACCELEROMETER_IN_MEAN, NULL);
    (void)fieldcal_rates_start(&board->gyroscope, FIELDCAL_BLOCK_SAMPLES, FIELDCAL_FORGETTING,
                               FIELDCAL_MAGNETOMETER_IN_MEAN, NULL);
}

void fieldcal_reset(fieldcal_board *board)
{
    fieldcal_start(board);
}

void fieldcal_set_vectors(fieldcal_board *board, float magnetometer_scale[3][3], const float magnetometer_bias[3],
                          float accelerometer_scale[3][3], const float accelerometer_bias[3])
{
    (void)memcpy(board->scale[0], magnetometer_scale, sizeof(board->scale[0]));
    (void)memcpy(board->scale[1], accelerometer_scale, sizeof(board->scale[1]));
    (void)memcpy(board->bias[0], magnetometer_bias, sizeof(board->bias[0]));
    (void)memcpy(board->bias[1], accelerometer_bias, sizeof(board->bias[1]));
    board->known = true;
}

fieldcal_code fieldcal_feed(fieldcal_board *board, uint32_t t_us, const float gyroscope[3], const float accelerometer[3],
                            const float *magnetometer)
{
    static const float FIELD[3] = FIELDCAL_FIELD_NED;
    static const float SIGMA[2] = FIELDCAL_DIRECTION_SD;
    fieldcal_code code = fieldcal_moments_feed(&board->accelerometer, accelerometer);
    if (magnetometer != NULL) {
        const fieldcal_code own = fieldcal_moments_feed(&board->magnetometer, magnetometer);
        code = (code == FIELDCAL_OK) ? own : code;
        if ((code == FIELDCAL_OK) && board->known) {
            float r[2][3] = {{FIELD[0], FIELD[1], FIELD[2]}, {0.0f, 0.0f, FIELDCAL_GRAVITY_SIGN}};
            float b[2][3];
            float q[4];
            for (int i = 0; i < 3; i++) {
                b[0][i] = dot(board->scale[0][i], magnetometer) + board->bias[0][i];
                b[1][i] = dot(board->scale[1][i], accelerometer) + board->bias[1][i];
            }
            const float field = sqrtf(dot(b[0], b[0])) / FIELDCAL_FIELD_NORM;
            const float gravity = sqrtf(dot(b[1], b[1])) / FIELDCAL_GRAVITY;
            const bool alone = (fabsf(field - 1.0f) <= FIELDCAL_MAX_LENGTH_EXCESS) &&
                               (fabsf(gravity - 1.0f) <= FIELDCAL_MAX_LENGTH_EXCESS);
            if (alone && (fieldcal_attitude_quest(b, r, SIGMA, q) == FIELDCAL_OK)) {
                code = fieldcal_rates_feed(&board->gyroscope, t_us, FIELDCAL_MAX_GAP_US, q, gyroscope);
            } else {
                fieldcal_rates_gap(&board->gyroscope);
            }
        }
    }
    return code;
}

void fieldcal_solve(fieldcal_board *board, fieldcal_result *result)
{
    static const float POLARITY[3][3] = {FIELDCAL_MAGNETOMETER_POLARITY, FIELDCAL_ACCELEROMETER_POLARITY,
                                         FIELDCAL_GYROSCOPE_POLARITY};
    fieldcal_limits limits = {0.0f, {1.0f, 1.0f, 1.0f}, false, 1.0f, FIELDCAL_MAX_CONDITION, FIELDCAL_MAX_SCALE_SD,
                              FIELDCAL_MAX_RESIDUAL};
    limits.full = FIELDCAL_FULL_MATRIX != 0;
    limits.magnitude = FIELDCAL_FIELD_NORM;
    limits.correlated_samples = FIELDCAL_MAGNETOMETER_CORRELATED;
    (void)memcpy(limits.polarity, POLARITY[0], sizeof(limits.polarity));
    (void)fieldcal_moments_solve(&board->magnetometer, &limits, &result->magnetometer);
    limits.magnitude = FIELDCAL_GRAVITY;
    limits.correlated_samples = FIELDCAL_ACCELEROMETER_CORRELATED;
    (void)memcpy(limits.polarity, POLARITY[1], sizeof(limits.polarity));
    (void)fieldcal_moments_solve(&board->accelerometer, &limits, &result->accelerometer);
    fieldcal_rates_solve(&board->gyroscope, POLARITY[2], FIELDCAL_GYROSCOPE_MAX_SCALE_SD, &result->gyroscope);
    if (!board->known && (result->magnetometer.code == FIELDCAL_OK) && (result->accelerometer.code == FIELDCAL_OK)) {
        fieldcal_set_vectors(board, result->magnetometer.scale, result->magnetometer.bias, result->accelerometer.scale,
                             result->accelerometer.bias);
    }
}
