/* Arithmetic with 32-bit coefficients and 64-bit products, two instructions each on a Cortex-M3. */
#ifndef WQ_ARITHMETIC_H
#define WQ_ARITHMETIC_H

#include "arithmetic_fixed.h"

typedef int32_t wq_coefficient;
typedef struct { int32_t step_re, step_im, gain_re, gain_im, row_re, row_im; } wq_coefficients;
typedef int64_t wq_command;

#define WQ_SIZE(x) ((x) < 0 ? -(int64_t)(x) : (int64_t)(x))
#define WQ_SMALL(dr, di, gr, gi, rr, ri) \
    && WQ_SIZE(dr) + WQ_SIZE(di) < (int64_t)1 << WQ_STEP_SHIFT && WQ_SIZE(dr) <= INT32_MAX && \
    WQ_SIZE(di) <= INT32_MAX && WQ_SIZE(gr) <= INT32_MAX && WQ_SIZE(gi) <= INT32_MAX
#define WQ_ROW(dr, di, gr, gi, rr, ri) +WQ_SIZE(rr) + WQ_SIZE(ri)
_Static_assert(1 WQ_MODE_LIST(WQ_SMALL), "what a step adds to a state must be below full scale");
_Static_assert(WQ_STEP_SHIFT >= 31 && WQ_STEP_SHIFT <= 32, "two of a step's products must fit 64 bits");
_Static_assert(WQ_GAIN_SHIFT >= 31 && WQ_GAIN_SHIFT <= 32, "a gain must be below 1");
_Static_assert(WQ_ROW_SHIFT >= 31 && WQ_ROW_SHIFT + WQ_CODE_BITS <= 63, "the middle code must fit 64 bits");
_Static_assert((0 WQ_MODE_LIST(WQ_ROW)) + ((int64_t)WQ_CODE_MIDDLE << (WQ_ROW_SHIFT - 30)) < ((int64_t)1 << 33),
               "the command's sum must fit 64 bits at full scale");

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
