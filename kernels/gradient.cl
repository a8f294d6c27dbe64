// Follow rays to surface NUMBER through the medium that surface FIRST begins; MEDIUM is where its numbers are,
// RADIAL and AXIAL are their counts (see gradient.h). They come in the frame of surface NUMBER, in which they
// stay; the index where they arrive is kept, and a ray that does not arrive is no number.

INLINE real JOIN(beyond_, NUMBER)(const numbers t, const double *pose, triple place)
{
    real slope_x, slope_y;
    const triple p = turned_by(pose, place);
    const real x = p.x + pose[9], y = p.y + pose[10];
    return p.z + pose[11] - JOIN(sag_, NUMBER)(t, x, y, &slope_x, &slope_y);
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
    real step = m[1] / index;
    const real way = DETOUR * size_of(r->position.z) / m[1];
    const real enough = EITHER(way > LEAST_STEPS, way, (real)LEAST_STEPS);
    const real allowed = EITHER(enough < MOST_STEPS, enough, (real)MOST_STEPS);
    mask going = finite(step) & finite(way), arrived = going & NOT(going);
    real before = JOIN(beyond_, NUMBER)(t, pose, now.place);
    #pragma unroll 1
    for (int count = 1; any_lane(going); ++count) {
        const bent ahead = bent_step(m, RADIAL, AXIAL, now, step);
        const real after = JOIN(beyond_, NUMBER)(t, pose, ahead.place);
        // A ray that starts on the end surface itself has no side yet.
        const mask crossed = going & ((before * after < 0.0) | ((after == 0.0) & (before != 0.0)));
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
        const triple p = turned_by(pose, ahead.place), v = turned_by(pose, ahead.vector);
        real slope_x, slope_y;
        const real sag = JOIN(sag_, NUMBER)(t, p.x + pose[9], p.y + pose[10], &slope_x, &slope_y);
        const real height = p.z + pose[11] - sag;
        const mask apart = arrived & (size_of(height) > near);
        if (!any_lane(apart))
            break;
        const mask same = height * before > 0.0;
        low = EITHER(same, guess, low);
        high = EITHER(same, high, guess);
        const real newton = guess - height / (v.z - slope_x * v.x - slope_y * v.y);
        const real better = EITHER((newton > low) & (newton < high), newton, 0.5 * (low + high));
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
