// The figure of a conic: a polynomial of total degree ORDER in u and v, heights along z; if RING, one whose
// recurrences take `steps`. FIGURE(part) names the functions; a program includes this once for each kind.

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
INLINE real FIGURE(slopes)(__global const double *figure, __global const double *steps, real u, real v,
                          real *along_u, real *along_v)
{
    return monomial_sum(figure, ORDER, u, v, along_u, along_v);
}

INLINE real FIGURE(value)(__global const double *figure, __global const double *steps, real u, real v)
{
    return monomial_value(figure, ORDER, u, v);
}
#endif

// Where u and v are, by the frame's origin and the direction of u.
INLINE real FIGURE(u)(__global const double *frame, triple p)
{
    return frame[2] * p.x + (frame[3] * p.y - (frame[2] * frame[0] + frame[3] * frame[1]));
}

INLINE real FIGURE(v)(__global const double *frame, triple p)
{
    return frame[2] * p.y - (frame[3] * p.x + (frame[2] * frame[1] - frame[3] * frame[0]));
}

// From a hit of the bare conic to the conic plus figure in two steps: F takes z less the figure for z. The
// first step uses the figure's value alone, which leaves less than the figure times its slope; the second, a
// Newton step with both at that point, leaves the figure's curvature times the square of that.
INLINE real FIGURE(first)(__global const double *figure, __global const double *steps,
                         __global const double *frame, triple hit, triple d, triple bare)
{
    const real value = FIGURE(value)(figure, steps, FIGURE(u)(frame, hit), FIGURE(v)(frame, hit));
    return value * bare.z / dot3(bare, d);
}

// Takes the first step, then the second: moves the hit, adds to the step and gives the normal.
INLINE void FIGURE(second)(__global const double *figure, __global const double *steps,
                          __global const double *frame, triple d, double c, double k1, triple *hit, real *step,
                          triple *normal)
{
    const double ex = frame[2], ey = frame[3], ck1 = c * k1;
    real slope_u, slope_v;
    real q = hit->z - FIGURE(slopes)(figure, steps, FIGURE(u)(frame, *hit), FIGURE(v)(frame, *hit), &slope_u,
                                     &slope_v);
    const real slope_x = ex * slope_u - ey * slope_v, slope_y = ey * slope_u + ex * slope_v;
    const real climb = d.z - slope_x * d.x - slope_y * d.y;
    real h = 1.0 - ck1 * q;
    const real f = c * (hit->x * hit->x + hit->y * hit->y) - (1.0 + h) * q;
    const real second = 0.5 * f / (h * climb - c * (hit->x * d.x + hit->y * d.y));

    *hit = along(*hit, second, d);
    *step += second;
    h -= ck1 * climb * second;
    normal->x = c * hit->x + h * slope_x;
    normal->y = c * hit->y + h * slope_y;
    normal->z = -h;
}
