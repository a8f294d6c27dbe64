// The stages of radix RADIX (see fourier.cl). ROWS: 1 along rows, 0 along columns; IS_FIRST: whether the
// first stage has this radix, which W then divides.

#define NAME(stage) JOIN(JOIN(stage, _), RADIX)
#define TRANSFORM JOIN(transform_, RADIX)

#if ROWS

#if IS_FIRST

// Lanes are values of p; factors: (RADIX - 1, re and im, m).
INLINE void NAME(first)(__global const scalar *x, __local scalar *y, __global const scalar *factors, int m)
{
    for (int place = 0; place < m; place += W) {
        const int p = place + W > m ? m - W : place;  // the last group overlaps the one before it
        wave a[RADIX];
        #pragma unroll
        for (int r = 0; r < RADIX; ++r) {
            __global const scalar *place = x + 2 * (p + m * r);
            a[r] = load_complex(place);
            PREFETCH(place + 2 * N);  // the next row: whole rows are too short for what foresees steps
            PREFETCH(place + 2 * N + W);
        }
        TRANSFORM(a);
        #pragma unroll
        for (int r = 1; r < RADIX; ++r)
            a[r] = times(a[r], LOAD(factors + (2 * r - 2) * m + p), LOAD(factors + (2 * r - 1) * m + p));
        #pragma unroll
        for (int block = 0; block < RADIX; block += W) {
            real re[W], im[W];
            #pragma unroll
            for (int i = 0; i < W; ++i) {
                re[i] = a[block + i].re;
                im[i] = a[block + i].im;
            }
            transpose(re);
            transpose(im);
            #pragma unroll
            for (int i = 0; i < W; ++i) {
                STORE_LOCAL(re[i], y + RADIX * (p + i) + block);
                STORE_LOCAL(im[i], y + IMAGINARY + RADIX * (p + i) + block);
            }
        }
    }
}

#endif

// Factors: (m, RADIX - 1, re and im).
INLINE void NAME(middle)(__local const scalar *x, __local scalar *y, __global const scalar *factors, int m,
                         int s)
{
    for (int p = 0; p < m; ++p, factors += 2 * (RADIX - 1))
        for (int q = 0; q < s; q += W) {
            wave a[RADIX];
            #pragma unroll
            for (int r = 0; r < RADIX; ++r)
                a[r] = (wave){LOAD_LOCAL(x + q + s * (p + m * r)), LOAD_LOCAL(x + IMAGINARY + q + s * (p + m * r))};
            TRANSFORM(a);
            #pragma unroll
            for (int r = 0; r < RADIX; ++r) {
                const wave b = r ? times(a[r], factors[2 * r - 2], factors[2 * r - 1]) : a[r];
                STORE_LOCAL(b.re, y + q + s * (RADIX * p + r));
                STORE_LOCAL(b.im, y + IMAGINARY + q + s * (RADIX * p + r));
            }
        }
}

INLINE void NAME(last)(__local const scalar *x, __global scalar *y, scalar scale, int s)
{
    for (int q = 0; q < s; q += W) {
        wave a[RADIX];
        #pragma unroll
        for (int r = 0; r < RADIX; ++r)
            a[r] = (wave){LOAD_LOCAL(x + q + s * r), LOAD_LOCAL(x + IMAGINARY + q + s * r)};
        TRANSFORM(a);
        #pragma unroll
        for (int r = 0; r < RADIX; ++r)
            store_complex(scaled(a[r], scale), y + IN_ROW(q + s * r));
    }
}

#else

INLINE void NAME(first)(__global const scalar *x, __local wave *y, __global const scalar *factors, int m)
{
    for (int p = 0; p < m; ++p, factors += 2 * (RADIX - 1)) {
        wave a[RADIX];
        #pragma unroll
        for (int r = 0; r < RADIX; ++r) {
            __global const scalar *place = x + DOWN * (p + m * r);
            a[r] = load_complex(place);
#if !PANEL
            PREFETCH(place + 2 * W);  // no processor foresees such long steps to the next group of columns
            PREFETCH(place + 3 * W);
#endif
        }
        TRANSFORM(a);
        y[RADIX * p] = a[0];
        #pragma unroll
        for (int r = 1; r < RADIX; ++r)
            y[RADIX * p + r] = times(a[r], factors[2 * r - 2], factors[2 * r - 1]);
    }
}

INLINE void NAME(middle)(__local const wave *x, __local wave *y, __global const scalar *factors, int m, int s)
{
    for (int p = 0; p < m; ++p, factors += 2 * (RADIX - 1))
        for (int q = 0; q < s; ++q) {
            wave a[RADIX];
            #pragma unroll
            for (int r = 0; r < RADIX; ++r)
                a[r] = x[q + s * (p + m * r)];
            TRANSFORM(a);
            y[q + s * RADIX * p] = a[0];
            #pragma unroll
            for (int r = 1; r < RADIX; ++r)
                y[q + s * (RADIX * p + r)] = times(a[r], factors[2 * r - 2], factors[2 * r - 1]);
        }
}

INLINE void NAME(last)(__local const wave *x, __global scalar *y, scalar scale, int s)
{
    for (int q = 0; q < s; ++q) {
        wave a[RADIX];
        #pragma unroll
        for (int r = 0; r < RADIX; ++r)
            a[r] = x[q + s * r];
        TRANSFORM(a);
        #pragma unroll
        for (int r = 0; r < RADIX; ++r)
            store_complex(scaled(a[r], scale), y + 2 * (size_t)OTHER * (q + s * r));
    }
}

#endif

#undef NAME
#undef TRANSFORM
