/* The core as a shared library: the fast reference that the emulated boards are compared with. */
#include "control.h"
#include "quadrature.h"

const char wq_hash[] = "wavequake-gains:" WQ_HASH;

uint32_t wq_host_size(void) { return sizeof(wq_control); }

void wq_host_reset(wq_control *control) { wq_control_reset(control); }

void wq_host_run(wq_control *control, const uint16_t *adc, const uint8_t *inputs, uint16_t *dac, uint32_t count) {
    for (uint32_t k = 0; k < count; k++) dac[k] = wq_control_step(control, adc[k], inputs[k]);
}

/* Follow pin states from the first one on; counts after each of them, and how many transitions were illegal. */
uint32_t wq_host_quadrature(const uint8_t *pins, int16_t *counts, uint32_t count) {
    wq_quadrature quadrature;
    wq_quadrature_reset(&quadrature, count ? pins[0] : 0);
    for (uint32_t k = 0; k < count; k++) {
        wq_quadrature_edge(&quadrature, pins[k]);
        counts[k] = quadrature.count;
    }
    return quadrature.illegal;
}

void wq_host_codes(const int16_t *counts, uint16_t *codes, uint16_t *words, uint32_t count) {
    for (uint32_t k = 0; k < count; k++) {
        codes[k] = wq_quadrature_code(counts[k]);
        words[k] = wq_mcp4911_word(codes[k]);
    }
}
