// Traces rays through a segmented telescope: segments of M1, further mirrors, image plane, reference sphere.
//
// Work-item (lane group, ray, tile). Compile-time constants: W instants per work-item, EDGES per segment
// (0: no edge), DEGREE and MIRROR_DEGREE of the figure polynomials of segments and of the mirrors after M1
// (-1: none), SURFACES after M1 (the last is the image plane), PLANES (bit i: surface i is a plane), EDGED
// (bit i: surface i has an edge).

#include "lanes.h"
#include "rays.h"

#define TERMS(degree) (((degree) + 1) * ((degree) + 2) / 2)

enum { OK = 0, GAP = 1, MISS = 2 };

#if DEGREE >= 0
#define FIGURE(part) segment_figure_##part
#define ORDER DEGREE
#include "figure.h"
#undef FIGURE
#undef ORDER
#endif
#if MIRROR_DEGREE >= 0
#define FIGURE(part) mirror_figure_##part
#define ORDER MIRROR_DEGREE
#include "figure.h"
#endif

// Reflect at the first candidate whose glass the ray meets. The search runs in each segment's displaced
// frame; the ray itself stays in the optics frame, where the step is the same and only the normal has to be
// turned back.
INLINE mask reflect_at_segments(ray *r, int candidates, __global const int *candidate,
                                __global const double *poses, __global const double *figures,
                                __global const double *edges, __global const double *frames,
                                double c, double k1)
{
    mask found = 0;
    real step = 0.0;
    triple normal = {0.0, 0.0, -1.0};
    for (int i = 0; i < candidates; ++i) {
        const int segment = candidate[i];
        if (segment < 0)
            continue;
        __global const double *pose = poses + (size_t)segment * 12 * 16;
        triple start = moved(pose, r->position), d = turned(pose, r->direction);
        real to_glass = conic_step(start, d, c, k1);
        triple hit = along(start, to_glass, d);
        triple lean = conic_normal(hit, c, k1);
#if DEGREE >= 0
        __global const double *figure = figures + (size_t)segment * TERMS(DEGREE) * 16;
        real further = segment_figure_step(figure, frames + 4 * segment, hit, d, c, k1, &lean);
        hit = along(hit, further, d);
        to_glass += further;
#endif
        mask inside = finite(to_glass) & (lean.z < 0.0);
        #pragma unroll
        for (int edge = 0; edge < EDGES; ++edge) {
            __global const double *line = edges + 3 * (EDGES * segment + edge);
            inside &= line[0] * hit.x + line[1] * hit.y <= line[2];
        }
        mask chosen = inside & NOT(found);
        lean = turned_back(pose, lean);
        step = EITHER(chosen, to_glass, step);
        normal.x = EITHER(chosen, lean.x, normal.x);
        normal.y = EITHER(chosen, lean.y, normal.y);
        normal.z = EITHER(chosen, lean.z, normal.z);
        found |= inside;
    }
    advance(r, step);
    reflect(r, normal);
    return found;
}

// Reflect at surface i after M1, or stop there if it is the last; tells whether the ray met its clear part.
INLINE mask reflect_at_surface(ray *r, int i, __global const double *pose, double c, double k1,
                               double clear_square, __global const double *figure,
                               __global const double *frame)
{
    r->position = moved(pose, r->position);
    r->direction = turned(pose, r->direction);
    mask met;
    if ((PLANES >> i & 1) && (MIRROR_DEGREE < 0 || i == SURFACES - 1)) {
        real step = -r->position.z / r->direction.z;
        advance(r, step);
        met = finite(step);
        if (EDGED >> i & 1)
            met &= r->position.x * r->position.x + r->position.y * r->position.y <= clear_square;
        if (i < SURFACES - 1)
            r->direction.z = -r->direction.z;
    } else {
        real step = conic_step(r->position, r->direction, c, k1);
        advance(r, step);
        triple normal = conic_normal(r->position, c, k1);
#if MIRROR_DEGREE >= 0
        real further = mirror_figure_step(figure, frame, r->position, r->direction, c, k1, &normal);
        advance(r, further);
        step += further;
#endif
        met = finite(step) & (normal.z < 0.0);
        if (EDGED >> i & 1)
            met &= r->position.x * r->position.x + r->position.y * r->position.y <= clear_square;
        reflect(r, normal);
    }
    return met;
}

__kernel void segmented(
    const int rays, const int segments, const int candidates,
    const double start_z, const double c, const double k1, const double sphere_square,
    __global const double *ray_x, __global const double *ray_y, __global const int *candidate,
    __global const double *edges, __global const double *frames,
    __global const double *curvatures, __global const double *conics_plus_1,
    __global const double *clear_squares, __global const double *mirror_frames,
    __global const double *segment_poses, __global const double *figures,
    __global const double *surface_poses, __global const double *mirror_figures,
    __global const double *directions, __global const double *chief,
    __global double *out_opd, __global double *out_x, __global double *out_y, __global char *out_status)
{
    const size_t lane = get_global_id(0) * W, n = get_global_id(1), tile = get_global_id(2);
    if (n >= rays)
        return;
    directions += tile * 3 * 16 + lane;
    chief += tile * 3 * 16 + lane;
    segment_poses += tile * segments * 12 * 16 + lane;
    surface_poses += tile * SURFACES * 12 * 16 + lane;
#if DEGREE >= 0
    figures += tile * segments * TERMS(DEGREE) * 16 + lane;
#endif
#if MIRROR_DEGREE >= 0
    mirror_figures += tile * (SURFACES - 1) * TERMS(MIRROR_DEGREE) * 16 + lane;
#endif

    triple light = {LOAD(directions), LOAD(directions + 16), LOAD(directions + 32)};
    ray r = {{ray_x[n], ray_y[n], start_z}, light, 1.0};
    r.path = dot3(r.position, r.direction);
    mask met = reflect_at_segments(&r, candidates, candidate + n * candidates, segment_poses, figures,
                                   edges, frames, c, k1);
    mask status = EITHER(met, (mask)OK, (mask)GAP);
    #pragma unroll
    for (int i = 0; i < SURFACES; ++i) {
        met = reflect_at_surface(&r, i, surface_poses + i * 12 * 16, curvatures[i], conics_plus_1[i],
                                 clear_squares[i], mirror_figures + i * TERMS(MIRROR_DEGREE) * 16, mirror_frames + i * 4);
        status = EITHER(NOT(met) & (status == OK), (mask)(MISS + i), status);
    }
    real back = back_to_sphere(&r, LOAD(chief), LOAD(chief + 16), sphere_square);
    real opd = LOAD(chief + 32) - (r.path - back);
    status = EITHER(NOT(finite(opd)) & (status == OK), (mask)(MISS + SURFACES), status);

    const size_t out = (tile * rays + n) * 16 + lane;
    const mask lost = status != OK;
    STORE(EITHER(lost, (real)NAN, opd), out_opd + out);
    STORE(EITHER(lost, (real)NAN, r.position.x), out_x + out);
    STORE(EITHER(lost, (real)NAN, r.position.y), out_y + out);
    STORE_STATUS(status, out_status + out);
}
