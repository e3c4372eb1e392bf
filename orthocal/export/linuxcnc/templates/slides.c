/* Each drive is a slide along an axis that holds the tool by a rod: tool position at which rod and
   slide coordinate are zero, length of the rod, sign of the root; direction of the joint, and its
   coordinate at slide coordinate 0. */
static const double axis[N][N] = $axis;
static const double anchor[N][N] = $anchor; /* mm */
static const double length[N] = $length; /* mm */
static const double sign[N] = $sign;
static const double direction[N] = $direction;
static const double at_zero[N] = $at_zero; /* mm */

static int nominal(const double p[N], double q[N], double (*jacobian)[N])
{
    int i, k;

    for (i = 0; i < N; i++) {
        double across[N], along = 0.0, square = length[i] * length[i], root;

        for (k = 0; k < N; k++)
            along += axis[i][k] * (p[k] - anchor[i][k]);
        for (k = 0; k < N; k++) {
            across[k] = p[k] - anchor[i][k] - along * axis[i][k];
            square -= across[k] * across[k];
        }
        if (!(square > 0.0))
            return -1;
        root = sign[i] * sqrt(square);
        q[i] = at_zero[i] + direction[i] * (along + root);
        for (k = 0; jacobian && k < N; k++)
            jacobian[i][k] = direction[i] * (axis[i][k] - across[k] / root);
    }
    return 0;
}
