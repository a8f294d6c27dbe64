// Vectors of W numbers, float (SINGLE) or double, and the wave exp(i phase) without built-in functions.
//
// As in lanes.h only operators and ?: act on lanes: built-in functions may stay calls that spill registers.

#pragma OPENCL EXTENSION cl_khr_fp64 : enable
#pragma OPENCL FP_CONTRACT ON

#ifndef __has_builtin
#define __has_builtin(name) 0
#endif
// A GPU's memory is another than that of which the intrinsic takes addresses.
#if W > 1 && __has_builtin(__builtin_prefetch)
#define PREFETCH(address) __builtin_prefetch(address)
#else
#define PREFETCH(address)
#endif

#define INLINE inline __attribute__((always_inline))
#define JOIN_(a, b) a##b
#define JOIN(a, b) JOIN_(a, b)

#if SINGLE
typedef float scalar;
typedef int bits;
#define SIGN_SHIFT 30
#define NUMBERS float
#define INTEGERS int
#else
typedef double scalar;
typedef long bits;
#define SIGN_SHIFT 62
#define NUMBERS double
#define INTEGERS long
#endif

#if W == 1
typedef scalar real;
typedef bits whole;
#define LOAD(address) (*(address))
#define LOAD_LOCAL(address) (*(address))
#define STORE(value, address) (*(address) = (value))
#define STORE_LOCAL(value, address) (*(address) = (value))
#define LANE(value, i) (value)
#define REVERSED(value) (value)
#else
typedef JOIN(NUMBERS, W) real;
typedef JOIN(INTEGERS, W) whole;
#if defined(__clang__)
typedef real loose_real __attribute__((aligned(4)));
#define LOAD(address) (*(__global const loose_real *)(address))
#define LOAD_LOCAL(address) (*(__local const loose_real *)(address))
#define STORE(value, address) (*(__global loose_real *)(address) = (value))
#define STORE_LOCAL(value, address) (*(__local loose_real *)(address) = (value))
#define LANE(value, i) ((value)[i])
#else
#define LOAD(address) JOIN(vload, W)(0, address)
#define LOAD_LOCAL(address) JOIN(vload, W)(0, address)
#define STORE(value, address) JOIN(vstore, W)(value, 0, address)
#define STORE_LOCAL(value, address) JOIN(vstore, W)(value, 0, address)
#define LANE(value, i) (((scalar *)&(value))[i])
#endif
#if W == 2
#define REVERSED(value) ((value).s10)
#elif W == 4
#define REVERSED(value) ((value).s3210)
#elif W == 8
#define REVERSED(value) ((value).s76543210)
#elif W == 16
#define REVERSED(value) ((value).sfedcba9876543210)
#endif
#endif

typedef struct { real re, im; } wave;

#if W == 1
#define TO_WHOLE JOIN(as_, INTEGERS)
#define TO_REAL JOIN(as_, NUMBERS)
#define LIT(condition) (-(whole)(condition))
#else
#define TO_WHOLE JOIN(JOIN(as_, INTEGERS), W)
#define TO_REAL JOIN(JOIN(as_, NUMBERS), W)
#define LIT(condition) (condition)
#endif

// Reduce by quarter turns, whose number is added to a constant that leaves it in the lowest bits; then
// minimax polynomials in r^2 over |r| <= pi/4.
INLINE wave wave_of(real phase)
{
#if SINGLE
    const real shifted = phase * 0.636619772f + 12582912.0f;
    const real turns = shifted - 12582912.0f;
    real r = phase - turns * 1.5707963109016418f;
    r = r - turns * 1.5893254712295857e-8f;
    const real z = r * r;
    real sine = -1.9515295891e-4f * z + 8.3321608736e-3f;
    sine = sine * z - 1.6666654611e-1f;
    sine = r + r * z * sine;
    real cosine = 2.443315711809948e-5f * z - 1.388731625493765e-3f;
    cosine = cosine * z + 4.166664568298827e-2f;
    cosine = 1.0f - (0.5f * z - z * z * cosine);
#else
    const real shifted = phase * 0.63661977236758134308 + 6755399441055744.0;
    const real turns = shifted - 6755399441055744.0;
    real r = phase - turns * 1.57079632673412561417;
    r = r - turns * 6.07710050630396597660e-11;
    r = r - turns * 2.02226624879595063154e-21;
    const real z = r * r;
    real sine = 1.58969099521155010221e-10 * z - 2.50507602534068634195e-08;
    sine = sine * z + 2.75573137070700676789e-06;
    sine = sine * z - 1.98412698298579493134e-04;
    sine = sine * z + 8.33333333332248946124e-03;
    sine = sine * z - 1.66666666666666324348e-01;
    sine = r + r * z * sine;
    real cosine = -1.13596475577881948265e-11 * z + 2.08757232129817482790e-09;
    cosine = cosine * z - 2.75573143513906633035e-07;
    cosine = cosine * z + 2.48015872894767294178e-05;
    cosine = cosine * z - 1.38888888888741095749e-03;
    cosine = cosine * z + 4.16666666666666019037e-02;
    cosine = 1.0 - (0.5 * z - z * z * cosine);
#endif
    const whole quarter = TO_WHOLE(shifted);
    const whole odd = (quarter & 1) != 0;
    wave result;
    result.re = TO_REAL(TO_WHOLE(odd ? sine : cosine) ^ (((quarter + 1) & 2) << SIGN_SHIFT));
    result.im = TO_REAL(TO_WHOLE(odd ? cosine : sine) ^ ((quarter & 2) << SIGN_SHIFT));
    return result;
}
