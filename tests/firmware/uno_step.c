/* The 16-bit regulator on an ATmega328P, for tests alone: by SPI, each step's command and the cycles it took. */
#include <avr/io.h>

#include "control.h"

const char wq_hash[] __attribute__((used)) = "wavequake-gains:" WQ_HASH;

static void send(uint16_t word) {
    PORTB &= (uint8_t)~_BV(PB2);
    for (uint8_t half = 0; half < 2; half++) {
        SPDR = (uint8_t)(half ? word : word >> 8);
        while (!(SPSR & _BV(SPIF))) {
        }
        (void)SPDR;
    }
    PORTB |= _BV(PB2);
}

int main(void) {
    static wq_control control;
    uint16_t noise = 1;
    DDRB = _BV(PB2) | _BV(PB3) | _BV(PB5);
    PORTB |= _BV(PB2);
    SPCR = _BV(SPE) | _BV(MSTR);
    TCCR1B = _BV(CS10);
    wq_control_reset(&control);
    for (uint8_t k = 0;; k++) {
        noise = (uint16_t)(noise * 25173u + 13849u);
        TCNT1 = 0;
        const uint16_t code = wq_control_step(&control, 1536 + (noise >> 6), k == 0 ? 3 : 1);
        const uint16_t cycles = TCNT1;
        send(code);
        send(cycles);
    }
}
