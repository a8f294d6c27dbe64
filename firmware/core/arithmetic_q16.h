/* Arithmetic for 8-bit processors: 16-bit coefficients, 32-bit states and sums, no 64-bit number anywhere. */
#ifndef WQ_ARITHMETIC_H
#define WQ_ARITHMETIC_H

#include "arithmetic_fixed.h"

typedef int16_t wq_coefficient;
typedef struct { int16_t step_re, step_im, gain_re, gain_im, row_re, row_im; } wq_coefficients;
typedef int32_t wq_command;

#define WQ_SIZE(x) ((x) < 0 ? -(int32_t)(x) : (int32_t)(x))
#define WQ_SMALL(dr, di, gr, gi, rr, ri) \
    && WQ_SIZE(dr) < 32768 && WQ_SIZE(di) < 32768 && WQ_SIZE(gr) < 32768 && WQ_SIZE(gi) < 32768 && \
    WQ_SIZE(rr) < 32768 && WQ_SIZE(ri) < 32768
#define WQ_ROW(dr, di, gr, gi, rr, ri) +WQ_SIZE(rr) + WQ_SIZE(ri)
_Static_assert(1 WQ_MODE_LIST(WQ_SMALL), "coefficients must fit 16 bits, either sign");
_Static_assert(WQ_STEP_SHIFT >= 16 && WQ_STEP_SHIFT <= 47, "a step must be below 1/2");
_Static_assert(WQ_GAIN_SHIFT >= 15 && WQ_GAIN_SHIFT <= 47, "a gain must be below 1");
_Static_assert(WQ_ROW_SHIFT >= 16 && WQ_ROW_SHIFT - 16 + WQ_CODE_BITS <= 31, "the middle code must fit 32 bits");
_Static_assert((0 WQ_MODE_LIST(WQ_ROW)) + ((int32_t)WQ_CODE_MIDDLE << (WQ_ROW_SHIFT - 16) >> 14) + 2 <
                   ((int32_t)1 << 17),
               "the command's sum must fit 32 bits at full scale");

/* Return floor(x c / 2^16) in two 16-bit products. */
static inline int32_t wq_product(int32_t x, int16_t c) {
#ifdef __AVR_HAVE_MUL__ /* gcc calls a product of 32 bits instead: eight products of bytes take 48 cycles */
    int32_t product;
    uint8_t lowest, zero;
    __asm__("clr %[z]\n\t"
            "muls %D[x], %B[c]\n\t"
            "movw %C[p], r0\n\t"
            "mul %C[x], %A[c]\n\t"
            "movw %A[p], r0\n\t"
            "mul %A[x], %A[c]\n\t"
            "mov %[l], r1\n\t"
            "mulsu %D[x], %A[c]\n\t" /* the carry is the sign */
            "sbc %D[p], %[z]\n\t"
            "add %B[p], r0\n\t"
            "adc %C[p], r1\n\t"
            "adc %D[p], %[z]\n\t"
            "mulsu %B[c], %C[x]\n\t"
            "sbc %D[p], %[z]\n\t"
            "add %B[p], r0\n\t"
            "adc %C[p], r1\n\t"
            "adc %D[p], %[z]\n\t"
            "mulsu %B[c], %B[x]\n\t"
            "sbc %C[p], %[z]\n\t"
            "sbc %D[p], %[z]\n\t"
            "add %A[p], r0\n\t"
            "adc %B[p], r1\n\t"
            "adc %C[p], %[z]\n\t"
            "adc %D[p], %[z]\n\t"
            "mul %B[x], %A[c]\n\t"
            "add %[l], r0\n\t"
            "adc %A[p], r1\n\t"
            "adc %B[p], %[z]\n\t"
            "adc %C[p], %[z]\n\t"
            "adc %D[p], %[z]\n\t"
            "mulsu %B[c], %A[x]\n\t"
            "sbc %B[p], %[z]\n\t"
            "sbc %C[p], %[z]\n\t"
            "sbc %D[p], %[z]\n\t"
            "add %[l], r0\n\t"
            "adc %A[p], r1\n\t"
            "adc %B[p], %[z]\n\t"
            "adc %C[p], %[z]\n\t"
            "adc %D[p], %[z]\n\t"
            "clr r1"
            : [p] "=&r"(product), [l] "=&r"(lowest), [z] "=&r"(zero)
            : [x] "a"(x), [c] "a"(c)
            : "r0");
    return product;
#else
    return (int32_t)(int16_t)(x >> 16) * c + (((int32_t)(uint16_t)x * c) >> 16);
#endif
}

static inline int32_t wq_corrected(int32_t z, int16_t gain, int32_t error) {
#if WQ_GAIN_SHIFT < 16
    return wq_limited(z + wq_product(error, gain) * 2);
#else
    return wq_limited(z + (wq_product(error, gain) >> (WQ_GAIN_SHIFT - 16)));
#endif
}

static inline int32_t wq_commanded(int32_t sum, int16_t row_re, int32_t re, int16_t row_im, int32_t im) {
    return sum + wq_product(re, row_re) + wq_product(im, row_im);
}

static inline int32_t wq_turned(int32_t z, int16_t a, int32_t re, int16_t b, int32_t im) {
    return wq_limited(z + ((wq_product(re, a) + wq_product(im, b)) >> (WQ_STEP_SHIFT - 16)));
}

static inline uint16_t wq_code(int32_t command) {
    const int32_t code = (command + ((int32_t)WQ_CODE_MIDDLE << (WQ_ROW_SHIFT - 16))) >> (WQ_ROW_SHIFT - 16);
    if (code < 0) return 0;
    return code > WQ_CODE_TOP ? WQ_CODE_TOP : (uint16_t)code;
}

#endif
