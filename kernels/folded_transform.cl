// Fourier transforms of pupils to images by matrix products, four quadrants at a time.
//
// Grid and image are symmetric about 0 in both directions. Split into parts even and odd in x and in y, the
// pupil meets real cosines and sines only, and the four signs of a pair of frequencies share all the work.
// Along x the table of cosines (or sines) is a product of two thin ones: rows of the pupil become COLUMNS
// numbers, from which the pixels are put together once the columns are transformed, too.
//
// Compile-time constants: W lanes, SINGLE, N pupil cells and HALF = (N + 1) / 2 along an axis, PIXELS of the
// image and QUARTER = (PIXELS + 1) / 2, ROWS = QUARTER padded to whole groups of TALL rows that share what is
// read, ACROSS = QUARTER padded to whole vectors, COLUMNS in whole groups of WIDE vectors, PACK and LINE
// columns that lie together in the table along x and in the transformed rows, TERMS and FIELD (what the pupil
// comes as: TERMS > 0: TERMS x TERMS Chebyshev coefficients of the phase, rows are y, and phases of cells on
// the rim; else FIELD 1: complex numbers, 0: phases), SHARED (1: other work-items fold the pupil, into global
// memory; 0: each folds the row that it needs).
//
// The eight parts of a folded pupil are (even x, even y), (even x, odd y), (odd x, even y), (odd x, odd y),
// each real and imaginary.

#include "waves.h"
#include "pixels.h"

INLINE wave lit(real phase, real weight)
{
    wave result = wave_of(phase);
    // A phase that is not a number counts only where there is light.
    const whole bright = LIT(weight != 0);
    result.re = TO_REAL(TO_WHOLE(result.re * weight) & bright);
    result.im = TO_REAL(TO_WHOLE(result.im * weight) & bright);
    return result;
}

INLINE wave sum(wave a, wave b) { return (wave){a.re + b.re, a.im + b.im}; }
INLINE wave difference(wave a, wave b) { return (wave){a.re - b.re, a.im - b.im}; }
// The light of W cells right of the middle in an upper row, of those beside, below and across.
typedef struct { wave here, beside, below, across; } quadrants;

#if TERMS

// Chebyshev coefficients of the phase along x, even and odd in y, of a row: chebyshev is (TERMS, HALF).
INLINE void row_phase(__global const scalar *pupil, __global const scalar *chebyshev, int row,
                      scalar phase[2][TERMS])
{
    for (int k = 0; k < TERMS; ++k)
        phase[0][k] = phase[1][k] = 0;
    for (int l = 0; l < TERMS; ++l)
        for (int k = 0; k < TERMS; ++k)
            phase[l & 1][k] += pupil[l * TERMS + k] * chebyshev[l * HALF + row];
}

INLINE quadrants light(__global const scalar *amplitude, __global const scalar *chebyshev,
                       scalar phase[2][TERMS], int row, int column)
{
    real even = 0.0f, odd = 0.0f, even_down = 0.0f, odd_down = 0.0f;  // in x, and odd in y
    for (int k = 0; k < TERMS; k += 2) {
        const real t = LOAD(chebyshev + k * HALF + column);
        even += phase[0][k] * t;
        even_down += phase[1][k] * t;
    }
    for (int k = 1; k < TERMS; k += 2) {
        const real t = LOAD(chebyshev + k * HALF + column);
        odd += phase[0][k] * t;
        odd_down += phase[1][k] * t;
    }
    const int right = N / 2 + column, left = N - W - right, up = N / 2 + row, down = N - 1 - up;
    return (quadrants){lit((even + even_down) + (odd + odd_down), LOAD(amplitude + up * N + right)),
                       lit((even + even_down) - (odd + odd_down), REVERSED(LOAD(amplitude + up * N + left))),
                       lit((even - even_down) + (odd - odd_down), LOAD(amplitude + down * N + right)),
                       lit((even - even_down) - (odd - odd_down), REVERSED(LOAD(amplitude + down * N + left)))};
}

#else

// starts: (N rows, left and right half), to which a column is added.
INLINE wave cell_light(__global const scalar *pupil, __global const int *starts,
                       __global const scalar *amplitude, __global const scalar *ramp, int row, int column,
                       int is_right)
{
    __global const scalar *place = pupil + (starts[2 * row + is_right] + column);
#if FIELD
    return (wave){LOAD(place), LOAD(place + N * N)};
#else
    return lit(LOAD(place) + (LOAD(ramp + column) + ramp[row]), LOAD(amplitude + row * N + column));
#endif
}

INLINE wave reversed(wave a) { return (wave){REVERSED(a.re), REVERSED(a.im)}; }

INLINE quadrants light(__global const scalar *pupil, __global const int *starts,
                       __global const scalar *amplitude, __global const scalar *ramp, int row, int column)
{
    const int right = N / 2 + column, left = N - W - right, up = N / 2 + row, down = N - 1 - up;
    return (quadrants){cell_light(pupil, starts, amplitude, ramp, up, right, 1),
                       reversed(cell_light(pupil, starts, amplitude, ramp, up, left, 0)),
                       cell_light(pupil, starts, amplitude, ramp, down, right, 1),
                       reversed(cell_light(pupil, starts, amplitude, ramp, down, left, 0))};
}

#endif

// Fold W cells with their mirror images: the parts lie HALF apart.
#define FOLD(light, parts) \
    do { \
        const quadrants four = light; \
        const wave even_up = sum(four.here, four.beside), odd_up = difference(four.here, four.beside); \
        const wave even_down = sum(four.below, four.across), odd_down = difference(four.below, four.across); \
        const wave part[4] = {sum(even_up, even_down), difference(even_up, even_down), \
                              sum(odd_up, odd_down), difference(odd_up, odd_down)}; \
        _Pragma("unroll") for (int i = 0; i < 4; ++i) \
        { \
            STORE_AT(part[i].re, (parts) + (2 * i) * HALF); \
            STORE_AT(part[i].im, (parts) + (2 * i + 1) * HALF); \
        } \
    } while (0)

#if SHARED
#define STORE_AT(value, address) STORE(value, address)
#define PARTS_MEMORY __global
#else
#define STORE_AT(value, address) STORE_LOCAL(value, address)
#define PARTS_MEMORY __local
#endif

#if TERMS
#define PREPARE(row) \
    scalar phase[2][TERMS]; \
    row_phase(pupil, chebyshev, row, phase)
#define LIGHT(row, column) light(amplitude, chebyshev, phase, row, column)

// Add the light of cells on the rim to a folded row. rim: HALF + 1 places where rows begin, then columns;
// rim_light (cells, 4): what a cell adds to the real parts if its phase is 0.
INLINE void add_rim(__global const scalar *rim_phase, __global const int *rim, __global const scalar *rim_light,
                    int row, PARTS_MEMORY scalar *parts)
{
    const int end = rim[row + 1];
    for (int start = rim[row]; start < end; start += W) {
        const wave here = wave_of(LOAD(rim_phase + start));  // W numbers follow the last
        for (int i = 0; i < W; ++i)
            if (start + i < end)
                for (int part = 0; part < 4; ++part) {
                    PARTS_MEMORY scalar *place = parts + 2 * part * HALF + rim[HALF + 1 + start + i];
                    const scalar weight = rim_light[4 * (start + i) + part];
                    place[0] += weight * LANE(here.re, i);
                    place[HALF] += weight * LANE(here.im, i);
                }
    }
}
#else
#define PREPARE(row)
#define LIGHT(row, column) light(pupil, starts, amplitude, ramp, row, column)
#endif

#if SHARED
__kernel void fold(const int size, __global const scalar *pupil, __global const scalar *amplitude,
#if TERMS
                   __global const scalar *chebyshev, __global const scalar *rim_phase,
                   __global const int *rim, __global const scalar *rim_light,
#else
                   __global const scalar *ramp, __global const int *starts,
#endif
                   __global scalar *folded)
{
    const int column = get_global_id(0), row = get_global_id(1);
    const size_t image = get_global_id(2);
    if (column >= HALF)
        return;
    pupil += image * size;  // numbers of a pupil
    PREPARE(row);
    FOLD(LIGHT(row, column), folded + (image * HALF + row) * (8 * HALF) + column);
}

#if TERMS
__kernel void fold_rim(const int cells, __global const scalar *rim_phase, __global const int *rim,
                       __global const scalar *rim_light, __global scalar *folded)
{
    const int row = get_global_id(1);
    const size_t image = get_global_id(2);
    if (row < HALF && get_global_id(0) == 0)
        add_rim(rim_phase + image * cells, rim, rim_light, row, folded + (image * HALF + row) * (8 * HALF));
}
#endif
#endif

// Transform a folded row along x.
__kernel void transform_rows(const int size, __global const scalar *pupil, __global const scalar *amplitude,
#if TERMS
                             __global const scalar *chebyshev, __global const scalar *rim_phase,
                             __global const int *rim, __global const scalar *rim_light, const int cells,
#else
                             __global const scalar *ramp, __global const int *starts,
#endif
                             __global const int *range, __global const scalar *along_x,
#if SHARED
                             __global const scalar *folded,
#endif
                             __global scalar *rows)
{
    const size_t image = get_global_id(2);
    const int row = get_global_id(1), low = range[2 * row], high = range[2 * row + 1];
    rows += image * HALF * 8 * COLUMNS;
#if SHARED
    folded += (image * HALF + row) * (8 * HALF);
    const int first = get_global_id(0), last = first + 1;
    if (first >= COLUMNS / (WIDE * W))
        return;
#else
    __local scalar folded[8 * HALF];
    pupil += image * size;  // numbers of a pupil
    PREPARE(row);
    for (int column = low; column < high; column += W) {
        // The last group overlaps the one before it, so that all lanes are columns.
        const int start = column + W > HALF ? HALF - W : column;
        FOLD(LIGHT(row, start), folded + start);
    }
#if TERMS
    add_rim(rim_phase + image * cells, rim, rim_light, row, folded);
#endif
    const int first = 0, last = COLUMNS / (WIDE * W);
#endif
    for (int block = first; block < last; ++block)
        for (int parity = 0; parity < 2; ++parity) {
            const int u = block * WIDE * W;
            __global const scalar *table =
                along_x + ((size_t)parity * COLUMNS + u / PACK * PACK) * HALF + u % PACK;
            PARTS_MEMORY const scalar *part = folded + 4 * parity * HALF;
            real sums[4][WIDE];
            #pragma unroll
            for (int i = 0; i < 4; ++i)
                #pragma unroll
                for (int wide = 0; wide < WIDE; ++wide)
                    sums[i][wide] = 0.0f;
            for (int k = low; k < high; ++k) {
                real values[WIDE];
                #pragma unroll
                for (int wide = 0; wide < WIDE; ++wide)
                    values[wide] = LOAD(table + k * PACK + wide * W);
                #pragma unroll
                for (int i = 0; i < 4; ++i)
                    #pragma unroll
                    for (int wide = 0; wide < WIDE; ++wide)
                        sums[i][wide] += part[i * HALF + k] * values[wide];
            }
            #pragma unroll
            for (int wide = 0; wide < WIDE; ++wide) {
                const int at = u + wide * W;
                __global scalar *out = rows + (size_t)(at / LINE * LINE) * 8 * HALF + at % LINE
                                       + (size_t)(row * 8 + 4 * parity) * LINE;
                #pragma unroll
                for (int i = 0; i < 4; ++i)
                    STORE(sums[i][wide], out + i * LINE);
            }
        }
}

// Transform along y: lines (ROWS, 8 parts, COLUMNS).
__kernel void transform_columns(__global const scalar *along_y, __global const scalar *rows,
                                __global scalar *lines)
{
    const size_t image = get_global_id(2);
#if SHARED
    const int u = get_global_id(0), v = get_global_id(1) * TALL;
#else
    const int u = get_global_id(1) * W, v = get_global_id(0) * TALL;
#endif
    if (u >= COLUMNS || v >= ROWS)
        return;
    rows += image * HALF * 8 * COLUMNS + (size_t)(u / LINE * LINE) * 8 * HALF + u % LINE;
    lines += (image * ROWS + v) * (8 * COLUMNS) + u;
    // Cosines meet the parts even in y (0, 1 and 4, 5), sines the odd ones (2, 3 and 6, 7).
    #pragma unroll
    for (int parity = 0; parity < 2; ++parity) {
        __global const scalar *table = along_y + ((size_t)parity * ROWS + v) * HALF;
        real sums[TALL][4];
        #pragma unroll
        for (int i = 0; i < TALL; ++i)
            #pragma unroll
            for (int part = 0; part < 4; ++part)
                sums[i][part] = 0.0f;
        __global const scalar *line = rows + 2 * parity * LINE;
        for (int k = 0; k < HALF; ++k) {
            #pragma unroll
            for (int part = 0; part < 4; ++part) {
                const real value = LOAD(line + ((part & 1) + 4 * (part >> 1)) * LINE);
                #pragma unroll
                for (int i = 0; i < TALL; ++i)
                    sums[i][part] += table[i] * value;
            }
            line += 8 * LINE;
            table += TALL;
        }
        #pragma unroll
        for (int i = 0; i < TALL; ++i)
            #pragma unroll
            for (int part = 0; part < 4; ++part)
                STORE(sums[i][part], lines + (8 * i + 2 * parity + (part & 1) + 4 * (part >> 1)) * COLUMNS);
    }
}

// Put W pixels of a line together along x, square, and put the four quadrants of an image together.
__kernel void assemble(const scalar scale, __global const scalar *pixels, __global const scalar *lines,
                       __global scalar *images)
{
    const size_t image = get_global_id(2);
    const int v = get_global_id(1);
#if SHARED
    const int first = get_global_id(0) * W, end = first + W;
#else
    const int first = 0, end = QUARTER;
#endif
    if (first >= QUARTER || v >= QUARTER)
        return;
    lines += (image * ROWS + v) * (8 * COLUMNS);
    images += image * PIXELS * PIXELS;
    __global scalar *above = images + (PIXELS / 2 + v) * PIXELS;
    __global scalar *below = images + ((PIXELS - 1) / 2 - v) * PIXELS;
    for (int u = first; u < end; u += W) {
        __global const scalar *even = pixels + u, *odd = even + COLUMNS * ACROSS;
        real part[8];
        #pragma unroll
        for (int i = 0; i < 8; ++i)
            part[i] = 0.0f;
        for (int k = 0; k < COLUMNS; ++k) {
            const real in_x[2] = {LOAD(even + k * ACROSS), LOAD(odd + k * ACROSS)};
            #pragma unroll
            for (int i = 0; i < 8; ++i)
                part[i] += lines[i * COLUMNS + k] * in_x[i / 4];
        }
        // Even in x: even in y, then odd in y; odd in x likewise.
        real a = part[0] - part[6], b = part[1] - part[7], c = part[3] + part[5], d = part[2] + part[4];
        put(((a + c) * (a + c) + (b - d) * (b - d)) * scale, above, u, 1);
        put(((a - c) * (a - c) + (b + d) * (b + d)) * scale, below, u, 0);
        a = part[0] + part[6], b = part[1] + part[7], c = part[5] - part[3], d = part[4] - part[2];
        put(((a + c) * (a + c) + (b - d) * (b - d)) * scale, below, u, 1);
        put(((a - c) * (a - c) + (b + d) * (b + d)) * scale, above, u, 0);
    }
}

// Add weighted images to a sum, one after the other: the sum's bits do not depend on how many come at once.
__kernel void accumulate(const int count, __global const double *weight, __global const scalar *images,
                         __global const double *before, __global double *after)
{
    const int pixel = get_global_id(1);
    if (pixel >= PIXELS * PIXELS)
        return;
    double total = before[pixel];
    for (int i = 0; i < count; ++i)
        if (weight[i] != 0.0)
            total += weight[i] * (double)images[(size_t)i * PIXELS * PIXELS + pixel];
    after[pixel] = total;
}
