/* The example on Arm's MPS2 board with the AN386 image (Cortex-M4F), as QEMU emulates it: start-up, UART, and the end of
   the run by semihosting. Source: Arm AN386, memory map; CMSDK UART; Arm semihosting specification, SYS_EXIT. */
#include "../control.h"

/* Put there by the emulator's loader, or flashed. */
#define POLICY_ADDRESS 0x00200000u
#define POLICY_ROOM 0x00200000u
#define OBSERVATIONS_ADDRESS 0x21000000u

#define REGISTER(address) (*(volatile uint32_t *)(address))
#define UART_DATA REGISTER(0x40004000u)
#define UART_STATE REGISTER(0x40004004u)
#define UART_CONTROL REGISTER(0x40004008u)
#define UART_DIVISOR REGISTER(0x40004010u)
#define CPACR REGISTER(0xE000ED88u)

extern uint32_t stack_top[], data_start[], data_end[], data_load[], bss_start[], bss_end[];

void board_put(char c) {
    while ((UART_STATE & 1u) != 0u) {
    }
    UART_DATA = (uint32_t)(unsigned char)c;
}

static void finish(int failed) {
    register uint32_t call __asm__("r0") = 0x18u;                        /* SYS_EXIT */
    register uint32_t why __asm__("r1") = failed ? 0x20023u : 0x20026u; /* run-time error, or the program's own end */
    __asm__ volatile("bkpt 0xAB" : "+r"(call) : "r"(why) : "memory");
    for (;;) {
    }
}

static void run(void) {
    const uint32_t *head = (const uint32_t *)OBSERVATIONS_ADDRESS;
    const float *floats = (const float *)(const void *)(head + 3);
    UART_DIVISOR = 16u;
    UART_CONTROL = 1u;
    if (control_start((const uint8_t *)POLICY_ADDRESS, POLICY_ROOM) != GADM_STATUS_OK) {
        finish(1);
    }
    control_run(floats, head[0], (const int16_t *)(const void *)(floats + (size_t)head[0] * head[2]), head[1]);
    finish(0);
}

void reset(void) {
    CPACR |= 0xFu << 20; /* floating-point unit on */
    __asm__ volatile("dsb\n isb" ::: "memory");
    for (uint32_t *to = data_start, *from = data_load; to < data_end; to++, from++) {
        *to = *from;
    }
    for (uint32_t *to = bss_start; to < bss_end; to++) {
        *to = 0u;
    }
    run();
}

static void fault(void) {
    finish(1);
}

typedef void (*handler)(void);

__attribute__((section(".vectors"), used)) static const struct {
    uint32_t *stack;
    handler handlers[15];
} vectors = {stack_top, {reset, fault, fault, fault, fault, fault, 0, 0, 0, 0, fault, fault, 0, fault, fault}};
