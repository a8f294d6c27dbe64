// Standard normal numbers that a counter addresses, four by each of its steps.
//
// Work-item: W steps. Uniform bits are those of Philox 4x64-10 (Salmon et al. 2011, Parallel random numbers: as
// easy as 1, 2, 3), which NumPy's generator of that name gives, too; normal quantiles are Wichura's (1988, The
// percentage points of the normal distribution, Applied Statistics 37: algorithm AS 241, PPND16).
// Compile-time constant: W lanes.

#include "lanes.h"

#if W == 1
typedef ulong words;
typedef long integers64;
#define REAL_BITS(x) as_long(x)
#define BITS_REAL(x) as_double(x)
#define TO_MASK(x) ((x) >> 63 ? -1 : 0)
#define LANE(x, lane) (x)
#else
typedef JOIN(ulong, W) words;
typedef mask integers64;
#define REAL_BITS(x) JOIN(as_long, W)(x)
#define BITS_REAL(x) JOIN(as_double, W)(x)
#define TO_MASK(x) JOIN(as_long, W)(x)
#define LANE(x, lane) ((x)[lane])
#endif

// The upper half of products; those of whole words are no vector instructions.
INLINE words upper(words x, ulong factor)
{
    const ulong lowest = 0xffffffffUL, b = factor & lowest, c = factor >> 32;
    const words low = x & lowest, high = x >> 32;
    const words one = low * c, other = high * b;
    const words carry = (low * b >> 32) + (one & lowest) + (other & lowest);
    return high * c + (one >> 32) + (other >> 32) + (carry >> 32);
}

// The middle of the interval of 2^-53 that a word chooses, less 1/2: never at an end of (-1/2, 1/2).
INLINE real uniform(words word)
{
    // 52 bits make a number from 1 to 2, without a conversion; the one below them chooses the half.
    const real coarse = BITS_REAL((word >> 12) | 0x3ff0000000000000UL) - 1.5;
    return coarse + EITHER((TO_MASK(word << 52) < 0), (real)(0x1.8p-53), (real)(0x1p-54));
}

// log x of x > 0 from 2 artanh((m - 1) / (m + 1)) of its mantissa m, to 2e-16.
INLINE real logarithm(real x)
{
    const integers64 exponent = (REAL_BITS(x) - 0x3fe6a09e667f3bcdL) >> 52; // m from sqrt(1/2) to sqrt(2)
    const real m = BITS_REAL(REAL_BITS(x) - (exponent << 52));
    // A whole number in the last bits of 3 * 2^51.
    const real whole = BITS_REAL(exponent + 0x4338000000000000L) - 0x1.8p52;
    const real s = (m - 1.0) / (m + 1.0), z = s * s;
    real sum = (real)(1.0 / 21.0);
    sum = sum * z + 1.0 / 19.0;
    sum = sum * z + 1.0 / 17.0;
    sum = sum * z + 1.0 / 15.0;
    sum = sum * z + 1.0 / 13.0;
    sum = sum * z + 1.0 / 11.0;
    sum = sum * z + 1.0 / 9.0;
    sum = sum * z + 1.0 / 7.0;
    sum = sum * z + 1.0 / 5.0;
    sum = sum * z + 1.0 / 3.0;
    const real small = whole * 1.90821492927058770002e-10 + 2.0 * s * z * sum;
    return whole * 6.93147180369123816490e-01 + (2.0 * s + small);
}

// Coefficients in the middle, in the tails, and where they hold less than exp(-25) of all numbers.
#define CHOSEN(a, b, c) EITHER(middle, (real)(a), EITHER(near, (real)(b), (real)(c)))

// Where the normal distribution is 1/2 + q.
INLINE real quantile(real q)
{
    const mask upside = q > 0.0, middle = (q <= 0.425) & (q >= -0.425);
    const real r = root(-logarithm(0.5 - EITHER(upside, q, -q)));
    const mask near = r <= 5.0;
    const real x = EITHER(middle, 0.180625 - q * q, r - EITHER(near, (real)(1.6), (real)(5.0)));
    real top = CHOSEN(2509.0809287301226727, 7.74545014278341407640e-4, 2.01033439929228813265e-7);
    top = top * x + CHOSEN(33430.575583588128105, 2.27238449892691845833e-2, 2.71155556874348757815e-5);
    top = top * x + CHOSEN(67265.770927008700853, 2.41780725177450611770e-1, 1.24266094738807843860e-3);
    top = top * x + CHOSEN(45921.953931549871457, 1.27045825245236838258, 2.65321895265761230930e-2);
    top = top * x + CHOSEN(13731.693765509461125, 3.64784832476320460504, 2.96560571828504891230e-1);
    top = top * x + CHOSEN(1971.5909503065514427, 5.76949722146069140550, 1.78482653991729133580);
    top = top * x + CHOSEN(133.14166789178437745, 4.63033784615654529590, 5.46378491116411436990);
    top = top * x + CHOSEN(3.3871328727963666080, 1.42343711074968357734, 6.65790464350110377720);
    real under = CHOSEN(5226.4952788528545610, 1.05075007164441684324e-9, 2.04426310338993978564e-15);
    under = under * x + CHOSEN(28729.085735721942674, 5.47593808499534494600e-4, 1.42151175831644588870e-7);
    under = under * x + CHOSEN(39307.895800092710610, 1.51986665636164571966e-2, 1.84631831751005468180e-5);
    under = under * x + CHOSEN(21213.794301586595867, 1.48103976427480074590e-1, 7.86869131145613259100e-4);
    under = under * x + CHOSEN(5394.1960214247511077, 6.89767334985100004550e-1, 1.48753612908506148525e-2);
    under = under * x + CHOSEN(687.18700749205790830, 1.67638483018380384940, 1.36929880922735805310e-1);
    under = under * x + CHOSEN(42.313330701600911252, 2.05319162663775882187, 5.99832206555887937690e-1);
    const real ratio = top / (under * x + 1.0);
    return EITHER(middle, q * ratio, EITHER(upside, ratio, -ratio));
}

INLINE void put(__global double *numbers, int steps, real values)
{
    for (int lane = 0; lane < W; ++lane)
        if (lane < steps)
            numbers[4 * lane] = LANE(values, lane);
}

__kernel void normals(const int steps, const ulong key_low, const ulong key_high, const ulong before,
                      __global double *numbers)
{
    const int first = W * get_global_id(1);
    if (first >= steps)
        return;
    ALIGN_STACK;
    words a, b = 0, c = 0, d = 0;
    for (int lane = 0; lane < W; ++lane)
        LANE(a, lane) = before + first + lane + 1; // NumPy counts before it draws
    ulong low = key_low, high = key_high;
    for (int round = 0; round < 10; ++round) {
        const ulong one = 0xD2E7470EE14C6C93UL, other = 0xCA5A826395121157UL;
        const words then = upper(c, other) ^ b ^ low, last = upper(a, one) ^ d ^ high;
        b = c * other;
        d = a * one;
        a = then;
        c = last;
        low += 0x9E3779B97F4A7C15UL;
        high += 0xBB67AE8584CAA73BUL;
    }
    numbers += 4 * first;
    put(numbers, steps - first, quantile(uniform(a)));
    put(numbers + 1, steps - first, quantile(uniform(b)));
    put(numbers + 2, steps - first, quantile(uniform(c)));
    put(numbers + 3, steps - first, quantile(uniform(d)));
}
