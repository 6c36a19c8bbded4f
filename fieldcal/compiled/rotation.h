/* Quaternions (x, y, z, w) and 3 x 3 matrices by rows, as in fieldcal/geometry/rotation.py. */
#ifndef FIELDCAL_ROTATION_H
#define FIELDCAL_ROTATION_H

#include <math.h>

/* What is called from Python, compiled twice: for any processor, and for one with AVX2 and FMA, chosen when loaded.
 * Clones need GNU indirect functions; without them the plain one does. */
#if defined(__GNUC__) && !defined(__clang__) && defined(__x86_64__) && defined(__GLIBC__) && !defined(FIELDCAL_PLAIN)
#define EXPORTED __attribute__((target_clones("arch=haswell", "default")))
#else
#define EXPORTED
#endif
#define INLINED static inline __attribute__((always_inline))

#define SMALL_HALF_SQUARED 0.01 /* rad^2; up to there the series below are exact to rounding */

/* p (x) q */
INLINED void multiply(const double p[4], const double q[4], double out[4])
{
    double x = p[3] * q[0] + p[0] * q[3] + p[1] * q[2] - p[2] * q[1];
    double y = p[3] * q[1] - p[0] * q[2] + p[1] * q[3] + p[2] * q[0];
    double z = p[3] * q[2] + p[0] * q[1] - p[1] * q[0] + p[2] * q[3];
    double w = p[3] * q[3] - p[0] * q[0] - p[1] * q[1] - p[2] * q[2];
    out[0] = x, out[1] = y, out[2] = z, out[3] = w;
}

INLINED void conjugate(const double q[4], double out[4])
{
    out[0] = -q[0], out[1] = -q[1], out[2] = -q[2], out[3] = q[3];
}

/* Unit quaternion of a rotation vector, rad. */
INLINED void from_rotation_vector(const double v[3], double out[4])
{
    double h = 0.25 * (v[0] * v[0] + v[1] * v[1] + v[2] * v[2]), sinc, cosine;
    if (h < SMALL_HALF_SQUARED) {
        sinc = 1.0 + h * (-1.0 / 6 + h * (1.0 / 120 + h * (-1.0 / 5040 + h * (1.0 / 362880))));
        cosine = 1.0 + h * (-0.5 + h * (1.0 / 24 + h * (-1.0 / 720 + h * (1.0 / 40320 + h * (-1.0 / 3628800)))));
    } else {
        double half = sqrt(h);
        sinc = sin(half) / half;
        cosine = cos(half);
    }
    for (int i = 0; i < 3; i++)
        out[i] = 0.5 * sinc * v[i];
    out[3] = cosine;
}

/* Rotation vector of a unit quaternion, the shorter way round. */
INLINED void to_rotation_vector(const double q[4], double out[3])
{
    double sine = sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2]);
    double factor = sine > 1e-12 ? 2.0 * atan2(sine, fabs(q[3])) / sine : 2.0;
    factor = copysign(factor, q[3]);
    for (int i = 0; i < 3; i++)
        out[i] = factor * q[i];
}

/* A(q): inertial to body. */
INLINED void body_from_inertial(const double q[4], double a[3][3])
{
    double x = q[0], y = q[1], z = q[2], w = q[3];
    a[0][0] = 1 - 2 * (y * y + z * z), a[1][1] = 1 - 2 * (x * x + z * z), a[2][2] = 1 - 2 * (x * x + y * y);
    a[0][1] = 2 * (x * y + w * z), a[1][0] = 2 * (x * y - w * z);
    a[0][2] = 2 * (x * z - w * y), a[2][0] = 2 * (x * z + w * y);
    a[1][2] = 2 * (y * z + w * x), a[2][1] = 2 * (y * z - w * x);
}

INLINED void cross(const double u[3], const double v[3], double out[3])
{
    out[0] = u[1] * v[2] - u[2] * v[1], out[1] = u[2] * v[0] - u[0] * v[2], out[2] = u[0] * v[1] - u[1] * v[0];
}

INLINED void transform(const double a[3][3], const double v[3], double out[3])
{
    for (int i = 0; i < 3; i++)
        out[i] = a[i][0] * v[0] + a[i][1] * v[1] + a[i][2] * v[2];
}

/* Rotation of body rates u, then w over a step, s, the rate linear in between: `rotation_steps`. */
INLINED void rotation_step(double step, const double u[3], const double w[3], double out[4])
{
    double turned[3], coning[3];
    cross(u, w, coning);
    for (int i = 0; i < 3; i++)
        turned[i] = 0.5 * step * (u[i] + w[i]) + step * step / 12.0 * coning[i];
    from_rotation_vector(turned, out);
}

#endif
