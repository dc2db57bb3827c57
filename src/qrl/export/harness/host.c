/* The harness's platform on a workstation: stdio, and no measurements. */
#include "platform.h"

#include <stdio.h>
#include <stdlib.h>

#include "kernel_under_test.h"

intptr_t file_open(const char *name, int writing) { return (intptr_t)fopen(name, writing ? "wb" : "rb"); }

uint32_t file_read(intptr_t file, void *into, uint32_t bytes) { return (uint32_t)fread(into, 1, bytes, (FILE *)file); }

uint32_t file_write(intptr_t file, const void *from, uint32_t bytes)
{
    return (uint32_t)fwrite(from, 1, bytes, (FILE *)file);
}

int file_close(intptr_t file) { return fclose((FILE *)file); }

void print_text(const char *text) { fputs(text, stderr); }

void finish(int code) { exit(code); }

int call(enum entry entry, void *state, const void *obs, void *act, struct elapsed *elapsed)
{
    elapsed->ticks = elapsed->spins = 0;
    switch (entry) {
    case STEP:
        return kernel_step(state, obs, act);
    case STEP_I16:
        return kernel_step_i16(state, obs, act);
    case SELFTEST:
        return kernel_selftest();
    default:
        return 0;
    }
}

void stack_paint(void) {}

int32_t stack_depth(void) { return 0; }
