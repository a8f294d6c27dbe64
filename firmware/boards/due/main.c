/* Arduino Due: position at A0, command at DAC0, trigger at pin 33, switch at pin 34, "deadline missed" at pin 35.
 *
 * The loop polls its timer: nothing interrupts a step, so that each takes the same time. While it waits, it looks
 * for the trigger, too: a blow begins a step and starts the timer anew, so that it is not seen up to a step late.
 */
#include "control.h"
#include "sam3x.h"

#define PIN_TRIGGER (1u << 1)
#define PIN_SWITCH (1u << 2)
#define PIN_MISSED (1u << 3)
#define TICKS_PER_US 42u

/* The watchdog runs at 32768/128 Hz: a quarter of a second, or three steps where they are longer. */
#define WATCHDOG_TICKS (64u + 3u * WQ_SAMPLE_TIME_US / 3906u)
_Static_assert(WATCHDOG_TICKS < 4096u, "the watchdog counts 12 bits");
_Static_assert(WQ_ADC_TOP == 4095 && WQ_CODE_TOP == 4095, "the board's converters have 12 bits");

static void wait_for(uint32_t bit) {
    while (!(PMC_SR & bit)) {
    }
}

/* 12 MHz crystal, times 14, by 2: 84 MHz. */
static void start_clock(void) {
    EEFC0_FMR = EEFC_FMR_4_WAITS;
    EEFC1_FMR = EEFC_FMR_4_WAITS;
    PMC_MOR = PMC_MOR_KEY | PMC_MOR_START | PMC_MOR_RC | PMC_MOR_CRYSTAL;
    wait_for(PMC_SR_CRYSTAL);
    PMC_MOR = PMC_MOR_KEY | PMC_MOR_START | PMC_MOR_RC | PMC_MOR_CRYSTAL | PMC_MOR_SELECT;
    wait_for(PMC_SR_SELECTED);
    PMC_PLLAR = (1u << 29) | (13u << 16) | (0x3fu << 8) | 1u;
    wait_for(PMC_SR_PLL);
    PMC_MCKR = (1u << 4) | 1u;
    wait_for(PMC_SR_MASTER);
    PMC_MCKR = (1u << 4) | 2u;
    wait_for(PMC_SR_MASTER);
}

static void start_peripherals(void) {
    PMC_PCER0 = (1u << ID_PIOC) | (1u << ID_TC0);
    PMC_PCER1 = (1u << (ID_ADC - 32)) | (1u << (ID_DACC - 32));
    PIOC_PER = PIN_TRIGGER | PIN_SWITCH | PIN_MISSED;
    PIOC_ODR = PIN_TRIGGER | PIN_SWITCH;
    PIOC_PUDR = PIN_TRIGGER | PIN_SWITCH;
    PIOC_CODR = PIN_MISSED;
    PIOC_OER = PIN_MISSED;
    ADC_CR = ADC_CR_RESET;
    ADC_MR = ADC_MR_14_MHZ;
    ADC_CHER = 1u << 7;
    DACC_CR = 1u;
    DACC_MR = DACC_MR_CHANNEL_0;
    DACC_CHER = 1u;
    TC0_CMR = TC_CMR_UP_TO_RC;
    TC0_RC = TICKS_PER_US * WQ_SAMPLE_TIME_US;
    TC0_CCR = TC_CCR_ENABLE_AND_START;
}

static uint16_t position(void) {
    ADC_CR = ADC_CR_START;
    while (!(ADC_ISR & (1u << 7))) {
    }
    return (uint16_t)(ADC_CDR7 & 0xfffu);
}

/* The step that a trigger cuts short is one in which a bench at rest has nothing to lose. */
static void wait_for_step(const wq_control *control) {
    while (!(TC0_SR & TC_SR_RC)) {
        if (wq_control_armed(control) && (PIOC_PDSR & PIN_TRIGGER)) {
            TC0_CCR = TC_CCR_ENABLE_AND_START;
            return;
        }
    }
}

static uint8_t inputs(void) {
    const uint32_t pins = PIOC_PDSR;
    return (uint8_t)(((pins & PIN_SWITCH) ? WQ_ENABLED : 0u) | ((pins & PIN_TRIGGER) ? WQ_TRIGGER : 0u));
}

int main(void) {
    wq_control control;
    WDT_MR = WATCHDOG_TICKS | (WATCHDOG_TICKS << 16) | WDT_MR_RESET;
    start_clock();
    start_peripherals();
    wq_control_reset(&control);
    DACC_CDR = WQ_CODE_MIDDLE;
    for (;;) {
        wait_for_step(&control);
        for (;;) {
            const uint16_t code = wq_control_step(&control, position(), inputs());
            DACC_CDR = code;
            WDT_CR = WDT_CR_RESTART;
            /* Reading the status clears it: the next step is due already if it is set. */
            if (!(TC0_SR & TC_SR_RC)) break;
            PIOC_SODR = PIN_MISSED;
        }
        PIOC_CODR = PIN_MISSED;
    }
}
