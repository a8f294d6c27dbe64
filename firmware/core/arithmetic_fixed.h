/* What the integer arithmetics share: states are Q30 of WQ_STATE_FULL in 32 bits. One bit is spare, so that a
 * state and what it gains in a step fit, and one instruction limits them. Nothing wraps; all saturates. The
 * static assertions are what that rests on; they read the gains themselves.
 */
#ifndef WQ_ARITHMETIC_FIXED_H
#define WQ_ARITHMETIC_FIXED_H

#include <stdint.h>

#include "wq_gains.h"

typedef int32_t wq_number;
typedef int32_t wq_expectation;
typedef struct { int32_t re, im; } wq_start;

#define WQ_FULL ((int32_t)1 << 30)
#define WQ_SUM_SHIFT 4 /* states are summed up without their last bits, so that the sum fits */
_Static_assert((-1 >> 1) == -1, "right shifts of negative numbers must keep the sign");
_Static_assert(WQ_READING > 0 && WQ_READING <= (1L << 30) / WQ_ADC_TOP, "a reading must fit the states' range");
#define WQ_STARTED(re, im) && (re) < WQ_FULL && (re) > -WQ_FULL && (im) < WQ_FULL && (im) > -WQ_FULL
_Static_assert(1 WQ_START_LIST(WQ_STARTED), "what a blow adds to a state must be below full scale");
_Static_assert(WQ_READING * WQ_ADC_TOP >= WQ_FULL / WQ_STATE_REACHES - WQ_ADC_TOP &&
                   WQ_READING * WQ_ADC_TOP <= WQ_FULL / WQ_STATE_REACHES + WQ_ADC_TOP,
               "the reach of the converters must be its share of the states' full scale");
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

#endif
