// Traces rays through a segmented telescope: segments of M1, further mirrors, image plane, reference sphere.
//
// Work-item (lane group, ray, tile). Compile-time constants: W instants in a vector, TURNS vectors per
// work-item, EDGES per segment
// (0: no edge), CONVEX (whether edges are half planes that hold all of the glass), DEGREE and MIRROR_DEGREE of the figure polynomials of segments and of the mirrors after M1
// (-1: none), SEGMENT_RING and MIRROR_RING (whether these are evaluated by recurrences), SURFACES after M1 (the last is the image plane), PLANES (bit i: surface i is a plane), EDGED
// (bit i: surface i has an edge).

#include "lanes.h"
#include "rays.h"

#define TERMS(degree) (((degree) + 1) * ((degree) + 2) / 2)

// Of an edge.
#define NUMBERS (CONVEX ? 3 : 5)

enum { OK = 0, GAP = 1, MISS = 2 };

#if SEGMENT_RING || MIRROR_RING
#define EACH 16
#define READ(place) LOAD(place)
#include "ring.h"
#endif
#if DEGREE >= 0
#define FIGURE(part) segment_figure_##part
#define ORDER DEGREE
#define RING SEGMENT_RING
#include "figure.h"
#undef FIGURE
#undef ORDER
#undef RING
#endif
#if MIRROR_DEGREE >= 0
#define FIGURE(part) mirror_figure_##part
#define ORDER MIRROR_DEGREE
#define RING MIRROR_RING
#include "figure.h"
#endif

// Why a ray is lost is a number that is the larger, the earlier the loss: masks that are combined with one
// another cost processors without 512-bit vectors as much as the trace itself.
#define LOSS(status) (256.0 - (status))

// The vectors of a work-item take turns at every step, so that one hides the other's waiting.
#define EACH_TURN _Pragma("unroll") for (int k = 0; k < TURNS; ++k)

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
    real beyond = larger(m->lean.z, LOSS(GAP) - s->loss);
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
    const double start_z, const double c, const double k1, const double sphere_square,
    __global const double *ray_x, __global const double *ray_y, __global const int *candidate,
    __global const double *edges, __global const double *frames,
    __global const double *curvatures, __global const double *conics_plus_1,
    __global const double *clear_squares, __global const double *mirror_frames,
    __global const double *segment_steps, __global const double *mirror_steps,
    __global const double *segment_poses, __global const double *figures,
    __global const double *surface_poses, __global const double *mirror_figures,
    __global const double *directions, __global const double *chief,
    __global double *out_opd, __global double *out_x, __global double *out_y, __global char *out_status)
{
    ALIGN_STACK;
    const size_t lane = get_global_id(0) * (TURNS * W), n = get_global_id(1), tile = get_global_id(2);
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

    if (candidates > 0 && n + 1 < rays) {
        const int now = candidate[n * candidates], next = candidate[(n + 1) * candidates];
        if (next >= 0 && next != now) {
            fetch(segment_poses + (size_t)next * 12 * 16, 12 * 16);
#if DEGREE >= 0
            fetch(figures + (size_t)next * TERMS(DEGREE) * 16, TERMS(DEGREE) * 16);
#endif
        }
    }

    ray r[TURNS];
    sighting s[TURNS];
    EACH_TURN {
        const triple light = {LOAD(directions + k * W), LOAD(directions + 16 + k * W),
                              LOAD(directions + 32 + k * W)};
        r[k].position.x = ray_x[n];
        r[k].position.y = ray_y[n];
        r[k].position.z = start_z;
        r[k].direction = light;
        r[k].length = 1.0;
        r[k].path = dot3(r[k].position, light);
        s[k].step = 0.0;
        s[k].loss = LOSS(GAP);
        s[k].normal.x = 0.0;
        s[k].normal.y = 0.0;
        s[k].normal.z = -1.0;
    }
    // The search runs in each segment's displaced frame; the ray itself stays in the optics frame, where the
    // step is the same and only the normal has to be turned back.
    for (int i = 0; i < candidates; ++i) {
        const int segment = candidate[n * candidates + i];
        if (segment < 0)
            continue;
        __global const double *pose = segment_poses + (size_t)segment * 12 * 16;
        meeting m[TURNS];
        EACH_TURN m[k] = meet_conic(&r[k], pose + k * W, c, k1);
#if DEGREE >= 0
        __global const double *figure = figures + (size_t)segment * TERMS(DEGREE) * 16;
        real further[TURNS];
        EACH_TURN further[k] = segment_figure_first(figure + k * W, segment_steps, frames + 4 * segment,
                                                    m[k].hit, m[k].direction, m[k].lean);
        EACH_TURN further[k] += segment_figure_second(figure + k * W, segment_steps, frames + 4 * segment,
                                                      m[k].hit, m[k].direction, further[k], c, k1,
                                                      &m[k].lean);
        EACH_TURN m[k].hit = along(m[k].hit, further[k], m[k].direction);
        EACH_TURN m[k].step += further[k];
#endif
        EACH_TURN keep_if_on_glass(&s[k], &m[k], pose + k * W, edges + NUMBERS * EDGES * segment);
    }
    real loss[TURNS];
    EACH_TURN {
        advance(&r[k], s[k].step);
        reflect(&r[k], s[k].normal);
        loss[k] = s[k].loss;
    }

    #pragma unroll
    for (int i = 0; i < SURFACES; ++i) {
        __global const double *pose = surface_poses + i * 12 * 16;
        EACH_TURN {
            r[k].position = moved(pose + k * W, r[k].position);
            r[k].direction = turned(pose + k * W, r[k].direction);
        }
        if ((PLANES >> i & 1) && (MIRROR_DEGREE < 0 || i == SURFACES - 1)) {
            EACH_TURN {
                const real step = -r[k].position.z / r[k].direction.z;
                advance(&r[k], step);
                loss[k] = lose_unless(finite(step), loss[k], LOSS(MISS + i));
                if (EDGED >> i & 1)
                    loss[k] = lose_beyond(&r[k], clear_squares[i], loss[k], LOSS(MISS + i));
                if (i < SURFACES - 1)
                    r[k].direction.z = -r[k].direction.z;
            }
            continue;
        }
        real step[TURNS];
        triple normal[TURNS];
        EACH_TURN step[k] = conic_step(r[k].position, r[k].direction, curvatures[i], conics_plus_1[i]);
        EACH_TURN advance(&r[k], step[k]);
        EACH_TURN normal[k] = conic_normal(r[k].position, curvatures[i], conics_plus_1[i]);
#if MIRROR_DEGREE >= 0
        __global const double *figure = mirror_figures + i * TERMS(MIRROR_DEGREE) * 16;
        real further[TURNS];
        EACH_TURN further[k] = mirror_figure_first(figure + k * W, mirror_steps, mirror_frames + i * 4,
                                                   r[k].position, r[k].direction, normal[k]);
        EACH_TURN further[k] += mirror_figure_second(figure + k * W, mirror_steps, mirror_frames + i * 4,
                                                     r[k].position, r[k].direction, further[k],
                                                     curvatures[i], conics_plus_1[i], &normal[k]);
        EACH_TURN advance(&r[k], further[k]);
        EACH_TURN step[k] += further[k];
#endif
        EACH_TURN {
            loss[k] = lose_unless(normal[k].z + poison(step[k]) < 0.0, loss[k], LOSS(MISS + i));
            if (EDGED >> i & 1)
                loss[k] = lose_beyond(&r[k], clear_squares[i], loss[k], LOSS(MISS + i));
            reflect(&r[k], normal[k]);
        }
    }

    const size_t out = (tile * rays + n) * 16 + lane;
    EACH_TURN {
        const real back = back_to_sphere(&r[k], LOAD(chief + k * W), LOAD(chief + 16 + k * W), sphere_square);
        const real opd = LOAD(chief + 32 + k * W) - (r[k].path - back);
        loss[k] = lose_unless(finite(opd), loss[k], LOSS(MISS + SURFACES));
        const mask lost = loss[k] > 0.0;
        STORE(EITHER(lost, (real)NAN, opd), out_opd + out + k * W);
        STORE(EITHER(lost, (real)NAN, r[k].position.x), out_x + out + k * W);
        STORE(EITHER(lost, (real)NAN, r[k].position.y), out_y + out + k * W);
        STORE_STATUS(to_integers(EITHER(lost, LOSS(loss[k]), (real)OK)), out_status + out + k * W);
    }
}
