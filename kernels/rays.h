// Rays, poses and conics. Lengths in mm.
//
// Directions are not normalized, which saves divisions: a reflection multiplies them by the square of the
// normal, and `length` keeps count. A step of s moves a ray by s times its direction and adds s times
// `length` to its path. A conic of curvature c and k1 = 1 + conic constant is the zero of F = c (x^2 + y^2
// + k1 z^2) - 2 z.

typedef struct { real x, y, z; } triple;
// `index` is that of a medium in which it varies, where the ray is.
typedef struct { triple position, direction; real length, path, index; } ray;

INLINE real dot3(triple a, triple b) { return a.x * b.x + a.y * b.y + a.z * b.z; }

INLINE triple along(triple start, real step, triple direction)
{
    triple end = {start.x + step * direction.x, start.y + step * direction.y, start.z + step * direction.z};
    return end;
}

INLINE triple choose(mask condition, triple yes, triple no)
{
    triple a = {EITHER(condition, yes.x, no.x), EITHER(condition, yes.y, no.y),
                EITHER(condition, yes.z, no.z)};
    return a;
}

// A pose is q = A p + o: nine entries of A row by row, then three of o; entries are 16 instants apart.
#define POSE(entry) LOAD(pose + 16 * (entry))

INLINE triple turned(__global const double *pose, triple a)
{
    triple b = {POSE(0) * a.x + POSE(1) * a.y + POSE(2) * a.z,
                POSE(3) * a.x + POSE(4) * a.y + POSE(5) * a.z,
                POSE(6) * a.x + POSE(7) * a.y + POSE(8) * a.z};
    return b;
}

INLINE triple moved(__global const double *pose, triple a)
{
    triple b = {POSE(9) + POSE(0) * a.x + POSE(1) * a.y + POSE(2) * a.z,
                POSE(10) + POSE(3) * a.x + POSE(4) * a.y + POSE(5) * a.z,
                POSE(11) + POSE(6) * a.x + POSE(7) * a.y + POSE(8) * a.z};
    return b;
}

// A is a rotation, so its transpose turns back.
INLINE triple turned_back(__global const double *pose, triple a)
{
    triple b = {POSE(0) * a.x + POSE(3) * a.y + POSE(6) * a.z,
                POSE(1) * a.x + POSE(4) * a.y + POSE(7) * a.z,
                POSE(2) * a.x + POSE(5) * a.y + POSE(8) * a.z};
    return b;
}

// Half the gradient of F; it points to -z at the vertex. On the sag branch its z component is negative.
INLINE triple conic_normal(triple p, double c, double k1)
{
    triple normal = {c * p.x, c * p.y, (c * k1) * p.z - 1.0};
    return normal;
}

// Step to the conic: of the two roots the one that crosses it towards +z, or -z where `sense` is negative, by
// that form of the quadratic's solution which does not cancel. NaN or infinite without an intersection.
INLINE real conic_step_in_sense(triple p, triple d, double c, double k1, real sense)
{
    const double ck1 = c * k1;
    real high = ck1 * p.z;
    real f = c * (p.x * p.x + p.y * p.y) + (high - 2.0) * p.z;
    real b = c * (p.x * d.x + p.y * d.y) + (high - 1.0) * d.z;
    real a = c * (d.x * d.x + d.y * d.y) + ck1 * (d.z * d.z);
    real r = root(b * b - a * f);
    r = EITHER(sense < 0.0, -r, r);
    mask cancels = b * r > 0.0;
    return EITHER(cancels, -(b + r), f) / EITHER(cancels, a, r - b);
}

// In the sense of the direction's z component (Stoerkle 2018, Eq. 3.28 with the sign of d_z).
INLINE real conic_step(triple p, triple d, double c, double k1) { return conic_step_in_sense(p, d, c, k1, d.z); }

INLINE void advance(ray *r, real step)
{
    r->position = along(r->position, step, r->direction);
    r->path += step * r->length;
}

// The same step in a medium of this index.
INLINE void travel(ray *r, real step, real index)
{
    r->position = along(r->position, step, r->direction);
    r->path += step * (index * r->length);
}

INLINE void reflect(ray *r, triple normal)
{
    real square = dot3(normal, normal);
    real twice = -2.0 * dot3(normal, r->direction);
    triple scaled = {square * r->direction.x, square * r->direction.y, square * r->direction.z};
    r->direction = along(scaled, twice, normal);
    r->length *= square;
}

// Stoerkle 2018, Eq. 3.32 with its signs corrected, times the normal's square; `ratio` is the index before
// over that behind. True where light is refracted and not totally reflected.
INLINE mask refract(ray *r, triple normal, real ratio)
{
    real square = dot3(normal, normal);
    real incident = ratio * dot3(normal, r->direction);
    real radicand = (1.0 - ratio * ratio) * square * (r->length * r->length) + incident * incident;
    real turn = root(radicand);
    turn = EITHER(incident < 0.0, -turn, turn) - incident;
    real scale = ratio * square;
    triple kept = {scale * r->direction.x, scale * r->direction.y, scale * r->direction.z};
    r->direction = along(kept, turn, normal);
    r->length *= square;
    return NOT(radicand < 0.0);
}

// Path back along the ray to the sphere about (x, y, 0), of a negative radius where it lies behind the image.
INLINE real back_to_sphere(const ray *r, real x, real y, double radius)
{
    triple offset = {r->position.x - x, r->position.y - y, r->position.z};
    real projection = dot3(offset, r->direction);
    real excess = radius * radius - dot3(offset, offset);
    real way = root(projection * projection + r->length * r->length * excess);
    return (radius < 0.0 ? projection - way : projection + way) / r->length;
}

// A `b` that is not a number stays, an `a` that is none does not.
INLINE real larger(real a, real b) { return EITHER(a > b, a, b); }

// What is added to a number to make it NaN where `a` is not finite.
INLINE real poison(real a) { return a - a; }

// Losses are numbers, of which a ray keeps the largest.
INLINE real lose_unless(mask good, real loss, double other)
{
    return larger(EITHER(good, (real)0.0, (real)other), loss);
}
