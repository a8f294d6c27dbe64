// Sums over the rays of wavefronts: coefficients of a fit, and moments of wavefront and spot.
//
// Compile-time constants: W lanes, SINGLE (0), TALL instants and WIDE vectors of functions that share what is
// read: as many sums as registers hold, SHARED (1: other work-items sum other functions of the same instants,
// and each looks at the rays itself; 0: a work-item copies CHUNK rays at a time, whole vectors of them), TILED
// (see below).

#include "waves.h"

// What is not a number, or infinite, marks a lost ray.
#define FINITE(value) LIT((value) - (value) == 0)
#define WHERE(mask, value) TO_REAL(TO_WHOLE(value) & (mask))

INLINE scalar sum_of(real value)
{
    scalar sum = 0;
    for (int lane = 0; lane < W; ++lane)
        sum += LANE(value, lane);
    return sum;
}

// Sum rays' values (instants, rays) times functions (rays, terms) at them, and count (instants) the lost rays,
// which add nothing.
__kernel void coefficients(const int instants, const int rays, const int terms,
                           __global const scalar *functions, __global const scalar *values,
                           __global scalar *sums, __global int *lost)
{
    const int term = get_global_id(0) * WIDE * W, first = get_global_id(1) * TALL;
    if (term >= terms || first >= instants)
        return;
    __global const scalar *row[TALL];
    #pragma unroll
    for (int i = 0; i < TALL; ++i)  // beyond the last instant comes the last one again
        row[i] = values + (size_t)(first + i < instants ? first + i : instants - 1) * rays;
    functions += term;
    real total[TALL][WIDE];
    int missing[TALL];
    #pragma unroll
    for (int i = 0; i < TALL; ++i) {
        missing[i] = 0;
        #pragma unroll
        for (int wide = 0; wide < WIDE; ++wide)
            total[i][wide] = 0.0f;
    }
#if SHARED
    for (int ray = 0; ray < rays; ++ray, functions += terms)
        for (int i = 0; i < TALL; ++i) {
            const scalar value = row[i][ray];
            const int is_lost = value - value != 0;
            const scalar known = is_lost ? 0 : value;
            missing[i] += is_lost;
            for (int wide = 0; wide < WIDE; ++wide)
                total[i][wide] += known * LOAD(functions + wide * W);
        }
#else
    __local scalar known[TALL * CHUNK];
    // Sums that stay finite need not look at each ray, which takes a seventh more; those that do not begin anew.
    int none_lost = 1;
    __global const scalar *of_ray = functions;
    for (int start = 0; start < rays && none_lost; start += CHUNK) {
        const int end = start + CHUNK < rays ? start + CHUNK : rays;
        for (int ray = start; ray < end; ++ray, of_ray += terms) {
            real function[WIDE];
            PREFETCH(row[ray % 8 % TALL] + CHUNK + ray / 8 * 8);
            #pragma unroll
            for (int wide = 0; wide < WIDE; ++wide)
                function[wide] = LOAD(of_ray + wide * W);
            #pragma unroll
            for (int i = 0; i < TALL; ++i)
                #pragma unroll
                for (int wide = 0; wide < WIDE; ++wide)
                    total[i][wide] += row[i][ray] * function[wide];
        }
        real beyond = 0.0f;
        #pragma unroll
        for (int i = 0; i < TALL; ++i)
            beyond += total[i][0] - total[i][0];
        none_lost = sum_of(beyond) == 0;
    }
    #pragma unroll
    for (int i = 0; i < TALL; ++i)
        #pragma unroll
        for (int wide = 0; wide < WIDE; ++wide)
            total[i][wide] = none_lost ? total[i][wide] : (real)0.0f;
    for (int start = none_lost ? rays : 0; start < rays; start += CHUNK) {
        const int count = rays - start < CHUNK ? rays - start : CHUNK, whole_vectors = count / W * W;
        #pragma unroll
        for (int i = 0; i < TALL; ++i) {
            whole not_lost = 0;
            for (int k = 0; k < whole_vectors; k += W) {
                const real value = LOAD(row[i] + start + k);
                const whole is_known = FINITE(value);
                not_lost += is_known;
                STORE_LOCAL(WHERE(is_known, value), known + i * CHUNK + k);
            }
            missing[i] += whole_vectors;
            for (int lane = 0; lane < W; ++lane)
                missing[i] += LANE(not_lost, lane);  // whose lanes are -1 for each ray
            for (int k = whole_vectors; k < count; ++k) {
                const scalar value = row[i][start + k];
                const int is_lost = value - value != 0;
                missing[i] += is_lost;
                known[i * CHUNK + k] = is_lost ? 0 : value;
            }
        }
        for (int k = 0; k < count; ++k, functions += terms) {
            real function[WIDE];
            PREFETCH(row[k % 8 % TALL] + start + CHUNK + k / 8 * 8);
            #pragma unroll
            for (int wide = 0; wide < WIDE; ++wide)
                function[wide] = LOAD(functions + wide * W);
            #pragma unroll
            for (int i = 0; i < TALL; ++i)
                #pragma unroll
                for (int wide = 0; wide < WIDE; ++wide)
                    total[i][wide] += known[i * CHUNK + k] * function[wide];
        }
    }
#endif
    #pragma unroll
    for (int i = 0; i < TALL; ++i)
        if (first + i < instants) {
            #pragma unroll
            for (int wide = 0; wide < WIDE; ++wide)
                STORE(total[i][wide], sums + (size_t)(first + i) * terms + term + wide * W);
            if (term == 0)
                lost[first + i] = missing[i];
        }
}

// Lanes are rays, of which sums are taken; if TILED, instants of a tile of 16, ray by ray.
#if TILED
typedef real number;
#define TOTAL(value) (value)
#define FOUND(place, value) STORE(value, found + 16 * (place))
#else
typedef scalar number;
#define TOTAL(value) sum_of(value)
#define FOUND(place, value) found[place] = (value)
#endif

INLINE number root_of(number value)
{
#if TILED
    for (int lane = 0; lane < W; ++lane)  // the built-in function of vectors is a call
        LANE(value, lane) = sqrt(LANE(value, lane));
    return value;
#else
    return sqrt(value);
#endif
}

typedef struct { real opd, flat, x, y, weight; whole known; } ray_lanes;

// W rays: a wavefront, that without its best-fit plane, and where they meet the image; lost ones weigh nothing.
INLINE ray_lanes rays_at(__global const scalar *opd, __global const scalar *x, __global const scalar *y,
                         __global const scalar *weight, __global const scalar *slopes, int group, int rays,
                         number slope_x, number slope_y)
{
#if TILED
    const size_t place = 16 * (size_t)group;
    ray_lanes a = {LOAD(opd + place), 0.0f, LOAD(x + place), LOAD(y + place), (real)weight[group], 0};
    const real plane = slope_x * slopes[group] + slope_y * slopes[rays + group];
#else
    // The last group overlaps the one before it; what came already has no weight.
    const int ray = group + W > rays ? rays - W : group;
    ray_lanes a = {LOAD(opd + ray), 0.0f, LOAD(x + ray), LOAD(y + ray), LOAD(weight + group), 0};
    const real plane = slope_x * LOAD(slopes + ray) + slope_y * LOAD(slopes + rays + ray);
#endif
    a.known = FINITE(a.opd) & FINITE(a.x) & FINITE(a.y);
    a.opd = WHERE(a.known, a.opd);
    a.x = WHERE(a.known, a.x);
    a.y = WHERE(a.known, a.y);
    a.weight = WHERE(a.known, a.weight);
    a.flat = a.opd - WHERE(a.known, plane);
    return a;
}

// Moments (instants, 8) of wavefronts and spots: number of rays that arrive, rms of the wavefront without
// piston, rms and peak to valley without plane, Strehl ratio, centroid x and y, rms distance from it.
// slopes (2, rays): the functions that make the plane; planes (instants, 2): how much of each. If TILED, arrays
// of instants are (tiles, ..., 16) instead.
__kernel void moments(const int instants, const int rays, __global const scalar *opd,
                      __global const scalar *x, __global const scalar *y, __global const scalar *weight,
                      __global const scalar *slopes, __global const scalar *planes, __global scalar *found)
{
    const size_t instant = get_global_id(1);
    if (instant >= instants)
        return;
#if TILED
    const size_t first = instant * rays * 16 + get_global_id(0) * W;
    planes += instant * 32 + get_global_id(0) * W;
    found += instant * 128 + get_global_id(0) * W;
    const real slope_x = LOAD(planes), slope_y = LOAD(planes + 16);
    const int step = 1;
#else
    const size_t first = instant * rays;
    planes += 2 * instant;
    found += 8 * instant;
    const scalar slope_x = planes[0], slope_y = planes[1];
    const int step = W;
#endif
    opd += first;
    x += first;
    y += first;
    const scalar turn = 6.28318530717958647693;
    real light = 0.0f, arrived = 0.0f, mean = 0.0f, mean_flat = 0.0f, re = 0.0f, im = 0.0f;
    real at_x = 0.0f, at_y = 0.0f, largest = -INFINITY, smallest = INFINITY;
    for (int group = 0; group < rays; group += step) {
        const ray_lanes a = rays_at(opd, x, y, weight, slopes, group, rays, slope_x, slope_y);
        const wave phase = wave_of(a.flat * turn);
        light += a.weight;
        arrived += LIT(a.weight > 0) ? (real)1.0f : (real)0.0f;
        mean += a.weight * a.opd;
        mean_flat += a.weight * a.flat;
        re += a.weight * phase.re;
        im += a.weight * phase.im;
        at_x += a.weight * a.x;
        at_y += a.weight * a.y;
        largest = a.known & LIT(a.flat > largest) ? a.flat : largest;
        smallest = a.known & LIT(a.flat < smallest) ? a.flat : smallest;
    }
    const number per_light = 1 / TOTAL(light);  // infinite, and all that follows no number, if all are lost
    const number middle = TOTAL(mean) * per_light, middle_flat = TOTAL(mean_flat) * per_light;
    const number center_x = TOTAL(at_x) * per_light, center_y = TOTAL(at_y) * per_light;
    real square = 0.0f, square_flat = 0.0f, spread = 0.0f;
    for (int group = 0; group < rays; group += step) {
        const ray_lanes a = rays_at(opd, x, y, weight, slopes, group, rays, slope_x, slope_y);
        const real raw = a.opd - middle, flat = a.flat - middle_flat, dx = a.x - center_x, dy = a.y - center_y;
        square += a.weight * raw * raw;
        square_flat += a.weight * flat * flat;
        spread += a.weight * (dx * dx + dy * dy);
    }
#if TILED
    const real most = largest, least = smallest;
#else
    scalar most = -INFINITY, least = INFINITY;
    for (int lane = 0; lane < W; ++lane) {
        most = LANE(largest, lane) > most ? LANE(largest, lane) : most;
        least = LANE(smallest, lane) < least ? LANE(smallest, lane) : least;
    }
#endif
    const number real_part = TOTAL(re) * per_light, imaginary = TOTAL(im) * per_light;
    FOUND(0, TOTAL(arrived));
    FOUND(1, root_of(TOTAL(square) * per_light));
    FOUND(2, root_of(TOTAL(square_flat) * per_light));
    FOUND(3, most < least ? (number)NAN : most - least);
    FOUND(4, real_part * real_part + imaginary * imaginary);
    FOUND(5, center_x);
    FOUND(6, center_y);
    FOUND(7, root_of(TOTAL(spread) * per_light));
}
