/* Products of quaternions and attitudes between stamps, as in fieldcal/geometry/rotation.py, whose NumPy code is the
 * reference. n >= 2 stamps t, ascending, s, of attitudes q (n, 4); m times `at`. */
#include "rotation.h"
#include <stdint.h>
#include <string.h>

/* out (n, 4) = p (x) q, each of which is (n, 4), or (4,) where its step is 0: `multiply`. */
EXPORTED void products(int64_t n, int64_t step_p, const double *p, int64_t step_q, const double *q, double *out)
{
    for (int64_t k = 0; k < n; k++)
        multiply(p + step_p * k, q + step_q * k, out + 4 * k);
}

/* Interval [t_i, t_i+1] of a time, the first or last of one outside: `interval_of`. Looked for from `near` on, for
 * times mostly rise. */
INLINED int64_t interval_of(int64_t n, const double *t, double at, int64_t near)
{
    int64_t low = 0, high = n - 1; /* t[low] <= at < t[high], or the end */
    if (near < n - 1 && !(at < t[near])) {
        low = near;
        for (int64_t step = 1; near + step < n - 1; step *= 2) {
            if (at < t[near + step]) {
                high = near + step;
                break;
            }
            low = near + step;
        }
    }
    while (high - low > 1) {
        int64_t middle = low + (high - low) / 2;
        if (at < t[middle])
            high = middle;
        else
            low = middle;
    }
    return low;
}

/* Share of the interval gone by: `share_of_interval`. Not a number stays so. */
INLINED double share_of_interval(const double *t, int64_t i, double at)
{
    double u = (at - t[i]) / (t[i + 1] - t[i]);
    return u < 0.0 ? 0.0 : u > 1.0 ? 1.0 : u;
}

/* The way from attitude p to attitude q, as a rotation vector. */
INLINED void way(const double p[4], const double q[4], double out[3])
{
    double back[4], step[4];
    conjugate(p, back);
    multiply(back, q, step);
    to_rotation_vector(step, out);
}

/* out (m, 4): `slerp`. */
EXPORTED void slerp(int64_t n, int64_t m, const double *t, const double *q, const double *at, double *out)
{
    int64_t i = 0;
    double before[4] = {0.0}, sign = 1.0;
    for (int64_t k = 0; k < m; k++) {
        double step[3], turn[4], now[4];
        i = interval_of(n, t, at[k], i);
        way(q + 4 * i, q + 4 * i + 4, step);
        double u = share_of_interval(t, i, at[k]);
        for (int j = 0; j < 3; j++)
            step[j] *= u;
        from_rotation_vector(step, turn);
        multiply(q + 4 * i, turn, now);
        /* Neighbours share a hemisphere: `continuous`. */
        if (now[0] * before[0] + now[1] * before[1] + now[2] * before[2] + now[3] * before[3] < 0.0)
            sign = -sign;
        memcpy(before, now, sizeof now);
        for (int j = 0; j < 4; j++)
            out[4 * k + j] = sign * now[j];
    }
}

/* out (m, 4), with body rates (n, 3), rad/s: `hermite`. */
EXPORTED void hermite(int64_t n, int64_t m, const double *t, const double *q, const double *rate, const double *at,
                      double *out)
{
    int64_t i = 0;
    for (int64_t k = 0; k < m; k++) {
        double whole[3], turned[3], turn[4];
        i = interval_of(n, t, at[k], i);
        way(q + 4 * i, q + 4 * i + 4, whole);
        double u = share_of_interval(t, i, at[k]), step = t[i + 1] - t[i];
        for (int j = 0; j < 3; j++) {
            double begin = rate[3 * i + j] * step, end = rate[3 * i + 3 + j] * step;
            begin = isfinite(begin) ? begin : whole[j];
            end = isfinite(end) ? end : whole[j];
            turned[j] = (3 - 2 * u) * u * u * whole[j] + u * (1 - u) * (1 - u) * begin - u * u * (1 - u) * end;
        }
        from_rotation_vector(turned, turn);
        multiply(q + 4 * i, turn, out + 4 * k);
    }
}
