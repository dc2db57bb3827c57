/* A Cortex-M under QEMU: start-up, semihosting and the tick counter. */
#include "core.h"

/* Addresses from the linker, in a table: compilers assume that different symbols have different addresses. */
extern struct {
    uint32_t *data, *data_end, *data_image, *bss, *bss_end;
} const layout;

void reset(void) __attribute__((noreturn));

__asm__(".section .vectors, \"a\"\n"
        ".word main_stack_end\n"
        ".word reset\n"
        ".rept 14\n"
        ".word fault\n"
        ".endr\n"
        "layout: .word data_start, data_end, data_image, bss_start, bss_end\n"
        ".globl kernel_stack_bounds\n"
        "kernel_stack_bounds: .word kernel_stack, kernel_stack_end\n"
        ".text\n");

int32_t semihost(int32_t request, const void *arguments)
{
    register int32_t r0 __asm__("r0") = request;
    register const void *r1 __asm__("r1") = arguments;
    __asm__ volatile("bkpt 0xAB" : "+r"(r0) : "r"(r1) : "memory");
    return r0;
}

/* timed: waits for an edge of SysTick, calls the function, and counts rounds of four instructions until the next edge. */
__asm__(".syntax unified\n"
        ".globl timed, known\n"
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

__asm__(".thumb_func\n"
        "known:\n"
        "    cmp  r0, #0\n"
        "    beq  2f\n"
        "1:  subs r0, #1\n"
        "    bne  1b\n"
        "2:  bx   lr\n");

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
