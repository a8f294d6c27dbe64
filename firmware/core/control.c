#include "control.h"

#define COEFFICIENTS(...) {__VA_ARGS__},
static const wq_coefficients modes[WQ_MODES] = {WQ_MODE_LIST(COEFFICIENTS)};

#define START(re, im) {re, im},
static const wq_start starts[WQ_STARTS * WQ_MODES] = {WQ_START_LIST(START)};

#define COUNTED(...) +1
_Static_assert((0 WQ_MODE_LIST(COUNTED)) == WQ_MODES, "the header must list as many modes as it says");
_Static_assert((0 WQ_START_LIST(COUNTED)) == WQ_STARTS * WQ_MODES && WQ_STARTS < 255,
               "the header must list a start of each mode for each of the blow's steps");
_Static_assert(sizeof(WQ_HASH) == 17, "the hash of the design has 16 digits");
_Static_assert(WQ_CODE_TOP == (1L << WQ_CODE_BITS) - 1 && WQ_CODE_MIDDLE == 1L << (WQ_CODE_BITS - 1),
               "the command's codes must be those of its converter's bits");
_Static_assert(WQ_ADC_TOP > 0 && WQ_ADC_TOP <= 8191, "twice a code of the position must fit 16 bits");

void wq_control_reset(wq_control *control) {
    for (uint8_t j = 0; j < WQ_MODES; j++) {
        control->re[j] = 0;
        control->im[j] = 0;
    }
    control->next_start = WQ_STARTS;
    control->triggered = 0;
}

/* A blow counts if the trigger was low before and the last blow's start is over: it arms itself again. */
static void add_start(wq_control *control, uint8_t inputs) {
    const uint8_t triggered = (inputs & WQ_TRIGGER) != 0;
    if (triggered && wq_control_armed(control)) control->next_start = 0;
    control->triggered = triggered;
    if (control->next_start == WQ_STARTS) return;
    const wq_start *start = &starts[control->next_start * WQ_MODES];
    for (uint8_t j = 0; j < WQ_MODES; j++) {
        control->re[j] = wq_added(control->re[j], start[j].re);
        control->im[j] = wq_added(control->im[j], start[j].im);
    }
    control->next_start++;
}

uint16_t wq_control_step(wq_control *control, uint16_t adc, uint8_t inputs) {
    add_start(control, inputs);
    wq_expectation expected = 0;
    for (uint8_t j = 0; j < WQ_MODES; j++) expected = wq_summed(expected, control->re[j]);
    if (adc > WQ_ADC_TOP) adc = WQ_ADC_TOP;
    const wq_number error = wq_error((int16_t)(2 * (int16_t)adc - WQ_ADC_TOP), expected);
    wq_command command = 0;
    for (uint8_t j = 0; j < WQ_MODES; j++) {
        const wq_coefficients *c = &modes[j];
        const wq_number re = wq_corrected(control->re[j], c->gain_re, error);
        const wq_number im = wq_corrected(control->im[j], c->gain_im, error);
        command = wq_commanded(command, c->row_re, re, c->row_im, im);
        control->re[j] = wq_turned(re, c->step_re, re, (wq_coefficient)-c->step_im, im);
        control->im[j] = wq_turned(im, c->step_im, re, c->step_re, im);
    }
    return (inputs & WQ_ENABLED) ? wq_code(command) : (uint16_t)WQ_CODE_MIDDLE;
}
