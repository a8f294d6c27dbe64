#include "quadrature.h"

#include "wq_gains.h"

/* Counts beyond are far outside the converter's reach; products fit 32 bits. */
#define LARGEST 8191

_Static_assert(WQ_EDGE_SLOPE > 0 && WQ_EDGE_SLOPE <= 0x3fffffff / LARGEST, "the count's product must fit 32 bits");

/* Steps of the converter per edge, edge / (2 reach / top) in Q16, rounded: from lengths in pm. */
#define REACH_PM (1000LL * WQ_REACH_NM)
#define OFF_SLOPE (2 * REACH_PM * WQ_EDGE_SLOPE - 65536 * WQ_EDGE_PM * WQ_EDGE_TOP)
_Static_assert(OFF_SLOPE <= REACH_PM + REACH_PM / 64 && OFF_SLOPE >= -REACH_PM - REACH_PM / 64,
               "the slope of the decoder must be that of its edge and reach");
_Static_assert(WQ_EDGE_MIDDLE == (WQ_EDGE_TOP + 1) / 2, "the decoder's rest must be its converter's middle");

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
