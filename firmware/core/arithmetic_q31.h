/* Arithmetic in 32 bits with 64-bit products: states are Q31 of WQ_STATE_FULL. Nothing wraps; all saturates.
 *
 * The static assertions below are what that rests on; they read the gains themselves.
 */
#ifndef WQ_ARITHMETIC_H
#define WQ_ARITHMETIC_H

#include <stdint.h>

#include "wq_gains.h"

typedef int32_t wq_number;
typedef int32_t wq_coefficient;
typedef int64_t wq_sum;
typedef struct { int32_t step_re, step_im, gain_re, gain_im, row_re, row_im; } wq_coefficients;
typedef struct { int32_t re, im; } wq_start;

#define WQ_SIZE(x) ((x) < 0 ? -(int64_t)(x) : (int64_t)(x))
#define WQ_SMALL(dr, di, gr, gi, rr, ri) \
    && WQ_SIZE(dr) < (1L << 30) && WQ_SIZE(di) < (1L << 30) && WQ_SIZE(gr) < (1L << 30) && WQ_SIZE(gi) < (1L << 30)
#define WQ_ROW(dr, di, gr, gi, rr, ri) +WQ_SIZE(rr) + WQ_SIZE(ri)
_Static_assert((-1 >> 1) == -1, "right shifts of negative numbers must keep the sign");
_Static_assert(1 WQ_MODE_LIST(WQ_SMALL), "steps and gains must be below 2^30: two products fit 64 bits");
_Static_assert(WQ_STEP_SHIFT >= 1 && WQ_STEP_SHIFT <= 61, "a half of the step's scale must fit 64 bits");
_Static_assert(WQ_GAIN_SHIFT >= 1 && WQ_GAIN_SHIFT <= 61, "a half of the gain's scale must fit 64 bits");
_Static_assert(WQ_ROW_SHIFT >= 31 && WQ_ROW_SHIFT + WQ_CODE_BITS <= 63, "the middle code must fit 64 bits");
_Static_assert((0 WQ_MODE_LIST(WQ_ROW)) + ((int64_t)WQ_CODE_MIDDLE << (WQ_ROW_SHIFT - 31)) < ((int64_t)1 << 32),
               "the command's sum must fit 64 bits at full scale");
_Static_assert(WQ_READING <= 0x7fffffff / WQ_ADC_TOP, "a reading must fit 32 bits");
_Static_assert(WQ_MODES >= 1 && WQ_MODES <= 64, "modes are counted in 8 bits");

/* States stay within +-(2^31 - 1). */
static inline int32_t wq_limited(int64_t x) {
    const int32_t low = (int32_t)x;
    if (low == x && low != INT32_MIN) return low;
    return x < 0 ? -INT32_MAX : INT32_MAX;
}

static inline int32_t wq_added(int32_t z, int32_t start) { return wq_limited((int64_t)z + start); }

static inline int64_t wq_summed(int64_t sum, int32_t re) { return sum + re; }

static inline int32_t wq_error(int16_t reading, int64_t expected) {
    return wq_limited((int32_t)reading * WQ_READING - expected);
}

static inline int32_t wq_corrected(int32_t z, int32_t gain, int32_t error) {
    const int64_t half = (int64_t)1 << (WQ_GAIN_SHIFT - 1);
    return wq_limited(z + (((int64_t)gain * error + half) >> WQ_GAIN_SHIFT));
}

static inline int64_t wq_commanded(int64_t sum, int32_t row_re, int32_t re, int32_t row_im, int32_t im) {
    return sum + (int64_t)row_re * re - (int64_t)row_im * im;
}

static inline int32_t wq_turned(int32_t z, int32_t a, int32_t re, int32_t b, int32_t im) {
    const int64_t half = (int64_t)1 << (WQ_STEP_SHIFT - 1);
    return wq_limited(z + (((int64_t)a * re + (int64_t)b * im + half) >> WQ_STEP_SHIFT));
}

static inline uint16_t wq_code(int64_t command) {
    const int64_t code = (command + ((int64_t)WQ_CODE_MIDDLE << WQ_ROW_SHIFT)) >> WQ_ROW_SHIFT;
    if (code < 0) return 0;
    return code > WQ_CODE_TOP ? WQ_CODE_TOP : (uint16_t)code;
}

#endif
