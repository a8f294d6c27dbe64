/* The registers of the SAM3X8E that the firmware uses, by hand (data sheet Atmel-11057). */
#ifndef SAM3X_H
#define SAM3X_H

#include <stdint.h>

#define REGISTER(address) (*(volatile uint32_t *)(address))

#define EEFC0_FMR REGISTER(0x400E0A00)
#define EEFC1_FMR REGISTER(0x400E0C00)
#define EEFC_FMR_4_WAITS (4u << 8)

#define WDT_CR REGISTER(0x400E1A50)
#define WDT_MR REGISTER(0x400E1A54)
#define WDT_CR_RESTART (0xA5000001u)
#define WDT_MR_RESET (1u << 13)

#define PMC_PCER0 REGISTER(0x400E0610)
#define PMC_MOR REGISTER(0x400E0620)
#define PMC_PLLAR REGISTER(0x400E0628)
#define PMC_MCKR REGISTER(0x400E0630)
#define PMC_SR REGISTER(0x400E0668)
#define PMC_PCER1 REGISTER(0x400E0700)
#define PMC_MOR_KEY (0x37u << 16)
#define PMC_MOR_CRYSTAL (1u << 0)
#define PMC_MOR_RC (1u << 3)
#define PMC_MOR_START (8u << 8)
#define PMC_MOR_SELECT (1u << 24)
#define PMC_SR_CRYSTAL (1u << 0)
#define PMC_SR_PLL (1u << 1)
#define PMC_SR_MASTER (1u << 3)
#define PMC_SR_SELECTED (1u << 16)

#define PIOC_PER REGISTER(0x400E1200)
#define PIOC_OER REGISTER(0x400E1210)
#define PIOC_ODR REGISTER(0x400E1214)
#define PIOC_SODR REGISTER(0x400E1230)
#define PIOC_CODR REGISTER(0x400E1234)
#define PIOC_PDSR REGISTER(0x400E123C)
#define PIOC_PUDR REGISTER(0x400E1260)

#define TC0_CCR REGISTER(0x40080000)
#define TC0_CMR REGISTER(0x40080004)
#define TC0_RC REGISTER(0x4008001C)
#define TC0_SR REGISTER(0x40080020)
#define TC_CCR_ENABLE_AND_START 5u
#define TC_CMR_UP_TO_RC ((1u << 15) | (2u << 13)) /* clock: half the master clock */
#define TC_SR_RC (1u << 4)

#define ADC_CR REGISTER(0x400C0000)
#define ADC_MR REGISTER(0x400C0004)
#define ADC_CHER REGISTER(0x400C0010)
#define ADC_ISR REGISTER(0x400C0030)
#define ADC_CDR7 REGISTER(0x400C006C)
#define ADC_CR_RESET 1u
#define ADC_CR_START 2u
#define ADC_MR_14_MHZ ((2u << 8) | (8u << 16) | (1u << 28))

#define DACC_CR REGISTER(0x400C8000)
#define DACC_MR REGISTER(0x400C8004)
#define DACC_CHER REGISTER(0x400C8010)
#define DACC_CDR REGISTER(0x400C8020)
#define DACC_ISR REGISTER(0x400C8030)
#define DACC_MR_CHANNEL_0 ((1u << 8) | (8u << 24))

#define ID_PIOC 13
#define ID_TC0 27
#define ID_ADC 37
#define ID_DACC 38

#endif
