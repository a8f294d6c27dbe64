// The figure of a conic: a polynomial of total degree ORDER in u and v, heights along z; if RING, one whose
// recurrences take `steps`; if CHECKED, one for which two steps may not do. FIGURE(part) names the functions; a
// program includes this once for each kind.

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

#if CHECKED
// Rays for which two steps do not do take Newton's iteration on the sag from the bare conic (Stoerkle 2018,
// Algorithm 1); the others, which have `met`, are left alone, so that no ray's bits depend on its neighbors.
// `steps_so_far` lead from the bare conic to the hit. A ray that does not meet the surface gets no step.
INLINE void FIGURE(iterate)(__global const double *figure, __global const double *steps,
                           __global const double *frame, triple d, double c, double k1, mask met,
                           real steps_so_far, triple *hit, real *step, triple *normal)
{
    const double ex = frame[2], ey = frame[3];
    triple p = along(*hit, -steps_so_far, d);
    real way = 0.0;
    mask open = NOT(met) & finite(steps_so_far), near = 0, done = 0;
    for (int i = 0; i < NEWTON_STEPS && any_lane(open); ++i) {
        real slope_u, slope_v;
        const real value = FIGURE(slopes)(figure, steps, FIGURE(u)(frame, p), FIGURE(v)(frame, p), &slope_u,
                                          &slope_v);
        const real square = p.x * p.x + p.y * p.y, edge = root(1.0 - (c * c * k1) * square), steep = c / edge;
        const triple lean = {steep * p.x + (ex * slope_u - ey * slope_v),
                             steep * p.y + (ey * slope_u + ex * slope_v), -1.0};
        const real further = (p.z - c * square / (1.0 + edge) - value) / dot3(lean, d);
        *normal = choose(open, lean, *normal);
        p = choose(open, along(p, further, d), p);
        way = EITHER(open, way + further, way);
        done |= near & finite(further);
        near = open & (further * further * dot3(d, d) <= SHORT * SHORT);
        open &= NOT(done) & finite(further);
    }
    // The ray has to cross the surface in the sense in which it crosses the vertex plane.
    done &= dot3(*normal, d) * d.z < 0.0;
    *hit = choose(met, *hit, p);
    *step += EITHER(met, (real)0.0, EITHER(done, way - steps_so_far, (real)NAN));
}
#endif

// Takes the first step, then the second: moves the hit, adds to the step and gives the normal. `limit` is the
// square of the longest lateral step after which height and slopes still hold.
INLINE void FIGURE(second)(__global const double *figure, __global const double *steps,
                          __global const double *frame, triple d, double c, double k1, real limit, real first,
                          triple *hit, real *step, triple *normal)
{
    const double ex = frame[2], ey = frame[3], ck1 = c * k1;
    real slope_u, slope_v;
    const real u = FIGURE(u)(frame, *hit), v = FIGURE(v)(frame, *hit);
    real q = hit->z - FIGURE(slopes)(figure, steps, u, v, &slope_u, &slope_v);
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
#if CHECKED
    const real square = second * second, lateral = square * (d.x * d.x + d.y * d.y);
    const double lean = EITHER(c < 0.0, -c, c) * (1.0 + EITHER(k1 < 0.0, -k1, k1));
    const mask met = larger(larger(lateral - limit, u * u + v * v - REACH), square * lean - LEAN) <= 0.0;
    if (UNLIKELY(any_lane(NOT(met))))
        FIGURE(iterate)(figure, steps, frame, d, c, k1, met, first + second, hit, step, normal);
#endif
}
