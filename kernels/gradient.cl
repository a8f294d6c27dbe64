// Follow rays to surface NUMBER through the medium that surface FIRST begins; MEDIUM is where its numbers are,
// RADIAL and AXIAL are their counts (see gradient.h). They come in the frame of surface NUMBER, in which they
// stay; the index where they arrive is kept, and a ray that does not arrive is no number. A surface that
// touches or crosses the one before it may lie behind a ray, which then goes back.

// Height above the surface, and how fast it grows along the ray.
INLINE real JOIN(beyond_, NUMBER)(const numbers t, const double *pose, bent r, real *rise)
{
    real slope_x, slope_y;
    const triple p = turned_by(pose, r.place), v = turned_by(pose, r.vector);
    const real sag = JOIN(sag_, NUMBER)(t, p.x + pose[9], p.y + pose[10], &slope_x, &slope_y);
    *rise = v.z - slope_x * v.x - slope_y * v.y;
    return p.z + pose[11] - sag;
}

INLINE void JOIN(follow_, NUMBER)(const numbers t, ray *r)
{
    __global const double *m = t.fixed + MEDIUM;
    double pose[12];
    lead_through(t.poses + 12 * (FIRST + 1), NUMBER - FIRST, pose);
    const triple offset = {r->position.x - pose[9], r->position.y - pose[10], r->position.z - pose[11]};
    bent now = {turned_back_by(pose, offset), turned_back_by(pose, r->direction), 0.0};
    const real index = root(squared_index(m, RADIAL, AXIAL, now.place)), unit = index / r->length;
    now.vector.x *= unit;
    now.vector.y *= unit;
    now.vector.z *= unit;
    real rise, step = m[1] / index;
    const real way = DETOUR * size_of(r->position.z) / m[1];
    const real enough = EITHER(way > LEAST_STEPS, way, (real)LEAST_STEPS);
    const real allowed = EITHER(enough < MOST_STEPS, enough, (real)MOST_STEPS);
    mask going = finite(step) & finite(way);
    real before = JOIN(beyond_, NUMBER)(t, pose, now, &rise);
    mask arrived = going & (before == 0.0);
    going &= NOT(arrived);
    const double from = t.poses[12 * NUMBER + 11];
    const real passed = EITHER(r->direction.z < 0.0, (real)-from, (real)from);
    // Beyond a surface that it crosses in the sense in which it crosses the vertex plane.
    const mask is_behind = (before * rise > 0.0) & (rise * r->direction.z > 0.0) & (passed < m[1]);
    step = EITHER(arrived, (real)0.0, EITHER(is_behind, -step, step));
    #pragma unroll 1
    for (int count = 1; any_lane(going); ++count) {
        const bent ahead = bent_step(m, RADIAL, AXIAL, now, step);
        const real after = JOIN(beyond_, NUMBER)(t, pose, ahead, &rise);
        const mask crossed = going & ((before * after < 0.0) | (after == 0.0));
        arrived |= crossed;
        going &= NOT(crossed) & finite(ahead.path) & (squared_index(m, RADIAL, AXIAL, ahead.place) > 0.0);
        going &= (real)(double)count < allowed;
        now = chosen(going, ahead, now);
        before = EITHER(going & finite(after), after, before);
    }
    // The part of the last step that ends on the surface: Newton's method, kept inside a bracket.
    step = EITHER(arrived, step, (real)0.0);
    real low = 0.0, high = step, guess = 0.5 * step;
    const triple moves = {step * now.vector.x, step * now.vector.y, step * now.vector.z};
    const real near = ON_SURFACE * (largest_of(now.place) + largest_of(moves));
    #pragma unroll 1
    for (int cut = 0; cut < MOST_CUTS; ++cut) {
        const bent ahead = bent_step(m, RADIAL, AXIAL, now, guess);
        const real height = JOIN(beyond_, NUMBER)(t, pose, ahead, &rise);
        const mask apart = arrived & (size_of(height) > near);
        if (!any_lane(apart))
            break;
        const mask same = height * before > 0.0;
        low = EITHER(same, guess, low);
        high = EITHER(same, high, guess);
        const real newton = guess - height / rise;
        const real better = EITHER((newton - low) * (newton - high) < 0.0, newton, 0.5 * (low + high));
        guess = EITHER(apart, better, guess);  // a ray that is there does not wait for its neighbors
    }
    now = bent_step(m, RADIAL, AXIAL, now, guess);
    const triple p = turned_by(pose, now.place);
    r->position.x = EITHER(arrived, p.x + pose[9], (real)NAN);
    r->position.y = EITHER(arrived, p.y + pose[10], (real)NAN);
    r->position.z = EITHER(arrived, p.z + pose[11], (real)NAN);
    r->direction = turned_by(pose, now.vector);
    r->length = root(dot3(r->direction, r->direction));
    r->path += now.path;
    r->index = root(squared_index(m, RADIAL, AXIAL, now.place));
}
#undef NUMBER
#undef FIRST
#undef MEDIUM
#undef RADIAL
#undef AXIAL
