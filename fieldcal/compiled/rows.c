/* The joint estimator's samples and rows: what fieldcal/estimation/joint/measurement_model.py does with whole arrays,
 * done interval by interval, so that an interval's Jacobians stay in a processor's cache. Names, units and axes are the
 * same as there; its NumPy code is the reference that tests compare this with.
 *
 * n samples, m rows (samples at which vector triads are compared), K knots, p parameters, g of them the gyroscope's.
 * A knot has 12 states: attitude (3), velocity, acceleration, jerk (3 each); a row has a derivative by attitude and
 * acceleration, its six SENSED states. Nothing is allocated here. */
#include "rotation.h"
#include <stdint.h>
#include <string.h>

#define STATES 12
#define SENSED 6
#define COLUMNS 64 /* most of a row: parameters, residual, three of gyroscope noise */
static const int SENSED_STATE[SENSED] = {0, 1, 2, 6, 7, 8};

/* Right-hand sides after the p columns of the parameters, as in chain_solver.py. */
enum { GRADIENT, SENSORS, JUMP, MOTION, BRIDGE, RIGHTS };

/* A vector triad. Columns in theta are -1 where a parameter is not estimated. */
typedef struct {
    int64_t is_accelerometer, column, cross_column, crosses, delay_column, dip_column, arm_column;
    const double *x;         /* (m, 3) readings with optional terms applied */
    const double *raw;       /* (m, 3) without */
    const uint8_t *valid;    /* (m,) */
    const int64_t *cross;    /* (crosses, 2) axis and other axis of each cross-axis term */
    const double *constants; /* (6,) lambda', b' */
    const double *delay;     /* (1,) s, or NULL without */
    const double *slow_rate; /* (m, 3) rad/s, with a delay */
    const double *field;     /* magnetometer: (2, 3) local field and its derivative by the dip */
    const double *motion;    /* accelerometer: (K, 9) translation */
    const double *arm;       /* accelerometer: (3,) m */
    const double *turning;   /* accelerometer: (2, m, 3) rate, rad/s, and its derivative, or NULL where no arm matters */
    double gravity;          /* accelerometer: signed, m/s^2 */
} Triad;

typedef struct {
    int64_t samples, rows, knots, vectors, parameters, gyroscope, signals;
    const double *t;        /* (n,) s */
    const double *q;        /* (n, 4) sensor axes to inertial */
    const double *share;    /* (n,) of the interval that has passed */
    const int64_t *index;   /* (K,) sample of each knot */
    const uint8_t *joined;  /* (K-1,) */
    const int64_t *at;      /* (m,) sample of each row */
    const double *signal;   /* (n, signals): the gyroscope's parameter j turns the attitude at the rate */
    const int64_t *which;   /* (g,)  R_nb[:, axis_j] gain_j signal[:, which_j] */
    const int64_t *axis;    /* (g,) */
    const double *gain;     /* (g,) */
    Triad triad[2];
} Record;

/* Last sample of the interval that begins at knot k, and the row that follows its last. */
INLINED int64_t end_of(const Record *r, int64_t k) { return k + 1 < r->knots ? r->index[k + 1] : r->samples - 1; }
INLINED int64_t rows_until(const Record *r, int64_t row, int64_t k)
{
    while (row < r->rows && (k + 1 == r->knots || r->at[row] < r->index[k + 1]))
        row++;
    return row;
}

/* S(change) + S(rate)^2: acceleration about the centre of mass per metre of lever arm. */
INLINED void lever_arm_geometry(const Record *r, const Triad *triad, int64_t row, double out[3][3])
{
    const double *w = triad->turning + 3 * row, *c = triad->turning + 3 * (r->rows + row);
    double square = w[0] * w[0] + w[1] * w[1] + w[2] * w[2];
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++)
            out[i][j] = w[i] * w[j] - (i == j ? square : 0.0);
    out[0][1] -= c[2], out[1][0] += c[2];
    out[0][2] += c[1], out[2][0] -= c[1];
    out[1][2] -= c[0], out[2][1] += c[0];
}

/* Prediction `sensed` for a triad, SI, sensor axes, and the sensed `vector`, inertial axes; `turn` is A(q). */
INLINED void sense(const Record *r, const Triad *triad, int64_t row, int64_t k, const double turn[3][3],
                   double sensed[3], double vector[3])
{
    if (triad->is_accelerometer) {
        double share = r->share[r->at[row]], sign = copysign(1.0, triad->gravity);
        const double *before = triad->motion + 9 * k + 3;
        const double *after = triad->motion + 9 * (k + 1 < r->knots ? k + 1 : k) + 3;
        for (int i = 0; i < 3; i++)
            vector[i] = -sign * ((1.0 - share) * before[i] + share * after[i]);
        vector[2] += triad->gravity;
        transform(turn, vector, sensed);
        if (triad->turning) {
            double geometry[3][3], about[3];
            lever_arm_geometry(r, triad, row, geometry);
            transform(geometry, triad->arm, about);
            for (int i = 0; i < 3; i++)
                sensed[i] -= sign * about[i];
        }
    } else {
        memcpy(vector, triad->field, 3 * sizeof(double));
        transform(turn, vector, sensed);
    }
    if (triad->delay) {
        double turned[3], q[4], late[3][3], now[3] = {sensed[0], sensed[1], sensed[2]};
        for (int i = 0; i < 3; i++)
            turned[i] = -*triad->delay * triad->slow_rate[3 * row + i];
        from_rotation_vector(turned, q);
        body_from_inertial(q, late);
        transform(late, now, sensed);
    }
}

INLINED double residual_of(const Triad *triad, int64_t row, const double sensed[3], int i)
{
    if (!triad->valid[row])
        return 0.0;
    return triad->x[3 * row + i] - (sensed[i] - triad->constants[3 + i]) / triad->constants[i];
}

/* Minus the derivatives of a triad's three residuals at a row: `by_knot` by attitude and acceleration, `by_parameter`
 * by theta; `moved` (3, g) is the derivative of the attitude error by the gyroscope's parameters. */
INLINED void sensitivity(const Record *r, const Triad *triad, int64_t row, const double turn[3][3],
                         const double sensed[3], const double vector[3], const double *moved,
                         double by_knot[3][SENSED], double by_parameter[3][COLUMNS])
{
    int64_t g = r->gyroscope;
    double valid = triad->valid[row], late[3], geometry[3][3], turned[3], sign = copysign(1.0, triad->gravity);
    if (triad->delay_column >= 0)
        cross(triad->slow_rate + 3 * row, sensed, late);
    if (triad->arm_column >= 0)
        lever_arm_geometry(r, triad, row, geometry);
    if (triad->dip_column >= 0)
        transform(turn, triad->field + 3, turned);
    for (int i = 0; i < 3; i++) {
        double gain = valid / triad->constants[i], *out = by_parameter[i];
        /* A S(vector): a rotation of the attitude turns what is sensed. */
        double *knot = by_knot[i];
        knot[0] = gain * (turn[i][1] * vector[2] - turn[i][2] * vector[1]);
        knot[1] = gain * (turn[i][2] * vector[0] - turn[i][0] * vector[2]);
        knot[2] = gain * (turn[i][0] * vector[1] - turn[i][1] * vector[0]);
        for (int j = 0; j < 3; j++)
            knot[3 + j] = triad->is_accelerometer ? -sign * gain * turn[i][j] : 0.0;
        memset(out, 0, COLUMNS * sizeof(double));
        for (int64_t j = 0; j < g; j++)
            out[j] = knot[0] * moved[j] + knot[1] * moved[g + j] + knot[2] * moved[2 * g + j];
        /* Translation and lever arm are noise to the scale: gravity alone determines it. */
        double steady = triad->is_accelerometer ? triad->gravity * turn[i][2] : sensed[i];
        out[triad->column + i] = -gain * (steady - triad->constants[3 + i]) / triad->constants[i];
        out[triad->column + 3 + i] = -gain;
        if (triad->delay_column >= 0)
            out[triad->delay_column] = gain * late[i];
        if (triad->dip_column >= 0)
            out[triad->dip_column] = gain * turned[i];
        if (triad->arm_column >= 0)
            for (int j = 0; j < 3; j++)
                out[triad->arm_column + j] = -sign * gain * geometry[i][j];
    }
    if (triad->cross_column >= 0)
        for (int64_t k = 0; k < triad->crosses; k++)
            by_parameter[triad->cross[2 * k]][triad->cross_column + k] =
                -valid * triad->raw[3 * row + triad->cross[2 * k + 1]];
}

/* Integral of the gyroscope's parameters over the interval of knot k, trapezoidal: `ends` (3, g) over all of it, and at
 * each of its rows `moved` (rows, 3, g), less the share of `ends` that has passed. */
INLINED void turned_by_gyroscope(const Record *r, int64_t k, int64_t first_row, int64_t last_row, double *moved,
                                 double *ends)
{
    int64_t g = r->gyroscope, row = first_row, last = end_of(r, k);
    double total[3 * COLUMNS], before[3 * COLUMNS], now[3 * COLUMNS], turn[3][3];
    memset(total, 0, sizeof total);
    for (int64_t s = r->index[k]; s <= last; s++) {
        body_from_inertial(r->q + 4 * s, turn);
        for (int64_t j = 0; j < g; j++) {
            double rate = r->gain[j] * r->signal[r->signals * s + r->which[j]];
            for (int i = 0; i < 3; i++)
                now[i * g + j] = turn[r->axis[j]][i] * rate;
        }
        if (s > r->index[k]) {
            double half = 0.5 * (r->t[s] - r->t[s - 1]);
            for (int64_t j = 0; j < 3 * g; j++)
                total[j] += half * (now[j] + before[j]);
        }
        memcpy(before, now, 3 * g * sizeof(double));
        if (row < last_row && r->at[row] == s)
            memcpy(moved + 3 * g * (row++ - first_row), total, 3 * g * sizeof(double));
    }
    if (k + 1 == r->knots || !r->joined[k])
        memset(total, 0, sizeof total);
    memcpy(ends, total, 3 * g * sizeof(double));
    for (row = first_row; row < last_row; row++)
        for (int64_t j = 0; j < 3 * g; j++)
            moved[3 * g * (row - first_row) + j] -= r->share[r->at[row]] * ends[j];
}

/* The gyroscope integrated from every knot, the jump to the next knot spread over the interval: q (n, 4), jump
 * (K-1, 3), from rate (n, 3), rad/s, and the knots' attitudes (K, 4). */
EXPORTED void trajectory(const Record *r, const double *rate, const double *at_knots, double *q, double *jump)
{
    for (int64_t k = 0; k < r->knots; k++) {
        int64_t first = r->index[k], stop = k + 1 < r->knots ? r->index[k + 1] : r->samples;
        double now[4], step[4], spread[3], turned[4], gone[4], *c = jump + 3 * k;
        memcpy(now, at_knots + 4 * k, sizeof now);
        for (int64_t s = first; s < stop; s++) {
            memcpy(q + 4 * s, now, sizeof now);
            if (s + 1 < r->samples) {
                rotation_step(r->t[s + 1] - r->t[s], rate + 3 * s, rate + 3 * s + 3, step);
                multiply(now, step, now);
            }
        }
        if (k + 1 == r->knots)
            break;
        if (!r->joined[k]) {
            memset(c, 0, 3 * sizeof(double));
            continue;
        }
        conjugate(now, turned);
        multiply(at_knots + 4 * (k + 1), turned, gone);
        to_rotation_vector(gone, c);
        for (int64_t s = first; s < stop; s++) {
            for (int i = 0; i < 3; i++)
                spread[i] = r->share[s] * c[i];
            from_rotation_vector(spread, turned);
            multiply(turned, q + 4 * s, q + 4 * s);
        }
    }
}

/* Logged minus predicted, (m, 3 vectors), units of x. */
EXPORTED void residuals(const Record *r, double *residual)
{
    int64_t row = 0, width = 3 * r->vectors;
    for (int64_t k = 0; k < r->knots; k++)
        for (int64_t stop = rows_until(r, row, k); row < stop; row++) {
            double turn[3][3], sensed[3], vector[3];
            body_from_inertial(r->q + 4 * r->at[row], turn);
            for (int64_t v = 0; v < r->vectors; v++) {
                sense(r, &r->triad[v], row, k, turn, sensed, vector);
                for (int i = 0; i < 3; i++)
                    residual[width * row + 3 * v + i] = residual_of(&r->triad[v], row, sensed, i);
            }
        }
}

/* Normal equations of the rows (`accumulate`), whitened by `weight` (m, r) = 1/sigma^2: added to `diagonal` (K, 12, 12),
 * `below` (K-1, 12, 12), `right` (K, 12, p + RIGHTS), `parameters` (p, p), `parameters_right` (p, RIGHTS); what reacts
 * to the probes to `by_knots` (K, 6, 2r + 3) and `by_parameters` (p + 1, 2r + 3); `ends` (K, 3, g) is written.
 *
 * `signs` (m, r) and `bridge` (m, 3) are the probe's; `moved` is room for (most rows of an interval, 3, g).
 *
 * With B a row's derivatives by its knots' states and s the share, those by the knot before are (1 - s) B and by the
 * knot after s B: sums of B'X, s B'X, s^2 B'B over an interval give all of its blocks. */
EXPORTED void normal_rows(const Record *r, const double *weight, const double *signs, const double *bridge,
                          double *moved, double *diagonal, double *below, double *right, double *parameters,
                          double *parameters_right, double *by_knots, double *by_parameters, double *ends)
{
    int64_t p = r->parameters, width = 3 * r->vectors, reactions = 2 * width + 3, rights = p + RIGHTS, row = 0;
    int64_t columns = p + 4; /* parameters, residual, gyroscope noise about three axes */
    double square[COLUMNS][COLUMNS], by_signs[6][COLUMNS], noise_square[6];
    memset(square, 0, sizeof square), memset(by_signs, 0, sizeof by_signs), memset(noise_square, 0, sizeof noise_square);
    for (int64_t k = 0; k < r->knots; k++) {
        int64_t first = row, stop = rows_until(r, row, k), next = k + 1 < r->knots ? k + 1 : k;
        double sums[2][SENSED][COLUMNS], blocks[3][SENSED][SENSED];
        memset(sums, 0, sizeof sums), memset(blocks, 0, sizeof blocks);
        turned_by_gyroscope(r, k, first, stop, moved, ends + 3 * r->gyroscope * k);
        for (; row < stop; row++) {
            double share = r->share[r->at[row]], turn[3][3], sensed[3], vector[3];
            body_from_inertial(r->q + 4 * r->at[row], turn);
            for (int64_t v = 0; v < r->vectors; v++) {
                const Triad *triad = &r->triad[v];
                double b[3][SENSED], x[3][COLUMNS];
                sense(r, triad, row, k, turn, sensed, vector);
                sensitivity(r, triad, row, turn, sensed, vector, moved + 3 * r->gyroscope * (row - first), b, x);
                for (int i = 0; i < 3; i++) {
                    int64_t c = 3 * v + i;
                    double root = sqrt(weight[width * row + c]), sign = signs[width * row + c], noise = 0.0;
                    for (int j = 0; j < SENSED; j++)
                        b[i][j] *= root;
                    for (int64_t j = 0; j < p; j++)
                        x[i][j] *= root;
                    x[i][p] = root * residual_of(triad, row, sensed, i);
                    for (int j = 0; j < 3; j++) {
                        double by_axis = b[i][0] * turn[j][0] + b[i][1] * turn[j][1] + b[i][2] * turn[j][2];
                        noise += x[i][p + 1 + j] = by_axis * bridge[3 * row + j];
                    }
                    noise_square[c] += noise * noise;
                    for (int64_t j = 0; j < p; j++)
                        by_signs[c][j] += sign * x[i][j];
                    for (int a = 0; a < SENSED; a++) {
                        double *before = by_knots + (SENSED * k + a) * reactions;
                        double *after = by_knots + (SENSED * next + a) * reactions;
                        before[c] += (1.0 - share) * b[i][a] * sign;
                        before[width + 3 + c] += (1.0 - share) * b[i][a] * noise;
                        after[c] += share * b[i][a] * sign;
                        after[width + 3 + c] += share * b[i][a] * noise;
                    }
                }
                for (int64_t i = 0; i < columns; i++)
                    for (int64_t j = i & ~3; j < columns; j++) /* the upper triangle, whole vectors */
                        square[i][j] += x[0][i] * x[0][j] + x[1][i] * x[1][j] + x[2][i] * x[2][j];
                for (int a = 0; a < (triad->is_accelerometer ? SENSED : 3); a++) {
                    for (int64_t j = 0; j < columns; j++) {
                        double product = b[0][a] * x[0][j] + b[1][a] * x[1][j] + b[2][a] * x[2][j];
                        sums[0][a][j] += product;
                        sums[1][a][j] += share * product;
                    }
                    for (int j = 0; j < SENSED; j++) {
                        double product = b[0][a] * b[0][j] + b[1][a] * b[1][j] + b[2][a] * b[2][j];
                        blocks[0][a][j] += product;
                        blocks[1][a][j] += share * product;
                        blocks[2][a][j] += share * share * product;
                    }
                }
            }
        }
        if (first == stop)
            continue;
        for (int side = 0; side <= next - k; side++) /* the knot before, the knot after */
            for (int a = 0; a < SENSED; a++) {
                int64_t state = STATES * (k + side) + SENSED_STATE[a];
                double *out = right + rights * state, *reaction = by_knots + (SENSED * (k + side) + a) * reactions;
                double gathered[COLUMNS];
                for (int64_t j = 0; j < columns; j++)
                    gathered[j] = side ? sums[1][a][j] : sums[0][a][j] - sums[1][a][j];
                for (int64_t j = 0; j < p; j++)
                    out[j] += gathered[j];
                out[p + GRADIENT] += gathered[p];
                for (int j = 0; j < 3; j++) {
                    out[p + BRIDGE] += gathered[p + 1 + j];
                    reaction[width + j] += gathered[p + 1 + j];
                }
                for (int j = 0; j < SENSED; j++) {
                    double once = blocks[1][a][j], twice = blocks[2][a][j];
                    diagonal[STATES * state + SENSED_STATE[j]] += side ? twice : blocks[0][a][j] - 2.0 * once + twice;
                    if (side)
                        below[STATES * (STATES * k + SENSED_STATE[a]) + SENSED_STATE[j]] += once - twice;
                }
            }
    }
    for (int64_t k = 0; k < r->knots; k++) /* probes of the residuals' signs, all residuals together */
        for (int a = 0; a < SENSED; a++)
            for (int64_t c = 0; c < width; c++)
                right[rights * (STATES * k + SENSED_STATE[a]) + p + SENSORS] +=
                    by_knots[(SENSED * k + a) * reactions + c];
    for (int64_t i = 0; i < p; i++) {
        for (int64_t j = 0; j < p; j++)
            parameters[p * i + j] += i <= j ? square[i][j] : square[j][i];
        parameters_right[RIGHTS * i + GRADIENT] += square[i][p];
        for (int j = 1; j <= 3; j++)
            parameters_right[RIGHTS * i + BRIDGE] += square[i][p + j];
        for (int64_t c = 0; c < width; c++) {
            parameters_right[RIGHTS * i + SENSORS] += by_signs[c][i];
            by_parameters[reactions * i + c] += by_signs[c][i];
        }
    }
    double *last = by_parameters + reactions * p + width;
    for (int i = 1; i <= 3; i++)
        for (int j = 1; j <= 3; j++)
            last[i - 1] += i <= j ? square[p + i][p + j] : square[p + j][p + i];
    for (int64_t c = 0; c < width; c++)
        last[3 + c] += noise_square[c];
}

/* Sums over each interval's rows for the covariance, knots eliminated by their `response` (K, 12, p): whitened
 * sensitivities (K, r + 3, p), of which the last three lines are `ends`, residuals (K, r + 3), numbers of readings
 * (K, r + 3), and scores (K, p). All are added to; `moved` as in `normal_rows`, `ends` room for (3, g). */
EXPORTED void covariance_rows(const Record *r, const double *weight, const double *response, double *moved,
                              double *ends, double *by_interval, double *residual, double *count, double *score)
{
    int64_t p = r->parameters, width = 3 * r->vectors, lines = width + 3, row = 0, g = r->gyroscope;
    for (int64_t k = 0; k < r->knots; k++) {
        int64_t first = row, stop = rows_until(r, row, k), next = k + 1 < r->knots ? k + 1 : k;
        turned_by_gyroscope(r, k, first, stop, moved, ends);
        for (int i = 0; i < 3; i++)
            for (int64_t j = 0; j < g; j++)
                by_interval[p * (lines * k + width + i) + j] += ends[g * i + j];
        for (; row < stop; row++) {
            double share = r->share[r->at[row]], turn[3][3], sensed[3], vector[3], between[SENSED][COLUMNS];
            body_from_inertial(r->q + 4 * r->at[row], turn);
            for (int a = 0; a < SENSED; a++)
                for (int64_t j = 0; j < p; j++)
                    between[a][j] = (1.0 - share) * response[p * (STATES * k + SENSED_STATE[a]) + j] +
                                    share * response[p * (STATES * next + SENSED_STATE[a]) + j];
            for (int64_t v = 0; v < r->vectors; v++) {
                const Triad *triad = &r->triad[v];
                double b[3][SENSED], x[3][COLUMNS];
                sense(r, triad, row, k, turn, sensed, vector);
                sensitivity(r, triad, row, turn, sensed, vector, moved + 3 * g * (row - first), b, x);
                for (int i = 0; i < 3; i++) {
                    int64_t line = lines * k + 3 * v + i;
                    double root = sqrt(weight[width * row + 3 * v + i]), left = root * residual_of(triad, row, sensed, i);
                    double *sum = by_interval + p * line;
                    for (int64_t j = 0; j < p; j++) {
                        double seen = x[i][j];
                        for (int a = 0; a < SENSED; a++)
                            seen -= b[i][a] * between[a][j];
                        sum[j] += root * seen;
                        score[p * k + j] += left * root * seen;
                    }
                    residual[line] += left;
                    count[line] += root > 0.0;
                }
            }
        }
    }
}
