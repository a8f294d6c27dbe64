/* Arithmetic in float: states in m, command in steps of the converter. */
#ifndef WQ_ARITHMETIC_H
#define WQ_ARITHMETIC_H

#include <stdint.h>

#include "wq_gains.h"

typedef float wq_number;
typedef float wq_coefficient;
typedef float wq_expectation;
typedef float wq_command;
typedef struct { float step_re, step_im, gain_re, gain_im, row_re, row_im; } wq_coefficients;
typedef struct { float re, im; } wq_start;

static inline float wq_limited(float x) {
    return x > WQ_STATE_FULL ? WQ_STATE_FULL : x < -WQ_STATE_FULL ? -WQ_STATE_FULL : x;
}

static inline float wq_added(float z, float start) { return wq_limited(z + start); }

static inline float wq_summed(float sum, float re) { return sum + re; }

static inline float wq_error(int16_t reading, float expected) {
    return wq_limited((float)reading * WQ_READING - expected);
}

static inline float wq_corrected(float z, float gain, float error) { return wq_limited(z + gain * error); }

static inline float wq_commanded(float sum, float row_re, float re, float row_im, float im) {
    return sum + (row_re * re + row_im * im);
}

static inline float wq_turned(float z, float a, float re, float b, float im) {
    return wq_limited(z + (a * re + b * im));
}

static inline uint16_t wq_code(float command) {
    const float code = command + (float)WQ_CODE_MIDDLE;
    if (code < 0.0f) return 0;
    return code > (float)WQ_CODE_TOP ? WQ_CODE_TOP : (uint16_t)code;
}

#endif
