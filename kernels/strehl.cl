// Irradiance at the origin of images: the squared mean wave of a pupil's patches.
//
// Work-item: an instant, whose lanes are patches. Compile-time constants: W lanes, SINGLE, PATCHES.

#include "waves.h"

__kernel void strehl(const int instants, __global const scalar *phase, __global const scalar *weight,
                     __global scalar *ratio)
{
    const size_t instant = get_global_id(1);
    if (instant >= instants)
        return;
    phase += instant * PATCHES;
    real re = 0.0f, im = 0.0f;
    for (int group = 0; group < PATCHES; group += W) {
        // The last group overlaps the one before it; what came already has no weight.
        const wave here = wave_of(LOAD(phase + (group + W > PATCHES ? PATCHES - W : group)));
        re += LOAD(weight + group) * here.re;
        im += LOAD(weight + group) * here.im;
    }
    scalar total_re = 0, total_im = 0;
    for (int lane = 0; lane < W; ++lane) {
        total_re += LANE(re, lane);
        total_im += LANE(im, lane);
    }
    ratio[instant] = total_re * total_re + total_im * total_im;
}
