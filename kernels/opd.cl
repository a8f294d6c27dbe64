// Wavefronts of rays that stay on a device, arrays (instants, rays). GROUP work-items make a group.
//
// Every operation is rounded as by NumPy, so that bits do not depend on where the rays are.

#pragma OPENCL EXTENSION cl_khr_fp64 : enable
#pragma OPENCL FP_CONTRACT OFF

// By how many waves paths are shorter than the chief ray's (instants).
__kernel void opd(const int rays, __global const double *paths, __global const double *chief,
                  const double wavelength, __global double *waves)
{
    const size_t ray = get_global_id(0), instant = get_global_id(1), place = instant * rays + ray;
    if (ray < rays)
        waves[place] = (chief[instant] - paths[place]) / wavelength;
}

// Waves less two functions (2, rays), as much of each as in planes (instants, 2).
__kernel void without_planes(const int rays, __global const double *waves, __global const double *slopes,
                             __global const double *planes, __global double *rest)
{
    const size_t ray = get_global_id(0), instant = get_global_id(1), place = instant * rays + ray;
    if (ray < rays)
        rest[place] = waves[place] - planes[2 * instant] * slopes[ray]
                      - planes[2 * instant + 1] * slopes[rays + ray];
}

// How many rays of each instant, which a group shares, have the status that is wanted.
__kernel void count_status(const int rays, __global const char *status, const int wanted, __global int *counts)
{
    __local int parts[GROUP];
    const size_t item = get_local_id(0), instant = get_global_id(1);
    int count = 0;
    for (size_t ray = item; ray < rays; ray += GROUP)
        count += status[instant * rays + ray] == wanted;
    parts[item] = count;
    barrier(CLK_LOCAL_MEM_FENCE);
    if (item == 0) {
        for (int other = 1; other < GROUP; ++other)
            count += parts[other];
        counts[instant] = count;
    }
}
