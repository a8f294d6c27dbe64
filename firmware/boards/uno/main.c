/* Arduino Uno: decodes the Hall sensor's quadrature at pins 2 and 3 and hands its count to an MCP4911 by SPI
 * (select at pin 10). Registers by their names in avr-libc, which knows the chip's addresses and vectors.
 */
#include <avr/interrupt.h>
#include <avr/io.h>

#include "control.h"
#include "quadrature.h"

const char wq_hash[] __attribute__((used, section(".progmem.hash"))) = "wavequake-gains:" WQ_HASH;

/* Of the interrupt, which cannot be handed a pointer; the core itself has no globals. */
static wq_quadrature position;

/* Pins 2 (A) and 3 (B) are bits 2 and 3 of port D. */
static uint8_t pins(void) { return (uint8_t)((PIND >> 1 & 2u) | (PIND >> 3 & 1u)); }

ISR(INT0_vect) { wq_quadrature_edge(&position, pins()); }
ISR(INT1_vect, ISR_ALIASOF(INT0_vect));

static uint8_t sent(uint8_t byte) {
    SPDR = byte;
    while (!(SPSR & _BV(SPIF))) {
    }
    return SPDR;
}

int main(void) {
    DDRB = _BV(PB2) | _BV(PB3) | _BV(PB5);
    PORTB |= _BV(PB2);
    SPCR = _BV(SPE) | _BV(MSTR);
    SPSR = _BV(SPI2X);
    EICRA = _BV(ISC00) | _BV(ISC10); /* any edge of either pin */
    EIMSK = _BV(INT0) | _BV(INT1);
    wq_quadrature_reset(&position, pins());
    sei();
    for (;;) {
        cli(); /* two bytes shall be of one count */
        const int16_t count = *(volatile int16_t *)&position.count;
        sei();
        const uint16_t word = wq_mcp4911_word(wq_quadrature_code(count));
        PORTB &= (uint8_t)~_BV(PB2);
        sent((uint8_t)(word >> 8));
        sent((uint8_t)word);
        PORTB |= _BV(PB2);
    }
}
