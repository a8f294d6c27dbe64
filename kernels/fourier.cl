// Discrete Fourier transforms of length N along rows or columns: stages of the Stockham algorithm.
//
// A stage (length n, stride s, radix R, m = n / R) takes x[q + s (p + m r)] for p < m, q < s, transforms over
// r, multiplies by exp(-2 pi i p r / n) and stores to y[q + s (R p + r)]; then n becomes m, and s becomes
// s R. Real and imaginary parts are apart between the stages. A work-item does a row, whose lanes are values
// of q (of p in the first stage), or W adjacent columns, whose lanes they are; none ever waits for another.
//
// Compile-time constants: W lanes, SINGLE, N, OTHER (rows of a column transform, or columns of a row
// transform), INVERSE, ROWS (1: along rows), STREAM (1: outputs are aligned vectors and go past the caches),
// PANEL (columns of a panel between the transforms; 0: rows lie one after the other). The generator adds the
// kernels, which call the stages.

#include "waves.h"

// Past the caches: what is not read soon need not be there, and memory is not read before it is written.
#if STREAM && __has_builtin(__builtin_nontemporal_store)
#define STORE_OUT(value, address) __builtin_nontemporal_store(value, (__global real *)(address))
#else
#define STORE_OUT(value, address) STORE(value, address)
#endif

// Between the transforms, panels of as many columns as one work-item takes lie one after the other: what it
// reads is in one piece. Places are counted in real numbers.
#if PANEL
#define ROW(number) (2 * ((size_t)((number) / OTHER) * OTHER * N + (number) % OTHER * PANEL))
#define IN_ROW(column) (2 * ((column) / PANEL * (size_t)PANEL * OTHER + (column) % PANEL))
#define COLUMN(column) (2 * (size_t)(column) * N)
#define DOWN (size_t)(2 * PANEL)
#else
#define ROW(number) (2 * (size_t)(number) * N)
#define IN_ROW(column) (2 * (column))
#define COLUMN(column) (2 * (column))
#define DOWN ((size_t)2 * OTHER)
#endif

// Where the imaginary parts of a row start, and what lies between two copies of a row or panel.
#define IMAGINARY (N + 8)
#define APART (ROWS ? 24 : 3)

#if W == 1
INLINE wave load_complex(__global const scalar *a) { return (wave){a[INVERSE], a[1 - INVERSE]}; }
INLINE void store_complex(wave value, __global scalar *a)
{
    a[INVERSE] = value.re;
    a[1 - INVERSE] = value.im;
}
#else
// Swapping real and imaginary parts before and after makes the inverse of a transform.
INLINE wave load_complex(__global const scalar *address)
{
    const real a = LOAD(address), b = LOAD(address + W);
    const real re = (real)(a.even, b.even), im = (real)(a.odd, b.odd);
    return INVERSE ? (wave){im, re} : (wave){re, im};
}

INLINE void store_complex(wave value, __global scalar *address)
{
    real a, b;
    const real re = INVERSE ? value.im : value.re, im = INVERSE ? value.re : value.im;
    a.even = re.lo;
    a.odd = im.lo;
    b.even = re.hi;
    b.odd = im.hi;
    STORE_OUT(a, address);
    STORE_OUT(b, address + W);
}
#endif

// Transpose W vectors: rounds of a perfect shuffle.
INLINE void transpose(real *v)
{
#if W > 1
    #pragma unroll
    for (int round = 1; round < W; round *= 2) {
        real mixed[W];
        #pragma unroll
        for (int i = 0; i < W / 2; ++i) {
            real low, high;
            low.even = v[i].lo;
            low.odd = v[i + W / 2].lo;
            high.even = v[i].hi;
            high.odd = v[i + W / 2].hi;
            mixed[2 * i] = low;
            mixed[2 * i + 1] = high;
        }
        #pragma unroll
        for (int i = 0; i < W; ++i)
            v[i] = mixed[i];
    }
#endif
}

INLINE wave plus(wave a, wave b) { return (wave){a.re + b.re, a.im + b.im}; }
INLINE wave minus(wave a, wave b) { return (wave){a.re - b.re, a.im - b.im}; }
INLINE wave minus_i(wave a) { return (wave){a.im, -a.re}; }
INLINE wave times(wave a, real re, real im) { return (wave){a.re * re - a.im * im, a.re * im + a.im * re}; }
INLINE wave scaled(wave a, scalar factor) { return (wave){a.re * factor, a.im * factor}; }

INLINE void transform_1(wave *a) {}

INLINE void transform_2(wave *a)
{
    const wave b = a[0];
    a[0] = plus(b, a[1]);
    a[1] = minus(b, a[1]);
}

INLINE void transform_3(wave *a)
{
    const scalar half_root = (scalar)0.86602540378443864676;
    const wave t = plus(a[1], a[2]), turned = scaled(minus_i(minus(a[1], a[2])), half_root);
    const wave middle = minus(a[0], scaled(t, (scalar)0.5));
    a[0] = plus(a[0], t);
    a[1] = plus(middle, turned);
    a[2] = minus(middle, turned);
}

INLINE void transform_4(wave *a)
{
    const wave b = plus(a[0], a[2]), c = minus(a[0], a[2]), d = plus(a[1], a[3]);
    const wave e = minus_i(minus(a[1], a[3]));
    a[0] = plus(b, d);
    a[1] = plus(c, e);
    a[2] = minus(b, d);
    a[3] = minus(c, e);
}

INLINE void transform_5(wave *a)
{
    const scalar c1 = (scalar)0.30901699437494742410, c2 = (scalar)-0.80901699437494742410;
    const scalar s1 = (scalar)0.95105651629515357212, s2 = (scalar)0.58778525229247312917;
    const wave b = plus(a[1], a[4]), c = plus(a[2], a[3]);
    const wave d = minus_i(minus(a[1], a[4])), e = minus_i(minus(a[2], a[3]));
    const wave m1 = plus(a[0], plus(scaled(b, c1), scaled(c, c2)));
    const wave m2 = plus(a[0], plus(scaled(b, c2), scaled(c, c1)));
    const wave t1 = plus(scaled(d, s1), scaled(e, s2)), t2 = minus(scaled(d, s2), scaled(e, s1));
    a[0] = plus(a[0], plus(b, c));
    a[1] = plus(m1, t1);
    a[4] = minus(m1, t1);
    a[2] = plus(m2, t2);
    a[3] = minus(m2, t2);
}

INLINE void transform_8(wave *a)
{
    const scalar h = (scalar)0.70710678118654752440;
    wave even[4] = {a[0], a[2], a[4], a[6]}, odd[4] = {a[1], a[3], a[5], a[7]};
    transform_4(even);
    transform_4(odd);
    odd[1] = (wave){h * (odd[1].re + odd[1].im), h * (odd[1].im - odd[1].re)};
    odd[2] = minus_i(odd[2]);
    odd[3] = (wave){h * (odd[3].im - odd[3].re), -h * (odd[3].re + odd[3].im)};
    #pragma unroll
    for (int i = 0; i < 4; ++i) {
        a[i] = plus(even[i], odd[i]);
        a[i + 4] = minus(even[i], odd[i]);
    }
}
