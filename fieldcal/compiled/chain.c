/* The chain of knots: its links and the elimination of all knots, as in fieldcal/estimation/joint/chain_solver.py, whose
 * NumPy code is the reference. K knots of 12 states: attitude (3), velocity, acceleration, jerk (3 each). */
#include "rotation.h"
#include <stdint.h>
#include <string.h>

#define STATES 12
#define ORDER 3
enum { GRADIENT, SENSORS, JUMP, MOTION, BRIDGE, RIGHTS };

/* L x = b for `columns` right-hand sides, in place in x (12, columns); L (12, 12) lower. */
INLINED void forward(const double *l, int64_t columns, double *x)
{
    for (int i = 0; i < STATES; i++) {
        double *own = x + columns * i, inverse = 1.0 / l[STATES * i + i];
        for (int m = 0; m < i; m++)
            for (int64_t j = 0; j < columns; j++)
                own[j] -= l[STATES * i + m] * x[columns * m + j];
        for (int64_t j = 0; j < columns; j++)
            own[j] *= inverse;
    }
}

/* x -= V'y, for V (12, 12), y and x (12, columns). */
INLINED void subtract(const double *v, const double *y, int64_t columns, double *x)
{
    for (int i = 0; i < STATES; i++)
        for (int m = 0; m < STATES; m++)
            for (int64_t j = 0; j < columns; j++)
                x[columns * i + j] -= v[STATES * m + i] * y[columns * m + j];
}

/* Block Cholesky factor of the block tridiagonal matrix `diagonal` (K, 12, 12), `below` (K-1, 12, 12), and right-hand
 * sides carried forward, in place: `diagonal` becomes L_k with L_k L_k' = D_k - V_{k-1}' V_{k-1}, `below` becomes
 * V_k = L_k^-1 E_k' with E_k the block below, `right` (K, 12, columns) becomes y_k = L_k^-1 (b_k - V_{k-1}' y_{k-1}).
 * Then N_xx^-1 = (y of the identity)'(y of the identity): `absorbed` (p, columns) = sum of y_k[:, :p]' y_k.
 * Returns 0, or 1 where the matrix is not positive definite. */
EXPORTED int64_t eliminate(int64_t knots, int64_t columns, int64_t p, double *diagonal, double *below, double *right,
                           double *absorbed)
{
    for (int64_t k = 0; k < knots; k++) {
        double *l = diagonal + STATES * STATES * k, *y = right + STATES * columns * k;
        if (k) {
            double *v = below + STATES * STATES * (k - 1);
            subtract(v, v, STATES, l);
            subtract(v, y - STATES * columns, columns, y);
        }
        for (int j = 0; j < STATES; j++) { /* Cholesky by columns, lower triangle; the upper one is not read */
            double pivot = l[STATES * j + j];
            for (int m = 0; m < j; m++)
                pivot -= l[STATES * j + m] * l[STATES * j + m];
            if (!(pivot > 0.0))
                return 1;
            pivot = l[STATES * j + j] = sqrt(pivot);
            for (int i = j + 1; i < STATES; i++) {
                double sum = l[STATES * i + j];
                for (int m = 0; m < j; m++)
                    sum -= l[STATES * i + m] * l[STATES * j + m];
                l[STATES * i + j] = sum / pivot;
            }
        }
        forward(l, columns, y);
        if (k + 1 < knots) {
            double *v = below + STATES * STATES * k;
            for (int i = 0; i < STATES; i++) /* transposed */
                for (int j = 0; j < i; j++) {
                    double swapped = v[STATES * i + j];
                    v[STATES * i + j] = v[STATES * j + i];
                    v[STATES * j + i] = swapped;
                }
            forward(l, STATES, v);
        }
        for (int64_t i = 0; i < p; i++)
            for (int m = 0; m < STATES; m++)
                for (int64_t j = i & ~3; j < columns; j++) /* the upper triangle, whole vectors */
                    absorbed[columns * i + j] += y[columns * m + i] * y[columns * m + j];
    }
    for (int64_t i = 0; i < p; i++)
        for (int64_t j = 0; j < i; j++)
            absorbed[columns * i + j] = absorbed[columns * j + i];
    return 0;
}

/* x_k = L_k'^-1 (y_k - V_k x_{k+1}), in place in y (K, 12, columns): the second half of `eliminate`. */
EXPORTED void substitute(int64_t knots, int64_t columns, const double *l_of_knots, const double *v_of_knots, double *y)
{
    for (int64_t k = knots - 1; k >= 0; k--) {
        const double *l = l_of_knots + STATES * STATES * k, *v = v_of_knots + STATES * STATES * k;
        double *x = y + STATES * columns * k, *after = x + STATES * columns;
        for (int i = STATES - 1; i >= 0; i--) {
            double *own = x + columns * i, inverse = 1.0 / l[STATES * i + i];
            if (k + 1 < knots)
                for (int m = 0; m < STATES; m++)
                    for (int64_t j = 0; j < columns; j++)
                        own[j] -= v[STATES * i + m] * after[columns * m + j];
            for (int m = i + 1; m < STATES; m++)
                for (int64_t j = 0; j < columns; j++)
                    own[j] -= l[STATES * m + i] * x[columns * m + j];
            for (int64_t j = 0; j < columns; j++)
                own[j] *= inverse;
        }
    }
}

/* Attitude jumps added to the normal equations (`add_jumps`): jump (K-1, 3), moved (K-1, 3, p), weight (K-1,) 1/variance
 * or 0, probe (K-1, 3). */
EXPORTED void add_jumps(int64_t knots, int64_t p, const double *jump, const double *moved, const double *weight,
                        const double *probe, double *diagonal, double *below, double *right, double *parameters,
                        double *parameters_right)
{
    int64_t columns = p + RIGHTS;
    for (int64_t k = 0; k + 1 < knots; k++)
        for (int i = 0; i < 3; i++) {
            double w = weight[k];
            int64_t own = STATES * k + i, next = own + STATES;
            const double *by = moved + p * (3 * k + i);
            double gradient = -w * jump[3 * k + i], drawn = sqrt(w) * probe[3 * k + i];
            double *before = right + columns * own, *after = right + columns * next;
            diagonal[STATES * own + i] += w;
            diagonal[STATES * next + i] += w;
            below[STATES * own + i] -= w;
            for (int64_t j = 0; j < p; j++) {
                before[j] += w * by[j];
                after[j] -= w * by[j];
            }
            before[p + GRADIENT] -= gradient, after[p + GRADIENT] += gradient;
            before[p + JUMP] -= drawn, after[p + JUMP] += drawn;
            for (int64_t a = 0; a < p; a++) {
                if (by[a] == 0.0)
                    continue;
                for (int64_t j = 0; j < p; j++)
                    parameters[p * a + j] += w * by[a] * by[j];
                parameters_right[RIGHTS * a + GRADIENT] -= gradient * by[a];
                parameters_right[RIGHTS * a + JUMP] -= drawn * by[a];
            }
        }
}

/* Adds u'u to a block of three states of one axis, u (3, 3): `into` is the block's first element. */
INLINED void add_product(const double *u, const double *w, double sign, double *into)
{
    for (int i = 0; i < ORDER; i++)
        for (int j = 0; j < ORDER; j++)
            for (int m = 0; m < ORDER; m++)
                into[3 * (STATES * i + j)] += sign * u[ORDER * m + i] * w[ORDER * m + j];
}

/* The translation's process added to the normal equations (`add_motion`): ahead, behind (K-1, 3, 3) factors of the next
 * and of this knot, first (K, 3, 3) of a segment's first knot, all over the sd; motion (K, 9); probe of each step
 * (K-1, 3, 3) and start (K, 3, 3). */
EXPORTED void add_motion(int64_t knots, int64_t columns, const double *ahead, const double *behind, const double *first,
                         const double *motion, const double *probe, const double *probe_start, double *diagonal,
                         double *below, double *right)
{
    int64_t p = columns - RIGHTS;
    for (int64_t k = 0; k < knots; k++)
        for (int axis = 0; axis < 3; axis++) {
            double *own = diagonal + STATES * STATES * k + (STATES + 1) * (3 + axis);
            double *rights = right + columns * (STATES * k + 3 + axis) + p, *following = rights + STATES * columns;
            const double *f = first + 9 * k, *y = motion + 9 * k + axis, *z = probe_start + 9 * k + axis;
            add_product(f, f, 1.0, own);
            for (int m = 0; m < ORDER; m++) {
                double start = -(f[3 * m] * y[0] + f[3 * m + 1] * y[3] + f[3 * m + 2] * y[6]);
                for (int i = 0; i < ORDER; i++) {
                    rights[3 * columns * i + GRADIENT] += f[3 * m + i] * start;
                    rights[3 * columns * i + MOTION] += f[3 * m + i] * z[3 * m];
                }
            }
            if (k + 1 == knots)
                continue;
            const double *u = ahead + 9 * k, *b = behind + 9 * k, *next = y + 9, *drawn = probe + 9 * k + axis;
            add_product(u, u, 1.0, own + STATES * STATES);
            add_product(b, b, 1.0, own);
            add_product(u, b, -1.0, below + STATES * STATES * k + (STATES + 1) * (3 + axis));
            for (int m = 0; m < ORDER; m++) {
                double step = b[3 * m] * y[0] + b[3 * m + 1] * y[3] + b[3 * m + 2] * y[6];
                step -= u[3 * m] * next[0] + u[3 * m + 1] * next[3] + u[3 * m + 2] * next[6];
                for (int i = 0; i < ORDER; i++) {
                    following[3 * columns * i + GRADIENT] += u[3 * m + i] * step;
                    rights[3 * columns * i + GRADIENT] -= b[3 * m + i] * step;
                    following[3 * columns * i + MOTION] += u[3 * m + i] * drawn[3 * m];
                    rights[3 * columns * i + MOTION] -= b[3 * m + i] * drawn[3 * m];
                }
            }
        }
}
