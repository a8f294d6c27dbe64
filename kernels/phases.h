// Surfaces that add a path to light and bend it (wavequake/kernels/trace/phases_numpy.py is the twin).

// Along the surface, index times direction changes by the slopes of the added path; `sense` is -1 for a mirror.
// True where the order leaves.
INLINE mask diffract(ray *r, triple normal, real before, real after, real slope_x, real slope_y, const double sense)
{
    const real square = dot3(normal, normal), incident = dot3(normal, r->direction);
    const triple kept = {before * r->direction.x + r->length * slope_x,
                         before * r->direction.y + r->length * slope_y, before * r->direction.z};
    const real along_normal = dot3(normal, kept), size = after * r->length;
    const real radicand = square * (size * size - dot3(kept, kept)) + along_normal * along_normal;
    real turn = sense * root(radicand);
    turn = EITHER(incident < 0.0, -turn, turn) - along_normal;
    const real scale = 1.0 / after;
    const triple in_plane = {square * scale * kept.x, square * scale * kept.y, square * scale * kept.z};
    r->direction = along(in_plane, turn * scale, normal);
    r->length *= square;
    return NOT(radicand < 0.0);
}

// The difference of two ways to one point, from the center of a lens and from a place on it whose square is
// `square` and which lies `shift` along the ray, times two and over one plus ...: `closeness` is the reciprocal
// of the way along the ray.
INLINE real lens_path(real square, real shift, real closeness)
{
    return (square * closeness + 2.0 * shift)
         / (1.0 + root(1.0 + square * closeness * closeness + 2.0 * closeness * shift));
}

// A perfect thin lens in the plane z = 0: power and vergence of the object.
INLINE void focus(ray *r, real before, real after, __global const double *lens)
{
    const real x = r->position.x, y = r->position.y, square = x * x + y * y;
    const real z = EITHER(r->direction.z < 0.0, -r->direction.z, r->direction.z), scale = 1.0 / after;
    const real into = (r->direction.x * x + r->direction.y * y) / r->length;
    r->path += before * lens_path(square, -into, lens[1] * z / r->length);
    r->direction.x = (before * r->direction.x - lens[0] * x * z) * scale;
    r->direction.y = (before * r->direction.y - lens[0] * y * z) * scale;
    r->length = root(dot3(r->direction, r->direction));
    const real out = (r->direction.x * x + r->direction.y * y) / r->length;
    r->path += after * lens_path(square, out, (lens[0] - before * lens[1]) * scale * z / r->length);
}
