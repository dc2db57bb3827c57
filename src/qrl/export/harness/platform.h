/* What the harness asks of the machine under it: files, one line of text, and calls that are measured.
   host.c answers on a workstation, startup.c on a Cortex-M under QEMU. */
#ifndef PLATFORM_H
#define PLATFORM_H

#include <stdint.h>

/* Time that a call took, as a tick counter saw it. On a host both are 0. */
struct elapsed {
    int32_t ticks; /* from one edge of the counter to another, the call between them */
    int32_t spins; /* rounds, of four instructions each, from the call's end to the second edge */
};

intptr_t file_open(const char *name, int writing); /* a handle; 0 where it cannot be opened */
uint32_t file_read(intptr_t file, void *into, uint32_t bytes);        /* bytes read */
uint32_t file_write(intptr_t file, const void *from, uint32_t bytes); /* bytes written */
int file_close(intptr_t file);                                        /* 0 when all is on the disk */
void say(const char *text);
void finish(int code) __attribute__((noreturn));

/* The kernel's three functions, each on a stack of its own, and a function of exactly 2 * rounds + 3 instructions. */
int call_f32(const float *obs, float *act, struct elapsed *elapsed);
int call_i16(const int16_t *obs, int16_t *act, struct elapsed *elapsed);
int call_selftest(struct elapsed *elapsed);
void call_known(uint32_t rounds, struct elapsed *elapsed);

void stack_paint(void);
int32_t stack_depth(void); /* bytes of that stack touched since it was painted; on a host 0 */

#endif
