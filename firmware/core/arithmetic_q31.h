/* Arithmetic with 32-bit coefficients and 64-bit products, two instructions each on a Cortex-M3.
 *
 * States are Q30 of full scale: one bit is spare, so that a state and what it gains in a step fit 32 bits and
 * one instruction limits them. Nothing wraps; all saturates. The static assertions are what that rests on;
 * they read the gains themselves.
 */
#ifndef WQ_ARITHMETIC_H
#define WQ_ARITHMETIC_H

#include <stdint.h>

#include "wq_gains.h"

typedef int32_t wq_number;
typedef int32_t wq_coefficient;
typedef struct { int32_t step_re, step_im, gain_re, gain_im, row_re, row_im; } wq_coefficients;
typedef struct { int32_t re, im; } wq_start;
typedef int32_t wq_expectation;
typedef int64_t wq_command;

#define WQ_FULL ((int32_t)1 << 30)
#define WQ_SUM_SHIFT 4 /* states are summed up without their last bits, so that the sum fits */
#define WQ_SIZE(x) ((x) < 0 ? -(int64_t)(x) : (int64_t)(x))
#define WQ_SMALL(dr, di, gr, gi, rr, ri) \
    && WQ_SIZE(dr) + WQ_SIZE(di) < (int64_t)1 << WQ_STEP_SHIFT && WQ_SIZE(dr) <= INT32_MAX && \
    WQ_SIZE(di) <= INT32_MAX && WQ_SIZE(gr) <= INT32_MAX && WQ_SIZE(gi) <= INT32_MAX
#define WQ_ROW(dr, di, gr, gi, rr, ri) +WQ_SIZE(rr) + WQ_SIZE(ri)
_Static_assert((-1 >> 1) == -1, "right shifts of negative numbers must keep the sign");
_Static_assert(1 WQ_MODE_LIST(WQ_SMALL), "what a step adds to a state must be below full scale");
_Static_assert(WQ_STEP_SHIFT >= 31 && WQ_STEP_SHIFT <= 32, "two of a step's products must fit 64 bits");
_Static_assert(WQ_GAIN_SHIFT >= 31 && WQ_GAIN_SHIFT <= 32, "a gain must be below 1");
_Static_assert(WQ_ROW_SHIFT >= 31 && WQ_ROW_SHIFT + WQ_CODE_BITS <= 63, "the middle code must fit 64 bits");
_Static_assert((0 WQ_MODE_LIST(WQ_ROW)) + ((int64_t)WQ_CODE_MIDDLE << (WQ_ROW_SHIFT - 30)) < ((int64_t)1 << 33),
               "the command's sum must fit 64 bits at full scale");
_Static_assert(WQ_READING <= (1L << 30) / WQ_ADC_TOP, "a reading must fit the states' range");
_Static_assert(WQ_MODES >= 1 && WQ_MODES <= 15, "the modes' sum must fit 32 bits");

static inline int32_t wq_limited(int32_t x) {
#ifdef __ARM_FEATURE_SAT /* gcc does not find the instruction by itself */
    int32_t limited;
    __asm__("ssat %0, #31, %1" : "=r"(limited) : "r"(x));
    return limited;
#else
    return x > WQ_FULL - 1 ? WQ_FULL - 1 : x < -WQ_FULL ? -WQ_FULL : x;
#endif
}

static inline int32_t wq_added(int32_t z, int32_t start) { return wq_limited(z + start); }

static inline int32_t wq_summed(int32_t sum, int32_t re) { return sum + (re >> WQ_SUM_SHIFT); }

static inline int32_t wq_error(int16_t reading, int32_t expected) {
    const int32_t error = ((reading * (int32_t)WQ_READING) >> WQ_SUM_SHIFT) - expected;
    const int32_t full = WQ_FULL >> WQ_SUM_SHIFT;
    return (error > full - 1 ? full - 1 : error < -full ? -full : error) * (1 << WQ_SUM_SHIFT);
}

static inline int32_t wq_corrected(int32_t z, int32_t gain, int32_t error) {
    return wq_limited(z + (int32_t)(((int64_t)gain * error) >> WQ_GAIN_SHIFT));
}

static inline int64_t wq_commanded(int64_t sum, int32_t row_re, int32_t re, int32_t row_im, int32_t im) {
    return sum + (int64_t)row_re * re + (int64_t)row_im * im;
}

static inline int32_t wq_turned(int32_t z, int32_t a, int32_t re, int32_t b, int32_t im) {
    return wq_limited(z + (int32_t)(((int64_t)a * re + (int64_t)b * im) >> WQ_STEP_SHIFT));
}

static inline uint16_t wq_code(int64_t command) {
    const int64_t code = (command + ((int64_t)WQ_CODE_MIDDLE << WQ_ROW_SHIFT)) >> WQ_ROW_SHIFT;
    if (code < 0) return 0;
    return code > WQ_CODE_TOP ? WQ_CODE_TOP : (uint16_t)code;
}

#endif
