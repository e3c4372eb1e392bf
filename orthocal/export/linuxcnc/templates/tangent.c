/* Joints at the middle of the region, and their Jacobian there. */
static const double at_middle[N] = $at_middle;
static const double tangent[N][N] = $jacobian;

static int nominal(const double p[N], double q[N], double (*jacobian)[N])
{
    int i, k;

    for (i = 0; i < N; i++) {
        q[i] = at_middle[i];
        for (k = 0; k < N; k++) {
            q[i] += tangent[i][k] * (p[k] - middle[k]);
            if (jacobian)
                jacobian[i][k] = tangent[i][k];
        }
    }
    return 0;
}
