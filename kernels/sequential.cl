// The steps of a trace through a sequence of surfaces; the host writes the kernel that calls them, one call
// after the other, for each shape of a system.
//
// Work-item (1, group of W rays, instant): the lanes are rays, so that what belongs to an instant is read as
// scalars. `index` is the refractive index in front of a surface.

#include "lanes.h"
#include "rays.h"
#include "status.h"

#define NEWTON_STEPS 30
// Newton's iteration ends with a step this short, or this short for a surface of radius 1.
#define CONVERGED 1e-12
#define ROUNDING 4e-15

// A pose is q = A p + o: nine entries of A row by row, then three of o.
INLINE void shift(ray *r, __global const double *pose)
{
    r->position.x += pose[9];
    r->position.y += pose[10];
    r->position.z += pose[11];
}

INLINE triple moved_by(__global const double *a, triple p)
{
    triple b = {a[9] + a[0] * p.x + a[1] * p.y + a[2] * p.z, a[10] + a[3] * p.x + a[4] * p.y + a[5] * p.z,
                a[11] + a[6] * p.x + a[7] * p.y + a[8] * p.z};
    return b;
}

INLINE triple rotated(__global const double *a, triple p)
{
    triple b = {a[0] * p.x + a[1] * p.y + a[2] * p.z, a[3] * p.x + a[4] * p.y + a[5] * p.z,
                a[6] * p.x + a[7] * p.y + a[8] * p.z};
    return b;
}

INLINE void rotate_and_shift(ray *r, __global const double *pose)
{
    r->direction = rotated(pose, r->direction);
    r->position = moved_by(pose, r->position);
}

// The same with a direction that all rays have: it is turned once.
INLINE void rotate_together_and_shift(ray *r, __global const double *a, __global const double *d)
{
    r->direction.x = (real)(a[0] * d[0] + a[1] * d[1] + a[2] * d[2]);
    r->direction.y = (real)(a[3] * d[0] + a[4] * d[1] + a[5] * d[2]);
    r->direction.z = (real)(a[6] * d[0] + a[7] * d[1] + a[8] * d[2]);
    r->position = moved_by(a, r->position);
}

INLINE real plane_step(const ray *r) { return -r->position.z / r->direction.z; }

// These take the step to the surface, and return where it is met.
INLINE mask meet_plane(ray *r, real step, real index, triple *normal)
{
    normal->x = 0.0;
    normal->y = 0.0;
    normal->z = -1.0;
    travel(r, step, index);
    return finite(step);
}

INLINE mask meet_conic(ray *r, real step, double c, double k1, real index, triple *normal)
{
    travel(r, step, index);
    *normal = conic_normal(r->position, c, k1);
    return normal->z + poison(step) < 0.0;
}

INLINE void reflect_at_plane(ray *r) { r->direction.z = -r->direction.z; }

// Regions of apertures: a circle (x, y, square of the radius), a convex polygon (half planes a x + b y <= c),
// any other (half planes, lowest and highest y of their edges), of which a way to +x crosses an odd number.
INLINE mask in_circle(triple p, __global const double *circle)
{
    real x = p.x - circle[0], y = p.y - circle[1];
    return x * x + y * y <= circle[2];
}

INLINE mask in_polygon(triple p, __global const double *line, const int edges)
{
    mask inside = p.x == p.x;
    for (int edge = 0; edge < edges; ++edge)
        inside &= line[3 * edge] * p.x + line[3 * edge + 1] * p.y <= line[3 * edge + 2];
    return inside;
}

INLINE mask in_outline(triple p, __global const double *line, const int edges)
{
    real sense = -1.0;
    for (int edge = 0; edge < edges; ++edge, line += 5) {
        real side = line[0] * p.x + line[1] * p.y - line[2];
        sense = EITHER((p.y >= line[3]) & (p.y < line[4]) & (line[0] * side < 0.0), -sense, sense);
    }
    return sense > 0.0;
}

// To the sphere of given center and radius: back along the ray, or onwards where the radius is negative.
INLINE mask to_sphere(ray *r, __global const double *sphere, real index)
{
    triple offset = {r->position.x - sphere[0], r->position.y - sphere[1], r->position.z - sphere[2]};
    real projection = dot3(offset, r->direction);
    real excess = sphere[3] * sphere[3] - dot3(offset, offset);
    real way = root(projection * projection + r->length * r->length * excess);
    way = sphere[3] < 0.0 ? projection - way : projection + way;
    real path = index * way / r->length;
    r->path -= path;
    return finite(path);
}

// A surface's height over its conic, with slopes.
typedef struct { real value, slope_x, slope_y; } height;

// Heights over the vertex plane: each function returns one and adds its slopes to *slope_x and *slope_y.

INLINE real even_powers(__global const double *a, const int count, real x, real y,
                        real *slope_x, real *slope_y)
{
    real square = x * x + y * y, value = a[count - 1], derivative = 0.0;
    #pragma unroll
    for (int i = count - 2; i >= -1; --i) {
        derivative = derivative * square + value;
        value = i < 0 ? value * square : value * square + a[i];
    }
    *slope_x += 2.0 * derivative * x;
    *slope_y += 2.0 * derivative * y;
    return value;
}

#define EACH 1
#define READ(place) (*(place))
#include "monomials.h"
#include "ring.h"

INLINE real monomials(__global const double *a, const int degree, real x, real y, real *slope_x, real *slope_y)
{
    real along_x, along_y;
    real value = monomial_sum(a, degree, x, y, &along_x, &along_y);
    *slope_x += along_x;
    *slope_y += along_y;
    return value;
}

// The first of `step` is 1 / radius; the others follow.
INLINE real ring(__global const double *a, const int degree, __global const double *step, real x, real y,
                 real *slope_x, real *slope_y)
{
    real along_u, along_v;
    real value = ring_sum(a, degree, step + 1, step[0] * x, step[0] * y, &along_u, &along_v);
    *slope_x += step[0] * along_u;
    *slope_y += step[0] * along_v;
    return value;
}

#if W > 1
typedef union { integers all; int lane[W]; } integer_lanes;
typedef union { real all; double lane[W]; } real_lanes;
#endif

// The first of four nodes about `place`, in node spacings, and the weights of their cubic B-splines. The
// spline ends where it lacks a fourth node; NaN goes to its first piece, so that nothing else is ever read.
INLINE integers spline_weights(real place, int nodes, real *weight, real *slope)
{
    real within = EITHER(place >= 1.0, place, (real)1.0);
    within = EITHER(within <= nodes - 2.0, within, (real)(nodes - 2.0));
    integers first = to_integers(EITHER(within < nodes - 3.0, within, (real)(nodes - 3.0)));
    real t = within - to_real(first);
    real s = 1.0 - t, inside = EITHER(within == place, (real)1.0, (real)0.0);
    weight[0] = s * s * s * (1.0 / 6.0);
    weight[1] = (4.0 - t * t * (6.0 - 3.0 * t)) * (1.0 / 6.0);
    weight[2] = (4.0 - s * s * (6.0 - 3.0 * s)) * (1.0 / 6.0);
    weight[3] = t * t * t * (1.0 / 6.0);
    slope[0] = -0.5 * s * s * inside;
    slope[1] = (1.5 * t - 2.0) * t * inside;
    slope[2] = (2.0 - 1.5 * s) * s * inside;
    slope[3] = 0.5 * t * t * inside;
    return first - 1;
}

// Place holds x0, y0, 1 / dx and 1 / dy.
INLINE real spline_grid(__global const double *a, const int rows, const int columns,
                        __global const double *place, real x, real y, real *slope_x, real *slope_y)
{
    real weight_x[4], weight_y[4], steep_x[4], steep_y[4];
    integers column = spline_weights((x - place[0]) * place[2], columns, weight_x, steep_x);
    integers row = spline_weights((y - place[1]) * place[3], rows, weight_y, steep_y);
    real value = 0.0, along_x = 0.0, along_y = 0.0;
#if W == 1
    __global const double *corner = a + row * columns + column;
#else
    integer_lanes corner;
    corner.all = row * columns + column;
#endif
    // Rows stay a loop: the nodes of 16 lanes are loaded one by one, and compilers take long over them.
    #pragma unroll 1
    for (int j = 0; j < 4; ++j) {
        real line = 0.0, steep = 0.0;
        #pragma unroll
        for (int i = 0; i < 4; ++i) {
#if W == 1
            real node = corner[j * columns + i];
#else
            real_lanes nodes;
            #pragma unroll
            for (int lane = 0; lane < W; ++lane)
                nodes.lane[lane] = a[corner.lane[lane] + j * columns + i];
            real node = nodes.all;
#endif
            line += weight_x[i] * node;
            steep += steep_x[i] * node;
        }
        value += weight_y[j] * line;
        along_x += weight_y[j] * steep;
        along_y += steep_y[j] * line;
    }
    *slope_x += along_x * place[2];
    *slope_y += along_y * place[3];
    return value;
}
