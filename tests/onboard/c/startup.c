/* Reset of an MPS2 AN386 (Cortex-M4F) for newlib with semihosting. */
#include <stdint.h>

extern void stack_top(void); /* an address of the linker script */
extern void _start(void);
void _init(void);
void _fini(void);

void _init(void)
{
}

void _fini(void)
{
}

void reset(void);
void reset(void)
{
    *(volatile uint32_t *)0xE000ED88u |= 0xFu << 20; /* the floating-point unit */
    __asm volatile("dsb\n isb");
    _start();
}

static void stop(void)
{
    for (;;) {
    }
}

__attribute__((section(".vectors"), used)) static void (*const vectors[16])(void) = {
    stack_top, reset, stop, stop, stop, stop, stop, 0, 0, 0, 0, stop, stop, 0, stop, stop,
};
