// Images of a tile of 16 instants of segments with pistons and slopes, whose moments' transforms a basis holds.
//
// Compile-time constants: W lanes, SINGLE (else double), SEGMENTS, TWINS (sets of segments that share a
// transform), FOLDED (4 where they have mirror images, else 1), MOMENTS of each segment up to DEGREE, HALF of the
// nodes along either axis, PIXELS along either axis. A GPU (W is 1): SPLITS of the products' sums, which a fixed
// order adds up. A processor: TALL nodes, or pixels, of a work-item; its lanes run over instants.

#include "waves.h"

#define INSTANTS 16
#define COLUMNS 32 // real parts of all instants, then imaginary ones
#define NODES (2 * HALF)
#define QUARTER (HALF * HALF) // of the nodes
#define TERMS (MOMENTS * TWINS)

#if W > 1

#define VECTORS (COLUMNS / W)
#define REAL_PARTS (INSTANTS / W) // vectors
// Else every other spilled vector crosses a cache line.
#define ALIGN_STACK volatile char aligned __attribute__((aligned(64))) = 0
#define CHUNK 256 // terms that are added up by themselves: sums of thousands lose digits

// phase (3, segment, instant): 2 pi times pistons, less whole waves, and slopes; shares are relative to the peak.
__kernel void fold_segments(__global const scalar *phase, __global const int *twins,
                            __global const scalar *shares, __global scalar *folded)
{
    ALIGN_STACK;
    const int lanes = get_global_id(0) * W, set = get_global_id(1);
    real cosine[FOLDED], sine[FOLDED], x[FOLDED][DEGREE + 1], y[FOLDED][DEGREE + 1]; // powers / factorials
    #pragma unroll
    for (int image = 0; image < FOLDED; ++image) {
        __global const scalar *own = phase + (size_t)twins[image * TWINS + set] * INSTANTS + lanes;
        const scalar share = shares[image * TWINS + set];
        const wave turned = wave_of(LOAD(own));
        cosine[image] = turned.re * share;
        sine[image] = turned.im * share;
        x[image][0] = y[image][0] = (real)(1.0f);
        #pragma unroll
        for (int n = 1; n <= DEGREE; ++n) {
            x[image][n] = x[image][n - 1] * LOAD(own + SEGMENTS * INSTANTS) * (scalar)(1.0 / n);
            y[image][n] = y[image][n - 1] * LOAD(own + 2 * SEGMENTS * INSTANTS) * (scalar)(1.0 / n);
        }
    }
    __global scalar *to = folded + (size_t)set * COLUMNS + lanes;
    #pragma unroll
    for (int n = 0; n <= DEGREE; ++n) {
        #pragma unroll
        for (int b = 0; b <= n; ++b, to += TWINS * COLUMNS) {
            const int a = n - b;
            real re[4], im[4];
            #pragma unroll
            for (int image = 0; image < FOLDED; ++image) { // times i^n
                const real along = n % 4 >= 2 ? -x[image][a] * y[image][b] : x[image][a] * y[image][b];
                re[image] = n % 2 ? -along * sine[image] : along * cosine[image];
                im[image] = n % 2 ? along * cosine[image] : along * sine[image];
            }
#if FOLDED == 1
            STORE(re[0], to);
            STORE(im[0], to + INSTANTS);
#else
            #pragma unroll
            for (int part = 0; part < 4; ++part) {
                const int odd_x = (a + (part == 1 || part == 2)) % 2, odd_y = (b + (part == 1 || part == 3)) % 2;
                __global scalar *own = to + (size_t)part * TERMS * COLUMNS;
                const real here = odd_x ? re[0] - re[1] : re[0] + re[1], there = odd_x ? re[2] - re[3] : re[2] + re[3];
                STORE(odd_y ? here - there : here + there, own);
                const real hence = odd_x ? im[0] - im[1] : im[0] + im[1], thence = odd_x ? im[2] - im[3] : im[2] + im[3];
                STORE(odd_y ? hence - thence : hence + thence, own + INSTANTS);
            }
#endif
        }
    }
}

// Sums over terms: (part, node, column). matrix (part, block of TALL nodes, term, node).
__kernel void add_segments(__global const scalar *matrix, __global const scalar *folded, __global scalar *sums)
{
    ALIGN_STACK;
    const int block = get_global_id(0), part = get_global_id(1);
    matrix += ((size_t)part * ((QUARTER + TALL - 1) / TALL) + block) * TERMS * TALL;
    folded += FOLDED == 4 ? (size_t)part * TERMS * COLUMNS : 0;
    real total[TALL][VECTORS];
    #pragma unroll
    for (int i = 0; i < TALL; ++i)
        #pragma unroll
        for (int v = 0; v < VECTORS; ++v)
            total[i][v] = (real)(0.0f);
    for (int first = 0; first < TERMS; first += CHUNK) {
        const int last = first + CHUNK < TERMS ? first + CHUNK : TERMS;
        real sum[TALL][VECTORS];
        #pragma unroll
        for (int i = 0; i < TALL; ++i)
            #pragma unroll
            for (int v = 0; v < VECTORS; ++v)
                sum[i][v] = (real)(0.0f);
        for (int term = first; term < last; ++term) {
            real factor[VECTORS];
            #pragma unroll
            for (int v = 0; v < VECTORS; ++v)
                factor[v] = LOAD(folded + (size_t)term * COLUMNS + v * W);
            #pragma unroll
            for (int i = 0; i < TALL; ++i)
                #pragma unroll
                for (int v = 0; v < VECTORS; ++v)
                    sum[i][v] += matrix[(size_t)term * TALL + i] * factor[v];
        }
        #pragma unroll
        for (int i = 0; i < TALL; ++i)
            #pragma unroll
            for (int v = 0; v < VECTORS; ++v)
                total[i][v] += sum[i][v];
    }
    sums += ((size_t)part * QUARTER + block * TALL) * COLUMNS;
    #pragma unroll
    for (int i = 0; i < TALL; ++i)
        if (block * TALL + i < QUARTER)
            #pragma unroll
            for (int v = 0; v < VECTORS; ++v)
                STORE(total[i][v], sums + i * COLUMNS + v * W);
}

// The field at all nodes from its parts: (y, x, column). What is odd in one axis alone is imaginary.
__kernel void unfold_field(__global const scalar *sums, __global scalar *field)
{
    ALIGN_STACK;
    const int x = get_global_id(0), y = get_global_id(1);
    sums += (size_t)(y * HALF + x) * COLUMNS;
    for (int v = 0; v < REAL_PARTS; ++v) {
        real re[4], im[4];
        #pragma unroll
        for (int part = 0; part < 4; ++part) {
            re[part] = LOAD(sums + (size_t)part * QUARTER * COLUMNS + v * W);
            im[part] = LOAD(sums + (size_t)part * QUARTER * COLUMNS + v * W + INSTANTS);
        }
        #pragma unroll
        for (int image = 0; image < 4; ++image) {
            const scalar in_x = image & 1 ? -1 : 1, in_y = image >> 1 ? -1 : 1;
            const int row = image >> 1 ? HALF - 1 - y : HALF + y, column = image & 1 ? HALF - 1 - x : HALF + x;
            __global scalar *to = field + (size_t)(row * NODES + column) * COLUMNS + v * W;
            STORE(re[0] + in_x * in_y * re[1] - (in_x * im[2] + in_y * im[3]), to);
            STORE(im[0] + in_x * in_y * im[1] + (in_x * re[2] + in_y * re[3]), to + INSTANTS);
        }
    }
}

// From nodes to TALL pixels: field (node, column), `apart` numbers from each to the next.
INLINE void spread(__global const scalar *across, __global const scalar *field, size_t apart,
                   real sum[TALL][VECTORS])
{
    #pragma unroll
    for (int i = 0; i < TALL; ++i)
        #pragma unroll
        for (int v = 0; v < VECTORS; ++v)
            sum[i][v] = (real)(0.0f);
    for (int node = 0; node < NODES; ++node) {
        real from[VECTORS];
        #pragma unroll
        for (int v = 0; v < VECTORS; ++v)
            from[v] = LOAD(field + node * apart + v * W);
        #pragma unroll
        for (int i = 0; i < TALL; ++i)
            #pragma unroll
            for (int v = 0; v < VECTORS; ++v)
                sum[i][v] += across[node * TALL + i] * from[v];
    }
}

// From nodes to pixels along y: (pixel, node, column). across (block of TALL pixels, node, pixel).
__kernel void spread_rows(__global const scalar *across, __global const scalar *field, __global scalar *rows)
{
    ALIGN_STACK;
    const int node = get_global_id(0), block = get_global_id(1);
    real sum[TALL][VECTORS];
    spread(across + (size_t)block * NODES * TALL, field + node * COLUMNS, NODES * COLUMNS, sum);
    #pragma unroll
    for (int i = 0; i < TALL; ++i)
        if (block * TALL + i < PIXELS)
            #pragma unroll
            for (int v = 0; v < VECTORS; ++v)
                STORE(sum[i][v], rows + ((size_t)(block * TALL + i) * NODES + node) * COLUMNS + v * W);
}

// From nodes to pixels along x, and the irradiance: (y, x, instant).
__kernel void square_pixels(__global const scalar *across, __global const scalar *rows, __global scalar *images)
{
    ALIGN_STACK;
    const int block = get_global_id(0), row = get_global_id(1);
    real sum[TALL][VECTORS];
    spread(across + (size_t)block * NODES * TALL, rows + (size_t)row * NODES * COLUMNS, COLUMNS, sum);
    #pragma unroll
    for (int i = 0; i < TALL; ++i)
        if (block * TALL + i < PIXELS)
            #pragma unroll
            for (int v = 0; v < REAL_PARTS; ++v) {
                const real re = sum[i][v], im = sum[i][v + REAL_PARTS];
                STORE(re * re + im * im, images + ((size_t)row * PIXELS + block * TALL + i) * INSTANTS + v * W);
            }
}

#else

#define TALL 32 // nodes, and terms at a time, of a work-group
#define EACH 4  // nodes of a work-item

// What the moments of segments count, with those of their mirror images: (part, moment, set, column). Parts are
// even-even, odd-odd, odd in x and odd in y.
__kernel void fold_segments(
    const double peak, const double scale, __global const double *phase, __global const int *twins,
    __global const double *shares, __global const int *powers, __global scalar *folded)
{
    const int instant = get_global_id(0), set = get_global_id(1);
    if (set >= TWINS)
        return;
    double cosine[FOLDED], sine[FOLDED], x[FOLDED], y[FOLDED];
    #pragma unroll
    for (int image = 0; image < FOLDED; ++image) {
        __global const double *own = phase + ((size_t)instant * SEGMENTS + twins[image * TWINS + set]) * 3;
        const double turn = 6.283185307179586477 * (own[0] - rint(own[0])), share = shares[image * TWINS + set];
        cosine[image] = share * cos(turn) / peak;
        sine[image] = share * sin(turn) / peak;
        x[image] = 6.283185307179586477 * scale * own[1];
        y[image] = 6.283185307179586477 * scale * own[2];
    }
    for (int moment = 0; moment < MOMENTS; ++moment) {
        const int a = powers[2 * moment], b = powers[2 * moment + 1];
        double sums[4] = {0.0, 0.0, 0.0, 0.0}, turned[4] = {0.0, 0.0, 0.0, 0.0};
        #pragma unroll
        for (int image = 0; image < FOLDED; ++image) {
            double along = (a + b) % 4 >= 2 ? -1.0 : 1.0;
            for (int n = 1; n <= a; ++n)
                along = along * x[image] / n;
            for (int n = 1; n <= b; ++n)
                along = along * y[image] / n;
            const int odd = (a + b) % 2;
            const double re = along * (odd ? -sine[image] : cosine[image]);
            const double im = along * (odd ? cosine[image] : sine[image]);
            #pragma unroll
            for (int part = 0; part < FOLDED; ++part) {
                const int in_x = a + (part == 1 || part == 2), in_y = b + (part == 1 || part == 3);
                const double sign = (in_x * (image & 1) + in_y * (image >> 1)) % 2 ? -1.0 : 1.0;
                sums[part] += sign * re;
                turned[part] += sign * im;
            }
        }
        #pragma unroll
        for (int part = 0; part < FOLDED; ++part) {
            __global scalar *to = folded + ((size_t)(part * MOMENTS + moment) * TWINS + set) * COLUMNS + instant;
            to[0] = sums[part];
            to[INSTANTS] = turned[part];
        }
    }
}

// A part of the sums over terms: (split, part, node, column).
__kernel void add_segments(__global const scalar *matrix, __global const scalar *folded, __global scalar *sums)
{
    __local scalar rows[TALL][TALL + 1], columns[TALL][COLUMNS];
    const int column = get_local_id(0), row = get_local_id(1), part = get_group_id(2) % 4;
    const int split = get_group_id(2) / 4, node = get_group_id(1) * TALL;
    const int tiles = (TERMS + TALL - 1) / TALL, share = (tiles + SPLITS - 1) / SPLITS;
    const int last = min(tiles, (split + 1) * share);
    matrix += (size_t)part * QUARTER * TERMS;
    folded += FOLDED == 4 ? (size_t)part * TERMS * COLUMNS : 0;
    scalar sum[EACH];
    #pragma unroll
    for (int k = 0; k < EACH; ++k)
        sum[k] = 0;
    for (int tile = split * share; tile < last; ++tile) {
        const int first = tile * TALL;
        #pragma unroll
        for (int k = 0; k < EACH; ++k) {
            const int at = row + k * (TALL / EACH);
            const int inside = node + at < QUARTER && first + column < TERMS;
            rows[at][column] = inside ? matrix[(size_t)(node + at) * TERMS + first + column] : 0;
            columns[at][column] = first + at < TERMS ? folded[(size_t)(first + at) * COLUMNS + column] : 0;
        }
        barrier(CLK_LOCAL_MEM_FENCE);
        #pragma unroll 8
        for (int term = 0; term < TALL; ++term) {
            const scalar factor = columns[term][column];
            #pragma unroll
            for (int k = 0; k < EACH; ++k)
                sum[k] += rows[row + k * (TALL / EACH)][term] * factor;
        }
        barrier(CLK_LOCAL_MEM_FENCE);
    }
    #pragma unroll
    for (int k = 0; k < EACH; ++k) {
        const int at = node + row + k * (TALL / EACH);
        if (at < QUARTER)
            sums[((size_t)(split * 4 + part) * QUARTER + at) * COLUMNS + column] = sum[k];
    }
}

// The field at all nodes from its parts: (y, x, column). What is odd in one axis alone is imaginary.
__kernel void unfold_field(__global const scalar *sums, __global scalar *field)
{
    const int instant = get_global_id(0), node = get_global_id(1);
    if (node >= QUARTER)
        return;
    scalar re[4], im[4];
    #pragma unroll
    for (int part = 0; part < 4; ++part) {
        re[part] = im[part] = 0;
        for (int split = 0; split < SPLITS; ++split) {
            __global const scalar *from = sums + ((size_t)(split * 4 + part) * QUARTER + node) * COLUMNS + instant;
            re[part] += from[0];
            im[part] += from[INSTANTS];
        }
    }
    const int y = node / HALF, x = node % HALF;
    #pragma unroll
    for (int image = 0; image < 4; ++image) {
        const scalar in_x = image & 1 ? -1 : 1, in_y = image >> 1 ? -1 : 1;
        const int row = image >> 1 ? HALF - 1 - y : HALF + y, column = image & 1 ? HALF - 1 - x : HALF + x;
        __global scalar *to = field + (size_t)(row * NODES + column) * COLUMNS + instant;
        to[0] = re[0] + in_x * in_y * re[1] - (in_x * im[2] + in_y * im[3]);
        to[INSTANTS] = im[0] + in_x * in_y * im[1] + (in_x * re[2] + in_y * re[3]);
    }
}

// From nodes to pixels along y: (pixel, node, column).
__kernel void spread_rows(__global const scalar *across, __global const scalar *field, __global scalar *rows)
{
    const int column = get_global_id(0), node = get_global_id(1), pixel = get_global_id(2);
    if (node >= NODES)
        return;
    scalar sum = 0;
    for (int from = 0; from < NODES; ++from)
        sum += across[pixel * NODES + from] * field[(size_t)(from * NODES + node) * COLUMNS + column];
    rows[(size_t)(pixel * NODES + node) * COLUMNS + column] = sum;
}

// From nodes to pixels along x, and the irradiance: (instant, y, x).
__kernel void square_pixels(__global const scalar *across, __global const scalar *rows, __global scalar *images)
{
    const int instant = get_global_id(0), pixel = get_global_id(1), row = get_global_id(2);
    if (pixel >= PIXELS)
        return;
    scalar re = 0, im = 0;
    for (int from = 0; from < NODES; ++from) {
        const scalar weight = across[pixel * NODES + from];
        __global const scalar *at = rows + (size_t)(row * NODES + from) * COLUMNS + instant;
        re += weight * at[0];
        im += weight * at[INSTANTS];
    }
    images[(size_t)(instant * PIXELS + row) * PIXELS + pixel] = re * re + im * im;
}

#endif
