// Meet surface NUMBER, a conic plus HEIGHT(x, y) along z, in the sense of SENSE: of 1, -1 or the ray's d.z. With q = z - HEIGHT it is the zero of
// F = c (x^2 + y^2 + k1 q^2) - 2 q, which takes neither a root nor a division.
//
// One evaluation at the hit of the bare conic gives a Newton step; a second step takes the height there from
// the slopes at hand. What that leaves is bounded by the square of the lateral step: `limit` is the square
// of the longest lateral step that is short enough, within the square `reach` of the distance from the axis.
// Rays for which it is not take Newton's iteration from the start (Stoerkle 2018, Algorithm 1); the others
// are left alone, so that no ray's bits depend on its neighbors. Returns the loss of rays that do not meet the
// surface; where the bare conic is missed, the iteration starts at the vertex plane.

INLINE height JOIN(height_there_, NUMBER)(numbers t, const ray *r, real bare)
{
    height h;
    h.value = JOIN(height_, NUMBER)(t, r->position.x + bare * r->direction.x,
                                    r->position.y + bare * r->direction.y, &h.slope_x, &h.slope_y);
    return h;
}

// Takes the step to the bare conic and the height there.
INLINE real JOIN(meet_, NUMBER)(numbers t, ray *r, real bare, height there, double c, double k1, real index,
                                double limit, double reach, triple *normal)
{
    const triple d = r->direction;
    const double ck1 = c * k1;
    triple hit = along(r->position, bare, d);
    const real beyond = ck1 * hit.z - 1.0;

    real value = there.value, slope_x = there.slope_x, slope_y = there.slope_y;
    real q = hit.z - value, h = 1.0 - ck1 * q;
    const real climb = d.z - slope_x * d.x - slope_y * d.y;
    const real inverse = 0.5 / (h * climb - c * (hit.x * d.x + hit.y * d.y));
    real step = (c * (hit.x * hit.x + hit.y * hit.y) - (1.0 + h) * q) * inverse;
    hit.x += step * d.x;
    hit.y += step * d.y;

    q += step * climb;
    h = 1.0 - ck1 * q;
    real square = hit.x * hit.x + hit.y * hit.y;
    real f = c * square - (1.0 + h) * q;
    const real lateral = (d.x * d.x + d.y * d.y) * (step * step) - limit;
    hit.x += f * inverse * d.x;
    hit.y += f * inverse * d.y;
    h -= ck1 * climb * (f * inverse);
    normal->x = c * hit.x + h * slope_x;
    normal->y = c * hit.y + h * slope_y;
    normal->z = -h;
    step += f * inverse;
    hit.z += step * d.z;
    real way = bare + step;
    mask met = larger(larger(lateral, square - reach), beyond) + poison(way) <= 0.0;
    real loss = LOSS(DIVERGED, NUMBER);

    if (UNLIKELY(any_lane(NOT(met)))) {
        // Strong deformations need the sag itself: F has a second sheet that attracts the iteration.
        mask missed = NOT(beyond + poison(bare) < 0.0);
        loss = EITHER(missed, (real)LOSS(MISS, NUMBER), loss);
        real to_start = EITHER(missed, -r->position.z / d.z, bare);
        way = EITHER(met, way, to_start);
        hit = choose(met, hit, along(r->position, to_start, d));
        mask open = NOT(met) & finite(way);
        for (int i = 0; i < NEWTON_STEPS && any_lane(open); ++i) {
            value = JOIN(height_, NUMBER)(t, hit.x, hit.y, &slope_x, &slope_y);
            square = hit.x * hit.x + hit.y * hit.y;
            real edge = root(1.0 - (c * c * k1) * square);
            real sag = c * square / (1.0 + edge), steep = c / edge;
            triple lean = {steep * hit.x + slope_x, steep * hit.y + slope_y, -1.0};
            step = (hit.z - sag - value) / dot3(lean, d);
            *normal = choose(open, lean, *normal);
            hit = choose(open, along(hit, step, d), hit);
            way = EITHER(open, way + step, way);
            real far = step * r->length;
            met |= open & (far * far <= CONVERGED * CONVERGED + ROUNDING * ROUNDING * square);
            open &= NOT(met) & finite(step);
        }
        normal->z = EITHER(met, normal->z, (real)1.0);
    }
    r->position = hit;
    r->path += way * (index * r->length);
    // On the half with the vertex, and crossed in the right sense.
    return EITHER(larger(normal->z, dot3(*normal, d) * SENSE) < 0.0, (real)0.0, loss);
}
#undef NUMBER
#undef SENSE
