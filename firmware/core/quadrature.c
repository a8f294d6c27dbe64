#include "quadrature.h"

#include "wq_gains.h"

/* Counts beyond are far outside the converter's reach; products fit 32 bits. */
#define LARGEST 8191

_Static_assert(WQ_EDGE_SLOPE > 0 && WQ_EDGE_SLOPE <= 0x3fffffff / LARGEST, "the count's product must fit 32 bits");

void wq_quadrature_reset(wq_quadrature *quadrature, uint8_t pins) {
    quadrature->count = 0;
    quadrature->illegal = 0;
    quadrature->pins = pins;
}

uint16_t wq_quadrature_code(int16_t count) {
    if (count > LARGEST) count = LARGEST;
    if (count < -LARGEST) count = -LARGEST;
    const int32_t code = (count * (int32_t)WQ_EDGE_SLOPE + ((int32_t)WQ_EDGE_MIDDLE << 16)) >> 16;
    if (code < 0) return 0;
    return code > WQ_EDGE_TOP ? WQ_EDGE_TOP : (uint16_t)code;
}
