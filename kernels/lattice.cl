// Images of equal segments on a lattice, each with a phase and slopes: sums over the lattice times what a
// segment is transformed to. With slopes the field is a sum over moments, see `wavequake.imaging.engines.segment_psf`.
//
// Lattice and image are symmetric about 0 in both directions: split into parts even and odd in x and in y,
// the waves of the segments meet real cosines and sines only, and the four signs of a pair of frequencies share
// all the work. The parts are (even x, even y), (even x, odd y), (odd x, even y), (odd x, odd y), each real and
// imaginary.
//
// Work-item: an image. Compile-time constants: W lanes, SINGLE, SEGMENTS (at least W), ROWS and COLUMNS of a
// quarter of the lattice, PIXELS of the image and QUARTER = (PIXELS + 1) / 2, WAVES = QUARTER padded to whole
// groups of WIDE vectors, DEGREE of the moments.

#include "waves.h"
#include "pixels.h"

#define MOMENTS ((DEGREE + 1) * (DEGREE + 2) / 2)
#define CELLS (ROWS * COLUMNS)

// Read W pixels of a row as `put` stores them; at the edges also what lies beyond.
INLINE real get(__global const scalar *row, int u, int plus)
{
    if (plus)
        return LOAD(row + PIXELS / 2 + u);
    const real beside = LOAD(row + (PIXELS - 1) / 2 - u - (W - 1));
    return REVERSED(beside);
}

// What the lattice makes of a moment at the four signs of W frequencies: (+x +y), (-x -y), (+x -y), (-x +y).
typedef struct { wave sign[4]; } quadrants;

INLINE quadrants combine(const real sums[8])
{
    const real a = sums[0] - sums[6], b = sums[1] - sums[7], c = sums[2] + sums[4], d = sums[3] + sums[5];
    const real e = sums[0] + sums[6], f = sums[1] + sums[7], g = sums[2] - sums[4], h = sums[3] - sums[5];
    return (quadrants){{{a + d, b - c}, {a - d, b + c}, {e - h, f + g}, {e + h, f - g}}};
}

// Add a segment's W waves, times their power i^turns, to the parts of the quarter that they lie in.
INLINE void scatter(wave here, int turns, int skip, __global const int *place, __global const scalar *share,
                    __local scalar *folded)
{
    const real re = turns == 0 ? here.re : turns == 1 ? -here.im : turns == 2 ? -here.re : here.im;
    const real im = turns == 0 ? here.im : turns == 1 ? here.re : turns == 2 ? -here.im : -here.re;
    for (int lane = skip; lane < W; ++lane) {
        __local scalar *cell = folded + 8 * place[lane];
        for (int part = 0; part < 4; ++part) {
            const scalar weight = share[4 * lane + part];
            cell[2 * part] += weight * LANE(re, lane);
            cell[2 * part + 1] += weight * LANE(im, lane);
        }
    }
}

// motion (count, 1 or 3, SEGMENTS): phase, slopes along x and y times the scale of the moments; place of each
// segment in the quarter; share (SEGMENTS, 4): what it adds to each part; along_x, along_y (2, COLUMNS or
// ROWS, WAVES): cosines, then sines; segment: irradiance of a segment (PIXELS, PIXELS), or its moments
// (MOMENTS, real and imaginary, PIXELS, PIXELS); W numbers come before and behind them.
__kernel void lattice(const int count, __global const scalar *motion, __global const int *place,
                      __global const scalar *share, __global const scalar *along_x,
                      __global const scalar *along_y, __global const scalar *segment,
                      __global scalar *images)
{
    const int image = get_global_id(1);
    if (image >= count)
        return;
    __local scalar folded[MOMENTS * 8 * CELLS];
    __local scalar lines[MOMENTS * 8 * COLUMNS * WAVES];
    __local scalar field[8 * WAVES];  // of a row of the image and the row below the middle
    motion += (size_t)image * (DEGREE ? 3 : 1) * SEGMENTS;
    images += (size_t)image * PIXELS * PIXELS;
    for (int i = 0; i < MOMENTS * 8 * CELLS; ++i)
        folded[i] = 0;
    for (int i = 0; i < 8 * WAVES; ++i)
        field[i] = 0;
    for (int group = 0; group < SEGMENTS; group += W) {
        // The last group overlaps the one before it.
        const int start = group + W > SEGMENTS ? SEGMENTS - W : group;
        const wave here = wave_of(LOAD(motion + start));
#if DEGREE
        // Powers of the slopes over their factorials.
        real along[2][DEGREE + 1];
        for (int axis = 0; axis < 2; ++axis) {
            const real slope = LOAD(motion + (1 + axis) * SEGMENTS + start);
            along[axis][0] = 1.0f;
            for (int n = 1; n <= DEGREE; ++n)
                along[axis][n] = along[axis][n - 1] * slope * ((scalar)1 / n);
        }
        int moment = 0;
        #pragma unroll
        for (int n = 0; n <= DEGREE; ++n)
            #pragma unroll
            for (int b = 0; b <= n; ++b, ++moment) {
                const real factor = along[0][n - b] * along[1][b];
                const wave bent = {here.re * factor, here.im * factor};
                scatter(bent, n & 3, group - start, place + start, share + 4 * start,
                        folded + moment * 8 * CELLS);
            }
#else
        scatter(here, 0, group - start, place + start, share + 4 * start, folded);
#endif
    }
    // Along y: cosines meet the parts even in y (0, 1 and 4, 5), sines the odd ones (2, 3 and 6, 7).
    for (int moment = 0; moment < MOMENTS; ++moment)
        for (int column = 0; column < COLUMNS; ++column)
            for (int v = 0; v < WAVES; v += W) {
                real sums[8];
                #pragma unroll
                for (int i = 0; i < 8; ++i)
                    sums[i] = 0.0f;
                for (int row = 0; row < ROWS; ++row) {
                    __local const scalar *cell = folded + 8 * (moment * CELLS + row * COLUMNS + column);
                    const real waves[2] = {LOAD(along_y + row * WAVES + v),
                                           LOAD(along_y + (ROWS + row) * WAVES + v)};
                    #pragma unroll
                    for (int i = 0; i < 8; ++i)
                        sums[i] += cell[i] * waves[i >> 1 & 1];
                }
                #pragma unroll
                for (int i = 0; i < 8; ++i)
                    STORE_LOCAL(sums[i], lines + (8 * (moment * COLUMNS + column) + i) * WAVES + v);
            }
    // Along x, and the irradiance of the four quadrants. A moment's lines stay in the nearest cache meanwhile.
    for (int v = 0; v < QUARTER; ++v) {
        const size_t above = (size_t)(PIXELS / 2 + v) * PIXELS;
        const size_t below = (size_t)((PIXELS - 1) / 2 - v) * PIXELS;
        for (int moment = 0; moment < MOMENTS; ++moment)
            for (int first = 0; first < QUARTER; first += WIDE * W) {
                real sums[WIDE][8];
                #pragma unroll
                for (int wide = 0; wide < WIDE; ++wide)
                    #pragma unroll
                    for (int i = 0; i < 8; ++i)
                        sums[wide][i] = 0.0f;
                for (int column = 0; column < COLUMNS; ++column) {
                    __local const scalar *line = lines + 8 * (moment * COLUMNS + column) * WAVES + v;
                    #pragma unroll
                    for (int odd = 0; odd < 2; ++odd) {
                        __global const scalar *table = along_x + (odd * COLUMNS + column) * WAVES + first;
                        real waves[WIDE];
                        #pragma unroll
                        for (int wide = 0; wide < WIDE; ++wide)
                            waves[wide] = LOAD(table + wide * W);
                        #pragma unroll
                        for (int i = 4 * odd; i < 4 * odd + 4; ++i)
                            #pragma unroll
                            for (int wide = 0; wide < WIDE; ++wide)
                                sums[wide][i] += line[i * WAVES] * waves[wide];
                    }
                }
                #pragma unroll
                for (int wide = 0; wide < WIDE; ++wide) {
                    const int u = first + wide * W;
                    const quadrants part = combine(sums[wide]);
                    #pragma unroll
                    for (int sign = 0; sign < 4; ++sign) {
                        const wave a = part.sign[sign];
                        const size_t row = sign == 0 || sign == 3 ? above : below;
                        const int plus = sign == 0 || sign == 2;
#if DEGREE
                        __global const scalar *re = segment + W + (size_t)2 * moment * PIXELS * PIXELS + row;
                        const wave b = {get(re, u, plus), get(re + PIXELS * PIXELS, u, plus)};
                        __local scalar *total = field + 2 * sign * WAVES + u;
                        const wave before = {LOAD_LOCAL(total), LOAD_LOCAL(total + WAVES)};
                        const wave added = {before.re + a.re * b.re - a.im * b.im,
                                            before.im + a.re * b.im + a.im * b.re};
                        STORE_LOCAL(added.re, total);
                        STORE_LOCAL(added.im, total + WAVES);
#else
                        const real light = a.re * a.re + a.im * a.im;
                        put(light * get(segment + W + row, u, plus), images + row, u, plus);
#endif
                    }
                }
            }
#if DEGREE
        for (int u = 0; u < WAVES; u += W)
            #pragma unroll
            for (int sign = 0; sign < 4; ++sign) {
                __local scalar *total = field + 2 * sign * WAVES + u;
                const wave a = {LOAD_LOCAL(total), LOAD_LOCAL(total + WAVES)};
                const real none = 0.0f;
                STORE_LOCAL(none, total);
                STORE_LOCAL(none, total + WAVES);
                if (u < QUARTER)
                    put(a.re * a.re + a.im * a.im, images + (sign == 0 || sign == 3 ? above : below), u,
                        sign == 0 || sign == 2);
            }
#endif
    }
}
