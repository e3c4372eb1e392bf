/* each drive a slide along an axis that holds the tool by a rod: where rod and slide are at their zero,
   the rod's length, which way round; and what the joint shows */
static const double axis[N][N] = $axis;
static const double anchor[N][N] = $anchor; /* mm */
static const double length[N] = $length; /* mm */
static const double sign[N] = $sign;
static const double counts[N] = $counts;
static const double shown[N] = $shown; /* mm */

static int nominal(const double p[N], double q[N], double (*slope)[N])
{
    int i, k;

    for (i = 0; i < N; i++) {
        double across[N], along = 0.0, under = length[i] * length[i], root;

        for (k = 0; k < N; k++)
            along += axis[i][k] * (p[k] - anchor[i][k]);
        for (k = 0; k < N; k++) {
            across[k] = p[k] - anchor[i][k] - along * axis[i][k];
            under -= across[k] * across[k];
        }
        if (!(under > 0.0))
            return -1;
        root = sign[i] * sqrt(under);
        q[i] = shown[i] + counts[i] * (along + root);
        for (k = 0; slope && k < N; k++)
            slope[i][k] = counts[i] * (axis[i][k] - across[k] / root);
    }
    return 0;
}
