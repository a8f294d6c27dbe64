// W doubles that move together: 16 instants of one ray on a CPU, one instant on a GPU.
//
// Only operators and ?: act on lanes: some OpenCL implementations do not inline their built-in functions,
// not even vload, and each call spills every register. A NaN makes every comparison false: it is never
// "inside" or "finite".

#pragma OPENCL EXTENSION cl_khr_fp64 : enable
#pragma OPENCL FP_CONTRACT ON

// A helper that stays a call spills every register of its caller.
#define INLINE inline __attribute__((always_inline))

#define JOIN_(a, b) a##b
#define JOIN(a, b) JOIN_(a, b)

#if W == 1
typedef double real;
typedef int mask, integers;
#define to_integers(a) ((int)(a))
#define to_real(a) ((double)(a))
#define LOAD(address) (*(address))
#define STORE(value, address) (*(address) = (value))
#define STORE_STATUS(value, address) (*(address) = (char)(value))
#else
typedef JOIN(double, W) real;
typedef JOIN(long, W) mask;
typedef JOIN(int, W) integers;
#if defined(__clang__)
#define to_integers(a) __builtin_convertvector(a, integers)
#define to_real(a) __builtin_convertvector(a, real)
typedef real loose_real __attribute__((aligned(8)));
typedef JOIN(char, W) loose_status __attribute__((aligned(1)));
#define LOAD(address) (*(__global const loose_real *)(address))
#define STORE(value, address) (*(__global loose_real *)(address) = (value))
#define STORE_STATUS(value, address) \
    (*(__global loose_status *)(address) = __builtin_convertvector(value, JOIN(char, W)))
#else
#define to_integers(a) JOIN(convert_int, W)(a)
#define to_real(a) JOIN(convert_double, W)(a)
#define LOAD(address) JOIN(vload, W)(0, address)
#define STORE(value, address) JOIN(vstore, W)(value, 0, address)
#define STORE_STATUS(value, address) JOIN(vstore, W)(JOIN(convert_char, W)(value), 0, address)
#endif
#endif

#ifndef __has_builtin
#define __has_builtin(name) 0
#endif

#if __has_builtin(__builtin_expect)
#define UNLIKELY(condition) __builtin_expect(condition, 0)
#else
#define UNLIKELY(condition) (condition)
#endif
#define EITHER(condition, yes, no) ((condition) ? (yes) : (no))
#define NOT(condition) ((condition) == 0)

// Put this at the head of a kernel. Compilers align the stack for spilled vectors only if a variable asks for
// it; else every other of them crosses a cache line.
#if W > 1
#define ALIGN_STACK volatile char aligned __attribute__((aligned(64))) = 0
#else
#define ALIGN_STACK (void)0
#endif

INLINE mask finite(real a) { return a - a == 0.0; }

INLINE int any_lane(mask a)
{
#if W == 1
    return a != 0;
#else
#if W == 16
    long8 b = a.lo | a.hi;
#else
    mask b = a;
#endif
#if W >= 8
    long4 c = b.lo | b.hi;
#else
    mask c = b;
#endif
    long2 d = c.lo | c.hi;
    return (d.x | d.y) != 0;
#endif
}

// Clang's intrinsic becomes the vector instruction; the built-in function may stay a call.
INLINE real root(real a)
{
#if W > 1 && __has_builtin(__builtin_elementwise_sqrt)
    return __builtin_elementwise_sqrt(a);
#elif W > 1 && defined(__clang__)
    real result;
    #pragma unroll
    for (int lane = 0; lane < W; ++lane)
        result[lane] = __builtin_sqrt(a[lane]);
    return result;
#else
    return sqrt(a);
#endif
}
