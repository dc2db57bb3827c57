/* An RV32 under QEMU, whose loader fills all memory: start-up, semihosting and the counter of instructions. */
#include "core.h"

__asm__(".option arch, +zicsr\n"
        ".section .start, \"ax\"\n"
        ".globl reset\n"
        "reset:\n"
        "    la   sp, main_stack_end\n"
        "    la   t0, fault\n"
        "    csrw mtvec, t0\n"
        "    call main\n"
        "    j    fault\n"
        ".section .rodata\n"
        ".balign 4\n"
        ".globl kernel_stack_bounds\n"
        "kernel_stack_bounds: .word kernel_stack, kernel_stack_end\n"
        ".text\n");

/* As RISC-V calls it: three instructions of four bytes, on one page. */
int32_t semihost(int32_t request, const void *arguments)
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

/* timed: a call between two reads of the counter of instructions. */
__asm__(".globl timed, known\n"
        "timed:\n"
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

__asm__("known:\n"
        "    nop\n"
        "    beqz a0, 2f\n"
        "1:  addi a0, a0, -1\n"
        "    bnez a0, 1b\n"
        "2:  ret\n");
