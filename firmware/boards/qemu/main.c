/* QEMU's mps2-an385, in lock step by its first UART: code (2 bytes) and inputs in; command (2 bytes) and the
 * SysTick counts that the step took (3 bytes) out, low bytes first. Under -icount, counts are instructions.
 */
#include "control.h"

#define REGISTER(address) (*(volatile uint32_t *)(address))
#define UART_DATA REGISTER(0x40004000)
#define UART_STATE REGISTER(0x40004004)
#define UART_CTRL REGISTER(0x40004008)
#define UART_BAUDDIV REGISTER(0x40004010)
#define SYST_CSR REGISTER(0xE000E010)
#define SYST_RVR REGISTER(0xE000E014)
#define SYST_CVR REGISTER(0xE000E018)

static uint8_t received(void) {
    while (!(UART_STATE & 2u)) {
    }
    return (uint8_t)UART_DATA;
}

static void send(uint32_t value, uint8_t bytes) {
    for (; bytes; bytes--, value >>= 8) {
        while (UART_STATE & 1u) {
        }
        UART_DATA = value & 0xffu;
    }
}

int main(void) {
    wq_control control;
    UART_BAUDDIV = 16;
    UART_CTRL = 3;
    SYST_RVR = 0xffffff;
    SYST_CVR = 0;
    SYST_CSR = 5;
    wq_control_reset(&control);
    for (;;) {
        const uint8_t low = received(), high = received(), inputs = received();
        const uint32_t before = SYST_CVR;
        const uint16_t code = wq_control_step(&control, (uint16_t)(low | high << 8), inputs);
        const uint32_t taken = (before - SYST_CVR) & 0xffffffu;
        send(code, 2);
        send(taken, 3);
    }
}
