/* The harness's platform on a workstation: stdio, and no measurements. */
#include "platform.h"

#include <stdio.h>
#include <stdlib.h>

#include "qrl_policy.h"

intptr_t file_open(const char *name, int writing) { return (intptr_t)fopen(name, writing ? "wb" : "rb"); }

uint32_t file_read(intptr_t file, void *into, uint32_t bytes) { return (uint32_t)fread(into, 1, bytes, (FILE *)file); }

uint32_t file_write(intptr_t file, const void *from, uint32_t bytes)
{
    return (uint32_t)fwrite(from, 1, bytes, (FILE *)file);
}

int file_close(intptr_t file) { return fclose((FILE *)file); }

void print_text(const char *text) { fputs(text, stderr); }

void finish(int code) { exit(code); }

static void unmeasured(struct elapsed *elapsed) { elapsed->ticks = elapsed->spins = 0; }

int call_f32(const float *obs, float *act, struct elapsed *elapsed)
{
    unmeasured(elapsed);
    return qrl_policy_step(obs, act);
}

int call_i16(const int16_t *obs, int16_t *act, struct elapsed *elapsed)
{
    unmeasured(elapsed);
    return qrl_policy_step_i16(obs, act);
}

int call_selftest(struct elapsed *elapsed)
{
    unmeasured(elapsed);
    return qrl_policy_selftest();
}

void call_known(uint32_t rounds, struct elapsed *elapsed)
{
    (void)rounds;
    unmeasured(elapsed);
}

void stack_paint(void) {}

int32_t stack_depth(void) { return 0; }
