/* Kinematics of $robot as calibrated: $title.
   Within $achieved um of the calibrated machine over, mm:
   $region, for a tool at $tool.
   Beyond, the correction stays what it is at the nearest
   face. */
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
#define SETTLED 1e-10 /* mm */

/* the region: its middle and half its sides, mm */
static const double middle[N] = $middle;
static const double half[N] = $half;

/* powers of each term, and what it counts in each joint */
static const unsigned char power[TERMS][N] = $power;
static const double coefficient[N][TERMS] = $coefficient;

$nominal
static double size_of(double value)
{
    return value < 0.0 ? -value : value;
}

/* Joints at a point, and their slopes there where these are asked for. */
static int evaluate(const double p[N], double q[N], double (*slope)[N])
{
    double powers[N][DEGREE + 1], by_scaled[N];
    int i, j, k, t;

    if (nominal(p, q, slope) != 0)
        return -1;
    for (k = 0; k < N; k++) {
        double x = (p[k] - middle[k]) / half[k];
        int outside = !(x > -1.0 && x < 1.0);

        if (outside)
            x = x < 0.0 ? -1.0 : 1.0;
        by_scaled[k] = outside ? 0.0 : 1.0 / half[k];
        powers[k][0] = 1.0;
        for (j = 1; j <= DEGREE; j++)
            powers[k][j] = powers[k][j - 1] * x;
    }
    for (t = 0; t < TERMS; t++) {
        double term = 1.0;

        for (k = 0; k < N; k++)
            term *= powers[k][power[t][k]];
        for (i = 0; i < N; i++)
            q[i] += coefficient[i][t] * term;
        for (k = 0; slope && k < N; k++) {
            double change = power[t][k] * by_scaled[k];

            if (power[t][k] == 0)
                continue;
            for (j = 0; j < N; j++)
                change *= powers[j][power[t][j] - (j == k)];
            for (i = 0; i < N; i++)
                slope[i][k] += coefficient[i][t] * change;
        }
    }
    return 0;
}

int orthocal_inverse(const double point[N], double joints[N])
{
    double q[N];
    int i;

    if (evaluate(point, q, 0) != 0)
        return -1;
    for (i = 0; i < N; i++)
        if (!(size_of(q[i]) < 1e12))
            return -1;
    for (i = 0; i < N; i++)
        joints[i] = q[i];
    return 0;
}

/* x of a x = b, by elimination; -1 where a is singular. */
static int solve(double a[N][N], double b[N])
{
    int i, j, k;

    for (k = 0; k < N; k++) {
        int best = k;

        for (i = k + 1; i < N; i++)
            if (size_of(a[i][k]) > size_of(a[best][k]))
                best = i;
        if (!(size_of(a[best][k]) > 1e-9))
            return -1;
        for (j = 0; j < N; j++) {
            double kept = a[k][j];

            a[k][j] = a[best][j];
            a[best][j] = kept;
        }
        {
            double kept = b[k];

            b[k] = b[best];
            b[best] = kept;
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

/* Newton from p, its steps within half the region. */
static int follow(const double joints[N], double p[N])
{
    int i, count;

    for (count = 0; count < MOST_STEPS; count++) {
        double q[N], slope[N][N], largest = 0.0, allowed = 1.0;

        if (evaluate(p, q, slope) != 0)
            return -1;
        for (i = 0; i < N; i++)
            q[i] = joints[i] - q[i];
        if (solve(slope, q) != 0)
            return -1;
        for (i = 0; i < N; i++) {
            double size = size_of(q[i]);

            if (!(size < 1e12))
                return -1;
            if (size > largest)
                largest = size;
            if (size * allowed > half[i])
                allowed = half[i] / size;
        }
        for (i = 0; i < N; i++)
            p[i] += allowed * q[i];
        if (largest < SETTLED)
            return 0;
    }
    return -1;
}

int orthocal_forward(const double joints[N], double point[N])
{
    double p[N];
    int i, begin;

    for (begin = 0; begin < 2; begin++) {
        for (i = 0; i < N; i++) {
            double from = point[i] - middle[i];

            p[i] = middle[i];
            if (begin == 0 && size_of(from) < half[i])
                p[i] = point[i];
        }
        if (follow(joints, p) == 0) {
            for (i = 0; i < N; i++)
                point[i] = p[i];
            return 0;
        }
    }
    return -1;
}
