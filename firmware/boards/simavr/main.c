/* The regulator on simavr's ATmega328P in lock step: inputs (bit 2: go) and code of the position in the general
 * purpose registers; command, and the cycles that its step took, as two words by SPI.
 */
#include <avr/io.h>

#include "control.h"

#define GO 4u

const char wq_hash[] __attribute__((used, section(".progmem.hash"))) = "wavequake-gains:" WQ_HASH;

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
    wq_control control;
    DDRB = _BV(PB2) | _BV(PB3) | _BV(PB5);
    PORTB |= _BV(PB2);
    SPCR = _BV(SPE) | _BV(MSTR);
    TCCR1B = _BV(CS10);
    wq_control_reset(&control);
    for (;;) {
        while (!(GPIOR0 & GO)) {
        }
        const uint8_t inputs = GPIOR0 & (uint8_t)~GO;
        const uint16_t adc = (uint16_t)(GPIOR1 | GPIOR2 << 8);
        GPIOR0 = 0;
        TCNT1 = 0;
        const uint16_t code = wq_control_step(&control, adc, inputs);
        const uint16_t cycles = TCNT1;
        send(code);
        send(cycles);
    }
}
