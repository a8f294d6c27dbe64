// The figure of a conic: a polynomial of total degree ORDER in u and v, heights along z; if RING, one whose
// recurrences take `steps`. FIGURE(part) names the functions; a program includes this once for each kind.

#undef TERM
#define TERM(i, j) LOAD(figure + 16 * (((i) + (j)) * ((i) + (j) + 1) / 2 + (j)))

#if RING
INLINE real FIGURE(slopes)(__global const double *figure, __global const double *steps, real u, real v,
                          real *along_u, real *along_v)
{
    return ring_sum(figure, ORDER, steps, u, v, along_u, along_v);
}

INLINE real FIGURE(value)(__global const double *figure, __global const double *steps, real u, real v)
{
    real along_u, along_v;
    return FIGURE(slopes)(figure, steps, u, v, &along_u, &along_v);
}
#else
// The figure polynomial, sum of TERM(i, j) u^i v^j, by Horner's rule in v, then in u.
INLINE real FIGURE(value)(__global const double *figure, __global const double *steps, real u, real v)
{
    real value = 0.0;
    #pragma unroll
    for (int i = ORDER; i >= 0; --i) {
        real inner = TERM(i, ORDER - i);
        #pragma unroll
        for (int j = ORDER - i - 1; j >= 0; --j)
            inner = inner * v + TERM(i, j);
        value = value * u + inner;
    }
    return value;
}

INLINE real FIGURE(slopes)(__global const double *figure, __global const double *steps, real u, real v,
                          real *along_u, real *along_v)
{
    real value = 0.0, slope_u = 0.0, slope_v = 0.0;
    #pragma unroll
    for (int i = ORDER; i >= 0; --i) {
        real inner = TERM(i, ORDER - i), inner_v = 0.0;
        #pragma unroll
        for (int j = ORDER - i - 1; j >= 0; --j) {
            inner_v = inner_v * v + inner;
            inner = inner * v + TERM(i, j);
        }
        slope_u = slope_u * u + value;
        slope_v = slope_v * u + inner_v;
        value = value * u + inner;
    }
    *along_u = slope_u;
    *along_v = slope_v;
    return value;
}
#endif

// From a hit of the bare conic to the conic plus figure in two steps: F takes z less the figure for z. The
// first step uses the figure's value alone, which leaves less than the figure times its slope; the second, a
// Newton step with both at that point, leaves the figure's curvature times the square of that.
INLINE real FIGURE(first)(__global const double *figure, __global const double *steps,
                         __global const double *frame, triple hit, triple d, triple bare)
{
    double ex = frame[2], ey = frame[3];
    real u = ex * (hit.x - frame[0]) + ey * (hit.y - frame[1]);
    real v = ex * (hit.y - frame[1]) - ey * (hit.x - frame[0]);
    return FIGURE(value)(figure, steps, u, v) * bare.z / dot3(bare, d);
}

// Takes the first step and returns the second, with the normal where it leads.
INLINE real FIGURE(second)(__global const double *figure, __global const double *steps,
                          __global const double *frame, triple hit, triple d, real first, double c, double k1,
                          triple *normal)
{
    double ex = frame[2], ey = frame[3];
    hit = along(hit, first, d);
    real u = ex * (hit.x - frame[0]) + ey * (hit.y - frame[1]);
    real v = ex * (hit.y - frame[1]) - ey * (hit.x - frame[0]);
    real slope_u, slope_v;
    real deformation = FIGURE(slopes)(figure, steps, u, v, &slope_u, &slope_v);
    real slope_x = ex * slope_u - ey * slope_v, slope_y = ey * slope_u + ex * slope_v;
    triple flat = {hit.x, hit.y, hit.z - deformation};
    triple direction = {d.x, d.y, d.z - slope_x * d.x - slope_y * d.y};
    triple lean = conic_normal(flat, c, k1);
    real f = c * (flat.x * flat.x + flat.y * flat.y + k1 * (flat.z * flat.z)) - 2.0 * flat.z;
    real second = -0.5 * f / dot3(lean, direction);

    lean = conic_normal(along(flat, second, direction), c, k1);
    normal->x = lean.x - slope_x * lean.z;
    normal->y = lean.y - slope_y * lean.z;
    normal->z = lean.z;
    return second;
}
