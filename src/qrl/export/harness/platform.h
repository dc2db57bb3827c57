/* The harness's platform: files, text output, and measured calls.
   Implemented by host.c for a workstation, by core.c, with cortex_m.c or risc_v.c, for cores under QEMU. */
#ifndef PLATFORM_H
#define PLATFORM_H

#include <stdint.h>

/* Duration of a call by a tick counter. On a host both are 0. */
struct elapsed {
    int32_t ticks; /* between two edges of the counter around the call */
    int32_t spins; /* rounds of four instructions from the call's end to the second edge */
};

intptr_t file_open(const char *name, int writing); /* a handle; 0 if it cannot be opened */
uint32_t file_read(intptr_t file, void *into, uint32_t bytes);        /* bytes read */
uint32_t file_write(intptr_t file, const void *from, uint32_t bytes); /* bytes written */
int file_close(intptr_t file);                                        /* 0 if all is written */
void print_text(const char *text);
void finish(int code) __attribute__((noreturn));

/* A measured call, on a stack of its own, of one of the kernel's functions or of KNOWN, a function of exactly
   2 * rounds + 3 instructions with (void *)rounds for `state`; on a host KNOWN does nothing. */
enum entry { STEP, STEP_I16, SELFTEST, KNOWN };
int call(enum entry entry, void *state, const void *obs, void *act, struct elapsed *elapsed);

void stack_paint(void);
int32_t stack_depth(void); /* bytes of that stack used since it was painted; 0 on a host */

#endif
