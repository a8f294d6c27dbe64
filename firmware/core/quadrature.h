/* Quadrature decoder of the Hall sensor, and the word for the converter that hands its count on. */
#ifndef WQ_QUADRATURE_H
#define WQ_QUADRATURE_H

#include <stdint.h>

typedef struct {
    int16_t count;    /* edges from rest, forward positive */
    uint16_t illegal; /* transitions of both pins at once: edges were lost */
    uint8_t pins;     /* last state, A in bit 1, B in bit 0 */
} wq_quadrature;

void wq_quadrature_reset(wq_quadrature *quadrature, uint8_t pins);

/* Follow the pins (A in bit 1, B in bit 0) after an edge; forward is 00, 10, 11, 01. */
static inline void wq_quadrature_edge(wq_quadrature *quadrature, uint8_t pins) {
    const uint8_t before = quadrature->pins;
    const uint8_t changed = before ^ pins;
    quadrature->pins = pins;
    if (changed == 0) return;
    if (changed == 3) {
        quadrature->illegal++;
        return;
    }
    /* A single step is forward if the new B equals the old A. */
    quadrature->count += ((pins ^ (before >> 1)) & 1) ? -1 : 1;
}

/* Return the 10-bit code of a count: rest is the middle, saturated. */
uint16_t wq_quadrature_code(int16_t count);

/* Return the word for an MCP4911: write, unbuffered, gain 1, active; ten bits of code. */
static inline uint16_t wq_mcp4911_word(uint16_t code) { return 0x3000u | (uint16_t)((code & 0x3ffu) << 2); }

#endif
