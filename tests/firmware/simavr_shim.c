/* The Uno in simavr, for tests alone: pins of the sensor in, words of the converter and cycles of interrupts out. */
#include <simavr/avr_ioport.h>
#include <simavr/avr_spi.h>
#include <simavr/sim_avr.h>
#include <simavr/sim_elf.h>
#include <simavr/sim_interrupts.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

typedef struct {
    avr_t *avr;
    uint16_t *words;
    uint32_t capacity, count, bytes, longest;
    uint16_t word;
    avr_cycle_count_t entered;
} board;

static void selected(struct avr_irq_t *irq, uint32_t value, void *given) {
    (void)irq;
    board *b = given;
    if (value) {
        if (b->bytes == 2 && b->count < b->capacity) b->words[b->count++] = b->word;
    } else {
        b->bytes = 0;
        b->word = 0;
    }
}

static void sent(struct avr_irq_t *irq, uint32_t value, void *given) {
    (void)irq;
    board *b = given;
    b->word = (uint16_t)(b->word << 8 | (value & 0xff));
    b->bytes++;
}

static void interrupted(struct avr_irq_t *irq, uint32_t value, void *given) {
    (void)irq;
    board *b = given;
    if (value) {
        b->entered = b->avr->cycle;
    } else if (b->entered) {
        const uint32_t taken = (uint32_t)(b->avr->cycle - b->entered);
        if (taken > b->longest) b->longest = taken;
    }
}

board *uno_open(const char *path, uint16_t *words, uint32_t capacity) {
    elf_firmware_t firmware;
    memset(&firmware, 0, sizeof firmware);
    if (elf_read_firmware(path, &firmware)) return NULL;
    board *b = calloc(1, sizeof *b);
    b->words = words;
    b->capacity = capacity;
    b->avr = avr_make_mcu_by_name("atmega328p");
    avr_init(b->avr);
    avr_load_firmware(b->avr, &firmware);
    b->avr->frequency = 16000000;
    b->avr->log = 0;
    avr_irq_register_notify(avr_io_getirq(b->avr, AVR_IOCTL_SPI_GETIRQ(0), SPI_IRQ_OUTPUT), sent, b);
    avr_irq_register_notify(avr_io_getirq(b->avr, AVR_IOCTL_IOPORT_GETIRQ('B'), 2), selected, b);
    avr_irq_register_notify(avr_get_interrupt_irq(b->avr, AVR_INT_ANY) + AVR_INT_IRQ_RUNNING, interrupted, b);
    return b;
}

void uno_pins(board *b, uint32_t pins) {
    avr_raise_irq(avr_io_getirq(b->avr, AVR_IOCTL_IOPORT_GETIRQ('D'), 2), pins >> 1 & 1);
    avr_raise_irq(avr_io_getirq(b->avr, AVR_IOCTL_IOPORT_GETIRQ('D'), 3), pins & 1);
}

/* Return 0 if the board still runs. */
int uno_run(board *b, uint32_t cycles) {
    const avr_cycle_count_t end = b->avr->cycle + cycles;
    while (b->avr->cycle < end) {
        const int state = avr_run(b->avr);
        if (state == cpu_Done || state == cpu_Crashed) return 1;
    }
    return 0;
}

int uno_play(board *b, const uint8_t *pins, uint32_t count, uint32_t cycles) {
    for (uint32_t k = 0; k < count; k++) {
        uno_pins(b, pins[k]);
        if (uno_run(b, cycles)) return 1;
    }
    return 0;
}

uint32_t uno_words(board *b) { return b->count; }
uint32_t uno_longest(board *b) { return b->longest; }
