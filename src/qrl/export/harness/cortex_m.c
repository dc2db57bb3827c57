/* The harness's platform on a Cortex-M under QEMU: start-up, semihosting, the tick counter and a painted stack. */
#include "kernel_under_test.h"
#include "platform.h"

/* Addresses from the linker, in a table: compilers assume that different symbols have different addresses. */
extern struct {
    uint32_t *data, *data_end, *data_image, *bss, *bss_end, *stack, *stack_end;
} const layout;

int main(void);
void reset(void) __attribute__((noreturn));
void fault(void) __attribute__((noreturn));

__asm__(".section .vectors, \"a\"\n"
        ".word main_stack_end\n"
        ".word reset\n"
        ".rept 14\n"
        ".word fault\n"
        ".endr\n"
        "layout: .word data_start, data_end, data_image, bss_start, bss_end, kernel_stack, kernel_stack_end\n"
        ".text\n");

enum { OPEN = 1, CLOSE = 2, WRITE0 = 4, WRITE = 5, READ = 6, EXIT_EXTENDED = 0x20, APPLICATION_EXIT = 0x20026 };

/* One request to QEMU, Arm's semihosting; `arguments` are words in the order of Arm's specification. */
static int32_t semihost(int32_t request, const void *arguments)
{
    register int32_t r0 __asm__("r0") = request;
    register const void *r1 __asm__("r1") = arguments;
    __asm__ volatile("bkpt 0xAB" : "+r"(r0) : "r"(r1) : "memory");
    return r0;
}

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

void fault(void)
{
    print_text("qrl-error: processor fault\n");
    finish(1);
}

/* timed(arguments, function, elapsed): the result of the function of three arguments. Waits for an edge of SysTick,
   calls the function on the kernel's stack, and counts rounds of four instructions until the next edge. */
int timed(const void *const arguments[3], void (*function)(void), struct elapsed *elapsed);
__asm__(".syntax unified\n"
        ".thumb_func\n"
        "timed:\n"
        "    push {r4-r7, lr}\n"
        "    mov  r4, sp\n"
        "    mov  r5, r2\n"
        "    mov  r12, r1\n"
        "    ldr  r1, [r0, #4]\n"
        "    ldr  r2, [r0, #8]\n"
        "    ldr  r0, [r0]\n"
        "    ldr  r6, =0xE000E018\n" /* SysTick's current value, 24 bits, counting down */
        "    ldr  r3, [r6]\n"
        "1:  ldr  r7, [r6]\n"
        "    cmp  r7, r3\n"
        "    beq  1b\n"
        "    ldr  r3, =kernel_stack_end\n"
        "    mov  sp, r3\n"
        "    blx  r12\n"
        "    mov  sp, r4\n"
        "    ldr  r1, [r6]\n"
        "    movs r2, #0\n"
        "2:  adds r2, #1\n"
        "    ldr  r3, [r6]\n"
        "    cmp  r3, r1\n"
        "    beq  2b\n"
        "    subs r7, r7, r3\n"
        "    lsls r7, r7, #8\n"
        "    lsrs r7, r7, #8\n"
        "    str  r7, [r5]\n"
        "    str  r2, [r5, #4]\n"
        "    pop  {r4-r7, pc}\n"
        "    .pool\n");

/* known(rounds): 2 * rounds + 3 instructions. */
int known(uint32_t rounds);
__asm__(".thumb_func\n"
        "known:\n"
        "    cmp  r0, #0\n"
        "    beq  2f\n"
        "1:  subs r0, #1\n"
        "    bne  1b\n"
        "2:  bx   lr\n");

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
    for (volatile uint32_t *word = layout.stack; word != layout.stack_end; word++) {
        *word = PAINT;
    }
}

int32_t stack_depth(void)
{
    const volatile uint32_t *word = layout.stack;
    while (word != layout.stack_end && *word == PAINT) {
        word++;
    }
    if (word == layout.stack) {
        print_text("qrl-error: stack overflow: all of the stack was used\n");
        finish(1);
    }
    return (int32_t)((uintptr_t)layout.stack_end - (uintptr_t)word);
}

void reset(void)
{
    volatile uint32_t *const systick = (volatile uint32_t *)0xE000E010u; /* control, reload, current */
#ifdef __ARM_FP
    *(volatile uint32_t *)0xE000ED88u |= 0xFu << 20; /* CPACR: enable the FPU */
    __asm__ volatile("dsb\n isb");
#endif
    for (uint32_t *to = layout.data, *from = layout.data_image; to != layout.data_end;) {
        *to++ = *from++;
    }
    for (uint32_t *to = layout.bss; to != layout.bss_end;) {
        *to++ = 0;
    }
    systick[1] = 0xFFFFFFu;
    systick[2] = 0;
    systick[0] = 5; /* on, from the processor's clock, no interrupt */
    main();
    fault();
}
