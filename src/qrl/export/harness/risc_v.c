/* The harness's platform on an RV32 under QEMU, whose loader fills all memory: semihosting, the counter of instructions,
   and a painted stack. */
#include "kernel_under_test.h"
#include "platform.h"

#include <string.h>

extern uint32_t kernel_stack[], kernel_stack_end[];

int main(void);
void fault(void) __attribute__((noreturn));

__asm__(".option arch, +zicsr\n"
        ".section .start, \"ax\"\n"
        ".globl reset\n"
        "reset:\n"
        "    la   sp, main_stack_end\n"
        "    la   t0, fault\n"
        "    csrw mtvec, t0\n"
        "    call main\n"
        "    j    fault\n"
        ".text\n");

enum { OPEN = 1, CLOSE = 2, WRITE0 = 4, WRITE = 5, READ = 6, EXIT_EXTENDED = 0x20, APPLICATION_EXIT = 0x20026 };

/* One request to QEMU, Arm's semihosting as RISC-V calls it: three instructions of four bytes, on one page. */
static int32_t semihost(int32_t request, const void *arguments)
{
    register int32_t a0 __asm__("a0") = request;
    register const void *a1 __asm__("a1") = arguments;
    __asm__ volatile(".balign 16\n"
                     ".option push\n"
                     ".option norvc\n"
                     "slli x0, x0, 0x1f\n"
                     "ebreak\n"
                     "srai x0, x0, 7\n"
                     ".option pop\n"
                     : "+r"(a0)
                     : "r"(a1)
                     : "memory");
    return a0;
}

intptr_t file_open(const char *name, int writing)
{
    uintptr_t arguments[3] = {(uintptr_t)name, writing ? 5 : 1, strlen(name)}; /* as fopen's "wb" and "rb" */
    return semihost(OPEN, arguments) + 1;                                      /* -1: failed; 0 is a valid handle */
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

__attribute__((aligned(4))) void fault(void)
{
    print_text("qrl-error: processor fault\n");
    finish(1);
}

/* timed(arguments, function, elapsed): the result of the function of three arguments, called on the kernel's stack
   between two reads of the counter of instructions. */
int timed(const void *const arguments[3], void (*function)(void), struct elapsed *elapsed);
__asm__("timed:\n"
        "    addi sp, sp, -16\n"
        "    sw   ra, 12(sp)\n"
        "    sw   s0, 8(sp)\n"
        "    sw   s1, 4(sp)\n"
        "    mv   s0, sp\n"
        "    mv   s1, a2\n"
        "    mv   t0, a1\n"
        "    lw   a1, 4(a0)\n"
        "    lw   a2, 8(a0)\n"
        "    lw   a0, 0(a0)\n"
        "    la   sp, kernel_stack_end\n"
        "    csrr t1, minstret\n"
        "    sw   t1, 0(s0)\n"
        "    jalr t0\n"
        "    csrr t0, minstret\n"
        "    mv   sp, s0\n"
        "    lw   t1, 0(sp)\n"
        "    sub  t0, t0, t1\n"
        "    sw   t0, 0(s1)\n"
        "    sw   zero, 4(s1)\n"
        "    lw   ra, 12(sp)\n"
        "    lw   s0, 8(sp)\n"
        "    lw   s1, 4(sp)\n"
        "    addi sp, sp, 16\n"
        "    ret\n");

/* known(rounds): 2 * rounds + 3 instructions. */
int known(uint32_t rounds);
__asm__("known:\n"
        "    nop\n"
        "    beqz a0, 2f\n"
        "1:  addi a0, a0, -1\n"
        "    bnez a0, 1b\n"
        "2:  ret\n");

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
    for (volatile uint32_t *word = kernel_stack; word != kernel_stack_end; word++) {
        *word = PAINT;
    }
}

int32_t stack_depth(void)
{
    const volatile uint32_t *word = kernel_stack;
    while (word != kernel_stack_end && *word == PAINT) {
        word++;
    }
    if (word == kernel_stack) {
        print_text("qrl-error: stack overflow: all of the stack was used\n");
        finish(1);
    }
    return (int32_t)((uintptr_t)kernel_stack_end - (uintptr_t)word);
}
