// Images of equal segments on a lattice, each with a phase: sums over the lattice times a segment's irradiance.
//
// Lattice and image are symmetric about 0 in both directions: split into parts even and odd in x and in y, the
// waves of the segments meet real cosines and sines only, and the four signs of a pair of frequencies share all
// the work. The parts are (even x, even y), (even x, odd y), (odd x, even y), (odd x, odd y), each real and
// imaginary.
//
// Work-item: an image. Compile-time constants: W lanes, SINGLE, SEGMENTS (at least W), ROWS and COLUMNS of a
// quarter of the lattice, PIXELS of the image and QUARTER = (PIXELS + 1) / 2, WAVES = QUARTER padded to whole
// groups of WIDE vectors.

#include "waves.h"

// Store W pixels of a row right of its middle, or left of it, times a segment's irradiance there.
INLINE void put(real value, __global const scalar *envelope, __global scalar *images, size_t row, int u, int plus)
{
#if W > 1
    if (u + W > QUARTER) {
        for (int i = 0; u + i < QUARTER; ++i) {
            const size_t place = row + (plus ? PIXELS / 2 + u + i : (PIXELS - 1) / 2 - u - i);
            images[place] = LANE(value, i) * envelope[place];
        }
        return;
    }
#endif
    const size_t place = row + (plus ? PIXELS / 2 + u : (PIXELS - 1) / 2 - u - (W - 1));
    STORE((plus ? value : REVERSED(value)) * LOAD(envelope + place), images + place);
}

// phase (count, SEGMENTS); place of each segment in the quarter; share (SEGMENTS, 4): what it adds to each part;
// along_x, along_y (2, COLUMNS or ROWS, WAVES): cosines, then sines.
__kernel void lattice(const int count, __global const scalar *phase, __global const int *place,
                      __global const scalar *share, __global const scalar *along_x,
                      __global const scalar *along_y, __global const scalar *envelope,
                      __global scalar *images)
{
    const int image = get_global_id(1);
    if (image >= count)
        return;
    __local scalar folded[8 * ROWS * COLUMNS];
    __local scalar lines[8 * COLUMNS * WAVES];
    phase += (size_t)image * SEGMENTS;
    images += (size_t)image * PIXELS * PIXELS;
    for (int i = 0; i < 8 * ROWS * COLUMNS; ++i)
        folded[i] = 0;
    for (int group = 0; group < SEGMENTS; group += W) {
        // The last group overlaps the one before it.
        const int start = group + W > SEGMENTS ? SEGMENTS - W : group;
        const wave here = wave_of(LOAD(phase + start));
        for (int lane = group - start; lane < W; ++lane) {
            __local scalar *cell = folded + 8 * place[start + lane];
            for (int part = 0; part < 4; ++part) {
                const scalar weight = share[4 * (start + lane) + part];
                cell[2 * part] += weight * LANE(here.re, lane);
                cell[2 * part + 1] += weight * LANE(here.im, lane);
            }
        }
    }
    // Along y: cosines meet the parts even in y (0, 1 and 4, 5), sines the odd ones (2, 3 and 6, 7).
    for (int column = 0; column < COLUMNS; ++column)
        for (int v = 0; v < WAVES; v += W) {
            real sums[8];
            #pragma unroll
            for (int i = 0; i < 8; ++i)
                sums[i] = 0.0f;
            for (int row = 0; row < ROWS; ++row) {
                __local const scalar *cell = folded + 8 * (row * COLUMNS + column);
                const real waves[2] = {LOAD(along_y + row * WAVES + v),
                                       LOAD(along_y + (ROWS + row) * WAVES + v)};
                #pragma unroll
                for (int i = 0; i < 8; ++i)
                    sums[i] += cell[i] * waves[i >> 1 & 1];
            }
            #pragma unroll
            for (int i = 0; i < 8; ++i)
                STORE_LOCAL(sums[i], lines + (8 * column + i) * WAVES + v);
        }
    // Along x, and the irradiance of the four quadrants.
    for (int v = 0; v < QUARTER; ++v) {
        const size_t above = (size_t)(PIXELS / 2 + v) * PIXELS, below = (size_t)((PIXELS - 1) / 2 - v) * PIXELS;
        for (int first = 0; first < QUARTER; first += WIDE * W) {
            real sums[8][WIDE];
            #pragma unroll
            for (int i = 0; i < 8; ++i)
                #pragma unroll
                for (int wide = 0; wide < WIDE; ++wide)
                    sums[i][wide] = 0.0f;
            for (int column = 0; column < COLUMNS; ++column) {
                __local const scalar *line = lines + 8 * column * WAVES + v;
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
                            sums[i][wide] += line[i * WAVES] * waves[wide];
                }
            }
            #pragma unroll
            for (int wide = 0; wide < WIDE; ++wide) {
                const int u = first + wide * W;
                real a = sums[0][wide] - sums[6][wide], b = sums[1][wide] - sums[7][wide];
                real c = sums[2][wide] + sums[4][wide], d = sums[3][wide] + sums[5][wide];
                put((a + d) * (a + d) + (b - c) * (b - c), envelope, images, above, u, 1);
                put((a - d) * (a - d) + (b + c) * (b + c), envelope, images, below, u, 0);
                a = sums[0][wide] + sums[6][wide], b = sums[1][wide] + sums[7][wide];
                c = sums[2][wide] - sums[4][wide], d = sums[3][wide] - sums[5][wide];
                put((a - d) * (a - d) + (b + c) * (b + c), envelope, images, below, u, 1);
                put((a + d) * (a + d) + (b - c) * (b - c), envelope, images, above, u, 0);
            }
        }
    }
}
