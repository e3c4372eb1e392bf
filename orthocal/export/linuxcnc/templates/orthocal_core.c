/* Calibrated kinematics of $robot: $title.
   Largest error of the tip $achieved um over the region, mm:
   $region, for a tip at $tool.
   Beyond the region the correction is that of the nearest face. */
#ifdef RTAPI
#include "rtapi_math.h"
#else
#include <math.h>
#endif
#include "orthocal_core.h"

#define N ORTHOCAL_DRIVES
#define DEGREE $degree
#define TERMS $terms

#define MOST_STEPS 30
#define TOLERANCE 1e-10 /* mm */

/* middle and half the sides of the region, mm */
static const double middle[N] = $middle;
static const double half[N] = $half;

/* exponents of each term, and its coefficient in each joint */
static const unsigned char exponent[TERMS][N] = $exponent;
static const double coefficient[N][TERMS] = $coefficient;

#if ORTHOCAL_THERMAL
/* change of these coefficients per kelvin, and kelvins from the reference */
static const double per_kelvin[N][TERMS] = $per_kelvin;
static double warmer = 0.0;

void orthocal_set_temperature(double celsius)
{
    if (celsius < ORTHOCAL_LOWEST)
        celsius = ORTHOCAL_LOWEST;
    else if (celsius > ORTHOCAL_HIGHEST)
        celsius = ORTHOCAL_HIGHEST;
    else if (celsius != celsius)
        celsius = ORTHOCAL_REFERENCE;
    warmer = celsius - ORTHOCAL_REFERENCE;
}
#endif

/* Coefficient of a term in a joint. */
static double weight(int joint, int term)
{
#if ORTHOCAL_THERMAL
    return coefficient[joint][term] + warmer * per_kelvin[joint][term];
#else
    return coefficient[joint][term];
#endif
}

/* added to each joint, mm or degrees: half of the backlash, which homing subtracts */
static const double home[N] = $home;

/* periodic errors of the screws: amplitudes in each joint, radians per mm of the slide, direction of
   the joint, and its coordinate at slide coordinate 0 */
#define PERIODIC $periodic
#if PERIODIC
static const double sine[N] = $sine;
static const double cosine[N] = $cosine;
static const double rate = $rate;
static const double screw_direction[N] = $screw_direction;
static const double screw_zero[N] = $screw_zero;
#endif

$nominal
static double absolute(double value)
{
    return value < 0.0 ? -value : value;
}

/* Joints whose screws are at q, in q, and their Jacobian unless it is a null pointer. */
static void drive(double q[N], double (*jacobian)[N])
{
    int i;

    for (i = 0; i < N; i++) {
#if PERIODIC
        double wanted = q[i], slope = 0.0;
        int k, count;

        for (count = 0; count < MOST_STEPS; count++) {
            double phase = rate * screw_direction[i] * (q[i] - screw_zero[i]);
            double next = wanted - sine[i] * sin(phase) - cosine[i] * cos(phase);
            int settled = absolute(next - q[i]) < TOLERANCE;

            slope = rate * screw_direction[i] * (sine[i] * cos(phase) - cosine[i] * sin(phase));
            q[i] = next;
            if (settled)
                break;
        }
        for (k = 0; jacobian && k < N; k++)
            jacobian[i][k] /= 1.0 + slope;
#else
        (void)jacobian;
#endif
        q[i] += home[i];
    }
}

/* Joints at a point, and their Jacobian unless it is a null pointer. */
static int evaluate(const double p[N], double q[N], double (*jacobian)[N])
{
    double powers[N][DEGREE + 1], scale[N];
    int i, j, k, t;

    if (nominal(p, q, jacobian) != 0)
        return -1;
    for (k = 0; k < N; k++) {
        double x = (p[k] - middle[k]) / half[k];
        int outside = !(x > -1.0 && x < 1.0);

        if (outside)
            x = x < 0.0 ? -1.0 : 1.0;
        scale[k] = outside ? 0.0 : 1.0 / half[k];
        powers[k][0] = 1.0;
        for (j = 1; j <= DEGREE; j++)
            powers[k][j] = powers[k][j - 1] * x;
    }
    for (t = 0; t < TERMS; t++) {
        double term = 1.0;

        for (k = 0; k < N; k++)
            term *= powers[k][exponent[t][k]];
        for (i = 0; i < N; i++)
            q[i] += weight(i, t) * term;
        for (k = 0; jacobian && k < N; k++) {
            double derivative = exponent[t][k] * scale[k];

            if (exponent[t][k] == 0)
                continue;
            for (j = 0; j < N; j++)
                derivative *= powers[j][exponent[t][j] - (j == k)];
            for (i = 0; i < N; i++)
                jacobian[i][k] += weight(i, t) * derivative;
        }
    }
    drive(q, jacobian);
    return 0;
}

int orthocal_inverse(const double point[N], double joints[N])
{
    double q[N];
    int i;

    if (evaluate(point, q, 0) != 0)
        return -1;
    for (i = 0; i < N; i++)
        if (!(absolute(q[i]) < 1e12))
            return -1;
    for (i = 0; i < N; i++)
        joints[i] = q[i];
    return 0;
}

/* Solution of a x = b in b, by Gaussian elimination; -1 if a is singular. */
static int solve(double a[N][N], double b[N])
{
    int i, j, k;

    for (k = 0; k < N; k++) {
        int best = k;

        for (i = k + 1; i < N; i++)
            if (absolute(a[i][k]) > absolute(a[best][k]))
                best = i;
        if (!(absolute(a[best][k]) > 1e-9))
            return -1;
        for (j = 0; j < N; j++) {
            double swap = a[k][j];

            a[k][j] = a[best][j];
            a[best][j] = swap;
        }
        {
            double swap = b[k];

            b[k] = b[best];
            b[best] = swap;
        }
        for (i = k + 1; i < N; i++) {
            double factor = a[i][k] / a[k][k];

            for (j = k; j < N; j++)
                a[i][j] -= factor * a[k][j];
            b[i] -= factor * b[k];
        }
    }
    for (k = N - 1; k >= 0; k--) {
        for (j = k + 1; j < N; j++)
            b[k] -= a[k][j] * b[j];
        b[k] /= a[k][k];
    }
    return 0;
}

/* Newton iteration from p, with steps of at most half the region. */
static int iterate(const double joints[N], double p[N])
{
    int i, count;

    for (count = 0; count < MOST_STEPS; count++) {
        double q[N], jacobian[N][N], largest = 0.0, fraction = 1.0;

        if (evaluate(p, q, jacobian) != 0)
            return -1;
        for (i = 0; i < N; i++)
            q[i] = joints[i] - q[i];
        if (solve(jacobian, q) != 0)
            return -1;
        for (i = 0; i < N; i++) {
            double size = absolute(q[i]);

            if (!(size < 1e12))
                return -1;
            if (size > largest)
                largest = size;
            if (size * fraction > half[i])
                fraction = half[i] / size;
        }
        for (i = 0; i < N; i++)
            p[i] += fraction * q[i];
        if (largest < TOLERANCE)
            return 0;
    }
    return -1;
}

int orthocal_forward(const double joints[N], double point[N])
{
    double p[N];
    int i, attempt;

    for (attempt = 0; attempt < 2; attempt++) {
        for (i = 0; i < N; i++) {
            double distance = point[i] - middle[i];

            p[i] = middle[i];
            if (attempt == 0 && absolute(distance) < half[i])
                p[i] = point[i];
        }
        if (iterate(joints, p) == 0) {
            for (i = 0; i < N; i++)
                point[i] = p[i];
            return 0;
        }
    }
    return -1;
}
