/* What each family of cores implements for core.c. */
#ifndef CORE_H
#define CORE_H

#include "platform.h"

/* One request to QEMU, Arm's semihosting; `arguments` are words in the order of Arm's specification. */
int32_t semihost(int32_t request, const void *arguments);

/* The result of the function of three arguments, called on the kernel's stack, and its duration. */
int timed(const void *const arguments[3], void (*function)(void), struct elapsed *elapsed);

int known(uint32_t rounds); /* 2 * rounds + 3 instructions */

/* Of the kernel's stack, in a table: compilers assume that different symbols have different addresses. */
extern struct {
    uint32_t *first, *end;
} const kernel_stack_bounds;

void fault(void) __attribute__((noreturn)); /* where the processor goes on an error */
int main(void);

#endif
