/* The Uno in simavr: pins of the sensor in, words of the converter and cycles of interrupts out; or, with the
 * board "simavr", steps of the regulator. Compiled where it is used, against the simavr that is installed there.
 */
#include <simavr/avr_ioport.h>
#include <simavr/avr_spi.h>
#include <simavr/sim_avr.h>
#include <simavr/sim_interrupts.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

/* Addresses of GPIOR0 to 2 in the data memory, and what the image takes as "go". */
enum { INPUTS = 0x3e, LOW = 0x4a, HIGH = 0x4b, GO = 4 };
/* A step that takes longer hangs: the time of ten samples. */
enum { PATIENCE = 320000 };

typedef struct {
    avr_t *avr;
    uint16_t *words;
    uint32_t capacity, count, bytes, longest, instructions, until_selected;
    uint16_t word;
    avr_cycle_count_t entered;
} board;

static void selected(struct avr_irq_t *irq, uint32_t value, void *given) {
    (void)irq;
    board *b = given;
    if (value) {
        if (b->bytes == 2 && b->count < b->capacity) b->words[b->count++] = b->word;
    } else {
        if (!b->until_selected) b->until_selected = b->instructions;
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

board *uno_open(uint8_t *code, uint32_t size, uint16_t *words, uint32_t capacity) {
    board *b = calloc(1, sizeof *b);
    avr_t *avr = avr_make_mcu_by_name("atmega328p");
    if (!b || !avr) return NULL;
    b->avr = avr;
    b->words = words;
    b->capacity = capacity;
    avr_init(avr);
    avr->frequency = 16000000;
    avr->log = 0;
    avr_loadcode(avr, code, size, 0);
    avr->codeend = size;
    avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_SPI_GETIRQ(0), SPI_IRQ_OUTPUT), sent, b);
    avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_IOPORT_GETIRQ('B'), 2), selected, b);
    avr_irq_register_notify(avr_get_interrupt_irq(avr, AVR_INT_ANY) + AVR_INT_IRQ_RUNNING, interrupted, b);
    return b;
}

void uno_close(board *b) {
    avr_terminate(b->avr);
    free(b->avr);
    free(b);
}

static int advanced(board *b) {
    const int state = avr_run(b->avr);
    b->instructions++;
    return state != cpu_Done && state != cpu_Crashed;
}

/* Return 0 if the board still runs. */
int uno_run(board *b, uint32_t cycles) {
    const avr_cycle_count_t end = b->avr->cycle + cycles;
    while (b->avr->cycle < end) {
        if (!advanced(b)) return 1;
    }
    return 0;
}

int uno_play(board *b, const uint8_t *pins, uint32_t count, uint32_t cycles) {
    for (uint32_t k = 0; k < count; k++) {
        avr_raise_irq(avr_io_getirq(b->avr, AVR_IOCTL_IOPORT_GETIRQ('D'), 2), pins[k] >> 1 & 1);
        avr_raise_irq(avr_io_getirq(b->avr, AVR_IOCTL_IOPORT_GETIRQ('D'), 3), pins[k] & 1);
        if (uno_run(b, cycles)) return 1;
    }
    return 0;
}

/* Run a step of the board "simavr": return 0, its command, cycles, and instructions until it is handed over. */
int uno_step(board *b, uint16_t adc, uint8_t inputs, uint16_t *command, uint16_t *cycles, uint32_t *instructions) {
    const avr_cycle_count_t end = b->avr->cycle + PATIENCE;
    b->count = b->instructions = b->until_selected = 0;
    b->avr->data[LOW] = (uint8_t)adc;
    b->avr->data[HIGH] = (uint8_t)(adc >> 8);
    b->avr->data[INPUTS] = (uint8_t)(inputs | GO);
    while (b->count < 2) {
        if (!advanced(b) || b->avr->cycle > end) return 1;
    }
    *command = b->words[0];
    *cycles = b->words[1];
    *instructions = b->until_selected;
    return 0;
}

uint32_t uno_words(board *b) { return b->count; }
uint32_t uno_longest(board *b) { return b->longest; }
