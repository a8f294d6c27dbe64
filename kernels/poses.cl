// Transforms to surfaces that move, from small motions and poses at rest so that nothing cancels.
//
// Work-item: W instants. Compile-time constants: W lanes, SINGLE (0).

#include "waves.h"

// The rotation Rx(alpha) Ry(beta) Rz(gamma) by rows, from a quaternion of half angles: nothing cancels.
INLINE void rotation_of(const real *angles, real *rotation)
{
    const wave a = wave_of(angles[0] * (scalar)0.5), b = wave_of(angles[1] * (scalar)0.5);
    const wave c = wave_of(angles[2] * (scalar)0.5);
    const real both_cos = a.re * b.re, both_sin = a.im * b.im, only_a = a.im * b.re, only_b = a.re * b.im;
    const real w = both_cos * c.re - both_sin * c.im, x = only_a * c.re + only_b * c.im;
    const real y = only_b * c.re - only_a * c.im, z = both_cos * c.im + both_sin * c.re;
    const real x2 = x + x, y2 = y + y, z2 = z + z;
    const real diagonal[3] = {y2 * y + z2 * z, x2 * x + z2 * z, x2 * x + y2 * y};
    #pragma unroll
    for (int i = 0; i < 3; ++i)
        rotation[4 * i] = 1.0f - diagonal[i];
    rotation[1] = x2 * y - z2 * w;
    rotation[2] = x2 * z + y2 * w;
    rotation[3] = x2 * y + z2 * w;
    rotation[5] = y2 * z - x2 * w;
    rotation[6] = x2 * z - y2 * w;
    rotation[7] = y2 * z + x2 * w;
}

// With the relative pose (s, R) at rest, the own motions (d, Q) of a surface and (d', Q') of its predecessor a
// point p becomes Q^T (R^T Q' p + R^T (d' - s) - d). rest (surfaces, 12): R^T by rows, then s; motion
// (instants, surfaces, 6): d, then Cardan angles; found (instants, surfaces, 12): what p is multiplied by, by
// rows, then what is added.
__kernel void poses(const int instants, const int surfaces, __global const scalar *rest,
                    __global const scalar *motion, __global scalar *found)
{
    const int first = get_global_id(1) * W;
    if (first >= instants)
        return;
    real before[9], shift_before[3];
    #pragma unroll
    for (int i = 0; i < 9; ++i)
        before[i] = i % 4 ? 0.0f : 1.0f;
    #pragma unroll
    for (int i = 0; i < 3; ++i)
        shift_before[i] = 0.0f;
    for (int surface = 0; surface < surfaces; ++surface, rest += 12) {
        real moves[6], own[9], transform[12];
        #pragma unroll
        for (int lane = 0; lane < W; ++lane) {  // beyond the last instant comes the last one again
            const int instant = first + lane < instants ? first + lane : instants - 1;
            __global const scalar *place = motion + ((size_t)instant * surfaces + surface) * 6;
            #pragma unroll
            for (int i = 0; i < 6; ++i)
                LANE(moves[i], lane) = place[i];
        }
        rotation_of(moves + 3, own);
        real turned[9], place[3];
        #pragma unroll
        for (int i = 0; i < 3; ++i) {
            place[i] = -moves[i];
            #pragma unroll
            for (int j = 0; j < 3; ++j)
                place[i] += rest[3 * i + j] * (shift_before[j] - rest[9 + j]);
            #pragma unroll
            for (int k = 0; k < 3; ++k)
                turned[3 * i + k] =
                    rest[3 * i] * before[k] + rest[3 * i + 1] * before[3 + k] + rest[3 * i + 2] * before[6 + k];
        }
        #pragma unroll
        for (int i = 0; i < 3; ++i) {
            #pragma unroll
            for (int k = 0; k < 3; ++k)
                transform[3 * i + k] = own[i] * turned[k] + own[3 + i] * turned[3 + k] + own[6 + i] * turned[6 + k];
            transform[9 + i] = own[i] * place[0] + own[3 + i] * place[1] + own[6 + i] * place[2];
        }
        #pragma unroll
        for (int lane = 0; lane < W; ++lane)
            if (first + lane < instants) {
                __global scalar *out = found + ((size_t)(first + lane) * surfaces + surface) * 12;
                #pragma unroll
                for (int i = 0; i < 12; ++i)
                    out[i] = LANE(transform[i], lane);
            }
        #pragma unroll
        for (int i = 0; i < 9; ++i)
            before[i] = own[i];
        #pragma unroll
        for (int i = 0; i < 3; ++i)
            shift_before[i] = moves[i];
    }
}
