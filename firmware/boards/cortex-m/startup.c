/* Vectors and start of a Cortex-M3, without any vendor's code. */
#include <stdint.h>

#include "wq_gains.h"

extern uint32_t wq_stack_top[], wq_data_load[], wq_data_start[], wq_data_end[], wq_bss_start[], wq_bss_end[];

int main(void);
void wq_reset_handler(void);

/* What images carry, so that a board is not flashed with another design. */
__attribute__((used, section(".hash"))) const char wq_hash[] = "wavequake-gains:" WQ_HASH;

void wq_reset_handler(void) {
    const volatile uint32_t *from = wq_data_load;
    for (volatile uint32_t *to = wq_data_start; to < (volatile uint32_t *)wq_data_end;) *to++ = *from++;
    for (volatile uint32_t *to = wq_bss_start; to < (volatile uint32_t *)wq_bss_end;) *to++ = 0;
    main();
    for (;;) {
    }
}

/* Nothing is interrupt-driven: every fault stops here, and the watchdog starts the board again. */
static void halted(void) {
    for (;;) {
    }
}

__attribute__((used, section(".vectors"))) void (*const wq_vectors[16])(void) = {
    (void (*)(void))wq_stack_top,
    wq_reset_handler,
    halted, halted, halted, halted, halted, 0, 0, 0, 0, halted, halted, 0, halted, halted,
};
