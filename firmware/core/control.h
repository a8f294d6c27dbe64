/* The modal regulator of the lens experiment: one step from a converter's code to a converter's code.
 *
 * C99 for freestanding targets: no libc, no globals. The arithmetic is that of the generated gains, which define
 * one of WQ_FLOAT, WQ_Q31 and WQ_Q16; the step is the same text for all three.
 */
#ifndef WQ_CONTROL_H
#define WQ_CONTROL_H

#include <stdint.h>

#include "wq_gains.h"

#if defined(WQ_FLOAT)
#include "arithmetic_float.h"
#elif defined(WQ_Q31)
#include "arithmetic_q31.h"
#elif defined(WQ_Q16)
#include "arithmetic_q16.h"
#else
#error "wq_gains.h must define WQ_FLOAT, WQ_Q31 or WQ_Q16"
#endif

/* Bits of `inputs`. */
#define WQ_ENABLED 1u /* the switch: without it the observer goes on, and the output is that of no command */
#define WQ_TRIGGER 2u /* the hammer has begun to hit */

typedef struct {
    wq_number re[WQ_MODES];
    wq_number im[WQ_MODES];
    uint8_t next_start; /* row of the start table that comes next, WQ_STARTS: none */
    uint8_t triggered;  /* trigger of the step before: a blow is its rising edge */
} wq_control;

void wq_control_reset(wq_control *control);

/* Whether a trigger would count: it was low in the step before, and the last blow's start is over. */
static inline uint8_t wq_control_armed(const wq_control *control) {
    return !control->triggered && control->next_start == WQ_STARTS;
}

/* Take a code of the position's converter, return one for the command's converter. */
uint16_t wq_control_step(wq_control *control, uint16_t adc, uint8_t inputs);

#endif
