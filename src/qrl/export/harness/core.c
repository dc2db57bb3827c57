/* What the harness's platform has in common on all cores under QEMU: requests by semihosting, calls of the kernel, a painted
   stack. cortex_m.c and risc_v.c have the rest. */
#include "core.h"

#include "kernel_under_test.h"

enum { OPEN = 1, CLOSE = 2, WRITE0 = 4, WRITE = 5, READ = 6, EXIT_EXTENDED = 0x20, APPLICATION_EXIT = 0x20026 };

intptr_t file_open(const char *name, int writing)
{
    uintptr_t length = 0;
    while (name[length] != 0) {
        length++;
    }
    uintptr_t arguments[3] = {(uintptr_t)name, writing ? 5 : 1, length}; /* as fopen's "wb" and "rb" */
    return semihost(OPEN, arguments) + 1;                                /* -1: failed; 0 is a valid handle */
}

uint32_t file_read(intptr_t file, void *into, uint32_t bytes)
{
    uintptr_t arguments[3] = {(uintptr_t)(file - 1), (uintptr_t)into, bytes};
    return bytes - (uint32_t)semihost(READ, arguments);
}

uint32_t file_write(intptr_t file, const void *from, uint32_t bytes)
{
    uintptr_t arguments[3] = {(uintptr_t)(file - 1), (uintptr_t)from, bytes};
    return bytes - (uint32_t)semihost(WRITE, arguments);
}

int file_close(intptr_t file)
{
    uintptr_t argument = (uintptr_t)(file - 1);
    return (int)semihost(CLOSE, &argument);
}

void print_text(const char *text) { semihost(WRITE0, text); }

void finish(int code)
{
    uintptr_t arguments[2] = {APPLICATION_EXIT, (uintptr_t)code};
    for (;;) {
        semihost(EXIT_EXTENDED, arguments);
    }
}

__attribute__((aligned(4))) void fault(void) /* aligned as RISC-V wants a trap's */
{
    print_text("qrl-error: processor fault\n");
    finish(1);
}

int call(enum entry entry, void *state, const void *obs, void *act, struct elapsed *elapsed)
{
    static void (*const functions[])(void) = {
        [STEP] = (void (*)(void))kernel_step,
        [STEP_I16] = (void (*)(void))kernel_step_i16,
        [SELFTEST] = (void (*)(void))kernel_selftest,
        [KNOWN] = (void (*)(void))known,
    };
    const void *const arguments[3] = {state, obs, act};
    return timed(arguments, functions[entry], elapsed);
}

#define PAINT 0xC5A5A5C5u

void stack_paint(void)
{
    for (volatile uint32_t *word = kernel_stack_bounds.first; word != kernel_stack_bounds.end; word++) {
        *word = PAINT;
    }
}

int32_t stack_depth(void)
{
    const volatile uint32_t *word = kernel_stack_bounds.first;
    while (word != kernel_stack_bounds.end && *word == PAINT) {
        word++;
    }
    if (word == kernel_stack_bounds.first) {
        print_text("qrl-error: stack overflow: all of the stack was used\n");
        finish(1);
    }
    return (int32_t)((uintptr_t)kernel_stack_bounds.end - (uintptr_t)word);
}
