// Traces rays through a segmented telescope: segments of M1, mirrors and lenses, image plane, reference sphere.
//
// Work-item (lane group, group of RAYS, tile). Compile-time constants: W instants in a vector, EDGES per segment
// (0: no edge), CONVEX (whether edges are half planes that hold all of the glass), DEGREE and MIRROR_DEGREE of
// the figure polynomials of segments and of the mirrors after M1 (-1: none), SEGMENT_RING and MIRROR_RING
// (whether these are evaluated by recurrences), SEGMENT_CHECKED and MIRROR_CHECKED (whether two steps onto them
// may not do), SURFACES after M1 (the last is the image plane), PLANES (bit i: surface i is a plane), EDGED (bit
// i: surface i has an edge), REFRACTS (bit i: surface i refracts; indices[i] is the refractive index before it).

#include "lanes.h"
#include "rays.h"
#include "status.h"

#define TERMS(degree) (((degree) + 1) * ((degree) + 2) / 2)

// Of an edge.
#define NUMBERS (CONVEX ? 3 : 5)

#define NEWTON_STEPS 30
// Newton's iteration ends with the step after one this short: its square leaves only rounding.
#define SHORT 1e-7
// Square of the radius, in that of its circle, to which what is known of a figure's bend reaches.
#define REACH 1.04
// By so many mm the second step onto a figured mirror may change what the conic's curvature adds to it.
#define LEAN 1e-12

#define EACH 16
#define READ(place) LOAD(place)
#include "monomials.h"
#include "ring.h"
#if DEGREE >= 0
#define FIGURE(part) segment_figure_##part
#define ORDER DEGREE
#define RING SEGMENT_RING
#define CHECKED SEGMENT_CHECKED
#include "figure.h"
#undef FIGURE
#undef ORDER
#undef RING
#undef CHECKED
#endif
#if MIRROR_DEGREE >= 0
#define FIGURE(part) mirror_figure_##part
#define ORDER MIRROR_DEGREE
#define RING MIRROR_RING
#define CHECKED MIRROR_CHECKED
#include "figure.h"
#endif

#define AT_M1 (-1) // of which the surfaces after it are 0, 1, ...

// The rays of a work-item take turns at every step, so that one hides the other's waiting.
#define EACH_TURN _Pragma("unroll") for (int k = 0; k < RAYS; ++k)

// Where a ray meets a segment's conic, in the segment's displaced frame.
typedef struct { real step; triple hit, direction, lean; } meeting;
// What the search has found, in the optics frame; `loss` is that of a gap until a ray meets glass.
typedef struct { real step, loss; triple normal; } sighting;

INLINE meeting meet_conic(const ray *r, __global const double *pose, double c, double k1)
{
    meeting m;
    const triple start = moved(pose, r->position);
    m.direction = turned(pose, r->direction);
    m.step = conic_step(start, m.direction, c, k1);
    m.hit = along(start, m.step, m.direction);
    m.lean = conic_normal(m.hit, c, k1);
    return m;
}

// The first segment whose glass a ray meets counts.
INLINE void keep_if_on_glass(sighting *s, const meeting *m, __global const double *pose,
                             __global const double *line)
{
    real beyond = larger(m->lean.z, LOSS(GAP, AT_M1) - s->loss);
#if CONVEX
    #pragma unroll
    for (int edge = 0; edge < EDGES; ++edge)
        beyond = larger(line[3 * edge] * m->hit.x + (line[3 * edge + 1] * m->hit.y - line[3 * edge + 2]),
                        beyond);
#else
    // A way to +x crosses an odd number of edges.
    real outside = 1.0;
    for (int edge = 0; edge < EDGES; ++edge, line += 5) {
        const real side = line[0] * m->hit.x + (line[1] * m->hit.y - line[2]);
        const mask beside = (m->hit.y >= line[3]) & (m->hit.y < line[4]) & (line[0] * side < 0.0);
        outside = EITHER(beside, -outside, outside);
    }
    beyond = larger(outside, beyond);
#endif
    const mask first = beyond + poison(m->step) <= 0.0;
    const triple normal = turned_back(pose, m->lean);
    s->step = EITHER(first, m->step, s->step);
    s->normal.x = EITHER(first, normal.x, s->normal.x);
    s->normal.y = EITHER(first, normal.y, s->normal.y);
    s->normal.z = EITHER(first, normal.z, s->normal.z);
    s->loss = EITHER(first, (real)0.0, s->loss);
}

// What belongs to segments at the instants of a vector.
typedef struct {
    __global const double *poses, *figures, *limits, *frames, *edges, *steps;
    double c, k1;
} mirror;

// So many rays try one segment. The search runs in its displaced frame; the ray itself stays in the optics
// frame, where the step is the same and only the normal has to be turned back.
INLINE void try_segment(const ray *r, sighting *s, const int rays, mirror glass, int segment)
{
    __global const double *pose = glass.poses + (size_t)segment * 12 * 16;
    meeting m[RAYS];
    #pragma unroll
    for (int k = 0; k < rays; ++k)
        m[k] = meet_conic(&r[k], pose, glass.c, glass.k1);
#if DEGREE >= 0
    __global const double *figure = glass.figures + (size_t)segment * TERMS(DEGREE) * 16;
    __global const double *frame = glass.frames + 4 * segment;
    real first[RAYS];
    #pragma unroll
    for (int k = 0; k < rays; ++k)
        first[k] = segment_figure_first(figure, glass.steps, frame, m[k].hit, m[k].direction, m[k].lean);
    #pragma unroll
    for (int k = 0; k < rays; ++k) {
        const real limit = SEGMENT_CHECKED ? LOAD(glass.limits + 16 * segment) : (real)0.0;
        m[k].hit = along(m[k].hit, first[k], m[k].direction);
        m[k].step += first[k];
        segment_figure_second(figure, glass.steps, frame, m[k].direction, glass.c, glass.k1, limit,
                              first[k], &m[k].hit, &m[k].step, &m[k].lean);
    }
#endif
    #pragma unroll
    for (int k = 0; k < rays; ++k)
        keep_if_on_glass(&s[k], &m[k], pose, glass.edges + NUMBERS * EDGES * segment);
}

// Rays come segment by segment: while the last ray of one is traced, what belongs to the next can be fetched.
INLINE void fetch(__global const double *first, int numbers)
{
#if W > 1 && __has_builtin(__builtin_prefetch)
    for (int i = 0; i < numbers; i += 8)
        __builtin_prefetch((const void *)(size_t)(first + i));
#endif
}

INLINE real lose_beyond(const ray *r, double clear_square, real loss, double other)
{
    const triple p = r->position;
    return lose_unless(p.x * p.x + p.y * p.y <= clear_square, loss, other);
}

__kernel void segmented(
    const int rays, const int segments, const int candidates,
    const double start_z, const double c, const double k1, const double sphere_radius,
    __global const double *ray_x, __global const double *ray_y, __global const int *candidate,
    __global const double *edges, __global const double *frames,
    __global const double *curvatures, __global const double *conics_plus_1,
    __global const double *clear_squares, __global const double *indices, __global const double *mirror_frames,
    __global const double *segment_steps, __global const double *mirror_steps,
    __global const double *segment_limits, __global const double *mirror_limits,
    __global const double *segment_poses, __global const double *figures,
    __global const double *surface_poses, __global const double *mirror_figures,
    __global const double *directions, __global const double *chief,
    __global double *out_opd, __global double *out_x, __global double *out_y, __global char *out_status)
{
    ALIGN_STACK;
    const size_t lane = get_global_id(0) * W, group = get_global_id(1) * RAYS, tile = get_global_id(2);
    if (group >= rays)
        return;
    // The last group overlaps the one before it.
    const size_t n = group + RAYS > rays ? rays - RAYS : group;
    directions += tile * 3 * 16 + lane;
    chief += tile * 3 * 16 + lane;
    segment_poses += tile * segments * 12 * 16 + lane;
    surface_poses += tile * SURFACES * 12 * 16 + lane;
#if DEGREE >= 0
    figures += tile * segments * TERMS(DEGREE) * 16 + lane;
    segment_limits += SEGMENT_CHECKED ? tile * segments * 16 + lane : 0;
#endif
#if MIRROR_DEGREE >= 0
    mirror_figures += tile * (SURFACES - 1) * TERMS(MIRROR_DEGREE) * 16 + lane;
    mirror_limits += MIRROR_CHECKED ? tile * (SURFACES - 1) * 16 + lane : 0;
#endif

    if (candidates > 0 && n + RAYS < rays) {
        const int now = candidate[n * candidates], next = candidate[(n + RAYS) * candidates];
        if (next >= 0 && next != now) {
            fetch(segment_poses + (size_t)next * 12 * 16, 12 * 16);
#if DEGREE >= 0
            fetch(figures + (size_t)next * TERMS(DEGREE) * 16, TERMS(DEGREE) * 16);
#endif
        }
    }

    ray r[RAYS];
    sighting s[RAYS];
    EACH_TURN {
        const triple light = {LOAD(directions), LOAD(directions + 16), LOAD(directions + 32)};
        r[k].position.x = ray_x[n + k];
        r[k].position.y = ray_y[n + k];
        r[k].position.z = start_z;
        r[k].direction = light;
        r[k].length = 1.0;
        r[k].path = dot3(r[k].position, light);
        s[k].step = 0.0;
        s[k].loss = LOSS(GAP, AT_M1);
        s[k].normal.x = 0.0;
        s[k].normal.y = 0.0;
        s[k].normal.z = -1.0;
    }
    const mirror glass = {segment_poses, figures, segment_limits, frames, edges, segment_steps, c, k1};
    for (int i = 0; i < candidates; ++i) {
        __global const int *tried = candidate + n * candidates + i;
        int same = 1;
        #pragma unroll
        for (int k = 1; k < RAYS; ++k)
            same &= tried[k * candidates] == tried[0];
        if (!same) {
            #pragma unroll
            for (int k = 0; k < RAYS; ++k)
                if (tried[k * candidates] >= 0)
                    try_segment(r + k, s + k, 1, glass, tried[k * candidates]);
        } else if (tried[0] >= 0)
            try_segment(r, s, RAYS, glass, tried[0]);
    }
    real loss[RAYS];
    EACH_TURN {
        advance(&r[k], s[k].step);
        reflect(&r[k], s[k].normal);
        loss[k] = s[k].loss;
    }

    #pragma unroll
    for (int i = 0; i < SURFACES; ++i) {
        __global const double *pose = surface_poses + i * 12 * 16;
        const int plane = (PLANES >> i & 1) && (MIRROR_DEGREE < 0 || i == SURFACES - 1);
        const double before = REFRACTS ? indices[i] : 1.0;
        real step[RAYS];
        triple normal[RAYS];
        EACH_TURN {
            r[k].position = moved(pose, r[k].position);
            r[k].direction = turned(pose, r[k].direction);
            step[k] = plane ? -r[k].position.z / r[k].direction.z
                            : conic_step(r[k].position, r[k].direction, curvatures[i], conics_plus_1[i]);
        }
#if MIRROR_DEGREE >= 0
        if (!plane) {
            EACH_TURN {
                travel(&r[k], step[k], before);
                normal[k] = conic_normal(r[k].position, curvatures[i], conics_plus_1[i]);
            }
            __global const double *figure = mirror_figures + i * TERMS(MIRROR_DEGREE) * 16;
            real first[RAYS];
            EACH_TURN first[k] = mirror_figure_first(figure, mirror_steps, mirror_frames + i * 4,
                                                     r[k].position, r[k].direction, normal[k]);
            EACH_TURN {
                real further = first[k];
                const real limit = MIRROR_CHECKED ? LOAD(mirror_limits + 16 * i) : (real)0.0;
                r[k].position = along(r[k].position, further, r[k].direction);
                mirror_figure_second(figure, mirror_steps, mirror_frames + i * 4, r[k].direction,
                                     curvatures[i], conics_plus_1[i], limit, first[k], &r[k].position, &further,
                                     &normal[k]);
                r[k].path += further * (before * r[k].length);
                step[k] += further;
            }
        }
#endif
        EACH_TURN {
            if (plane || MIRROR_DEGREE < 0)
                travel(&r[k], step[k], before);
            if (plane) {
                loss[k] = lose_unless(finite(step[k]), loss[k], LOSS(MISS, i));
                normal[k].x = normal[k].y = 0.0;
                normal[k].z = -1.0;
                if (i < SURFACES - 1 && !(REFRACTS >> i & 1))
                    r[k].direction.z = -r[k].direction.z;
            } else {
                if (MIRROR_DEGREE < 0)
                    normal[k] = conic_normal(r[k].position, curvatures[i], conics_plus_1[i]);
                loss[k] = lose_unless(normal[k].z + poison(step[k]) < 0.0, loss[k], LOSS(MISS, i));
                if (!(REFRACTS >> i & 1))
                    reflect(&r[k], normal[k]);
            }
            if (REFRACTS >> i & 1)
                loss[k] = lose_unless(refract(&r[k], normal[k], before / indices[i + 1]), loss[k],
                                      LOSS(TOTAL_REFLECTION, i));
            if (EDGED >> i & 1)
                loss[k] = lose_beyond(&r[k], clear_squares[i], loss[k], LOSS(VIGNETTED, i));
        }
    }

    EACH_TURN {
        const size_t out = (tile * rays + n + k) * 16 + lane;
        const real back = back_to_sphere(&r[k], LOAD(chief), LOAD(chief + 16), sphere_radius);
        const real opd = LOAD(chief + 32) - (r[k].path - back);
        loss[k] = lose_unless(finite(opd), loss[k], LOSS(MISS, SURFACES));
        const mask lost = loss[k] > 0.0;
        STORE(EITHER(lost, (real)NAN, opd), out_opd + out);
        STORE(EITHER(lost, (real)NAN, r[k].position.x), out_x + out);
        STORE(EITHER(lost, (real)NAN, r[k].position.y), out_y + out);
        STORE_STATUS(status_of(loss[k]) + 8 * (surface_of(loss[k]) + 1), out_status + out);
    }
}
