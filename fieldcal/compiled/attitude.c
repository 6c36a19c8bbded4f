/* Output error's pass over the samples, as in fieldcal/estimation/gyroscope/output_error.py, whose NumPy code is the
 * reference. n samples; `begins` (n,) says where a stretch begins. */
#include "rotation.h"
#include <stdint.h>
#include <string.h>

/* Attitude q (n, 4) relative to the start of each stretch (`propagate_stretches`): stamps t (n,), s, body rates (n, 3),
 * rad/s. */
EXPORTED void propagate_stretches(int64_t n, const double *t, const double *rate, const uint8_t *begins, double *q)
{
    double now[4] = {0.0, 0.0, 0.0, 1.0}, step[4];
    for (int64_t i = 0; i < n; i++) {
        if (begins[i]) {
            now[0] = now[1] = now[2] = 0.0, now[3] = 1.0;
        } else {
            rotation_step(t[i] - t[i - 1], rate + 3 * (i - 1), rate + 3 * i, step);
            multiply(now, step, now);
            double length = sqrt(now[0] * now[0] + now[1] * now[1] + now[2] * now[2] + now[3] * now[3]);
            for (int j = 0; j < 4; j++)
                now[j] /= length;
        }
        memcpy(q + 4 * i, now, sizeof now);
    }
}

/* Normal equations of one step (`normal_equations`): N = sum w S'S (6, 6), gradient = sum w S'r (6,), square =
 * sum w r'r (1,), with S = integral of R_nb [diag x, I] from each stretch's start, trapezoidal; all from zero. Unless
 * `fixed`, less the stretches' weighted means: their initial attitudes eliminated. */
EXPORTED void output_error_sums(int64_t n, const double *t, const double *model, const double *x,
                                const uint8_t *begins, const double *weight, const double *residual, int64_t fixed,
                                double *normal, double *gradient, double *square)
{
    double s[3][6] = {{0}}, before[3][6] = {{0}}, now[3][6], by_weight[3][6] = {{0}}, error[3] = {0}, total = 0.0;
    for (int64_t i = 0; i <= n; i++) {
        if (i == n || begins[i]) {
            if (!fixed && total > 0.0)
                for (int c = 0; c < 3; c++) {
                    for (int a = 0; a < 6; a++) {
                        for (int b = 0; b < 6; b++)
                            normal[6 * a + b] -= by_weight[c][a] * by_weight[c][b] / total;
                        gradient[a] -= by_weight[c][a] * error[c] / total;
                    }
                    *square -= error[c] * error[c] / total;
                }
            if (i == n)
                return;
            memset(s, 0, sizeof s), memset(by_weight, 0, sizeof by_weight), memset(error, 0, sizeof error);
            total = 0.0;
        }
        double turn[3][3], w = weight[i];
        body_from_inertial(model + 4 * i, turn);
        for (int c = 0; c < 3; c++)
            for (int a = 0; a < 3; a++) {
                now[c][a] = turn[a][c] * x[3 * i + a];
                now[c][3 + a] = turn[a][c];
            }
        if (!begins[i]) {
            double half = 0.5 * (t[i] - t[i - 1]);
            for (int c = 0; c < 3; c++)
                for (int a = 0; a < 6; a++)
                    s[c][a] += half * (now[c][a] + before[c][a]);
        }
        memcpy(before, now, sizeof now);
        for (int c = 0; c < 3; c++) {
            double r = residual[3 * i + c];
            for (int a = 0; a < 6; a++) {
                double weighted = w * s[c][a];
                by_weight[c][a] += weighted;
                gradient[a] += weighted * r;
                for (int b = 0; b < 6; b++)
                    normal[6 * a + b] += weighted * s[c][b];
            }
            error[c] += w * r;
            *square += w * r * r;
        }
        total += w;
    }
}
