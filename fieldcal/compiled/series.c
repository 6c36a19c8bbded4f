/* One-step prediction errors of series of sessions, as in fieldcal/estimation/pooled/strengths.py, whose NumPy code is
 * the reference: a constant that walks, scatters from session to session and depends on temperature. */
#include "rotation.h"
#include <stdint.h>

/* `day`, `warmth`, `value`, `variance` (m, n): m sessions of n series, value NaN where a series has none. `strengths`:
 * variance of the walk a day, of the scatter, of the slope, and the square of the errors over their sd beyond which a
 * series starts anew. `z` and `expected` (m, n): errors over their sd and their variances, NaN where there are none. */
EXPORTED void innovations(int64_t m, int64_t n, const double *day, const double *warmth, const double *value,
                          const double *variance, const double *strengths, double *z, double *expected)
{
    const double walk = strengths[0], scatter = strengths[1], restart = strengths[3];
    for (int64_t j = 0; j < n; j++) {
        double c = 0.0, slope = 0.0, of_c = 0.0, p_cs = 0.0, p_ss = strengths[2], last = 0.0;
        int started = 0;
        for (int64_t i = j; i < m * n; i += n) {
            z[i] = expected[i] = NAN;
            if (!isfinite(value[i]))
                continue;
            const double t = warmth[i], r = variance[i] + scatter;
            if (started)
                of_c += walk * (day[i] - last);
            const double s = of_c + 2.0 * t * p_cs + t * t * p_ss + r, error = value[i] - c - slope * t;
            if (started && error * error < restart * s) {
                const double gain_c = (of_c + t * p_cs) / s, gain_s = (p_cs + t * p_ss) / s;
                z[i] = error / sqrt(s);
                expected[i] = s;
                c += gain_c * error;
                slope += gain_s * error;
                of_c -= gain_c * gain_c * s;
                p_cs -= gain_c * gain_s * s;
                p_ss -= gain_s * gain_s * s;
            } else {
                c = value[i] - slope * t;
                of_c = r + t * t * p_ss;
                p_cs = -t * p_ss;
            }
            started = 1;
            last = day[i];
        }
    }
}
