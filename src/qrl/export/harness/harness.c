/* Runs an emitted kernel over files of observations, on a host and on a target alike.

   Reads   f32.bin  int32 little-endian: observations from one reset to the next; observations, float32 [N, OBS]
           i16.bin  the same in int16 [M, OBS]
   Writes  out.bin  N + M records (below)
   and finally exactly one line of text that begins "qrl-result:", with counts, the self-test's result and the
   measurements. An error is one line that begins "qrl-error:". */
#include <string.h>

#include "kernel_under_test.h"
#include "platform.h"

enum { POISON = 0xA5 };

static union {
    float f32[OBS];
    int16_t i16[OBS];
} obs;

/* Poisoned before each call, which reveals a missing output or one too many; the state before each reset. */
static struct {
    int32_t status;
    union {
        kernel_state state;
        int32_t words[(sizeof(kernel_state) + 3) / 4 + 1];
    } kept;
    union {
        float f32[ACT + 2];
        int16_t i16[ACT + 2];
    } act;
    struct elapsed elapsed;
} record;

static void require(int good, const char *error)
{
    if (!good) {
        print_text("qrl-error: ");
        print_text(error);
        print_text("\n");
        finish(1);
    }
}

/* Runs one entry point over the observations of a file, and returns their number. */
static int32_t run(intptr_t out, const char *name, uint32_t bytes_each, enum entry entry)
{
    int32_t total = 0, length = 0;
    uint32_t bytes;
    static kernel_state state;
    intptr_t in = file_open(name, 0);
    require(in != 0 && file_read(in, &length, sizeof length) == sizeof length, "an observation file cannot be read");
    require(length > 0, "a sequence has no length");
    while ((bytes = file_read(in, &obs, bytes_each)) != 0) {
        require(bytes == bytes_each, "an observation file ends within a vector");
        memset(&record, POISON, sizeof record);
        if (total % length == 0) {
            kernel_reset(&record.kept.state);
        } else {
            record.kept.state = state;
        }
        record.status = call(entry, &record.kept.state, &obs, &record.act, &record.elapsed);
        state = record.kept.state;
        require(file_write(out, &record, sizeof record) == sizeof record, "out.bin cannot be written");
        total++;
    }
    file_close(in);
    return total;
}

static char line[640] = "qrl-result:";

/* Add " name=value" to the line. */
static void report(const char *name, int32_t value)
{
    char digits[12];
    char *first = digits + sizeof digits;
    uint32_t rest = value < 0 ? 0u - (uint32_t)value : (uint32_t)value;
    *--first = 0;
    do {
        *--first = (char)('0' + rest % 10);
        rest /= 10;
    } while (rest != 0);
    strcat(line, " ");
    strcat(line, name);
    strcat(line, value < 0 ? "=-" : "=");
    strcat(line, first);
}

static int report_call(enum entry entry, uintptr_t rounds, const char *ticks_name, const char *spins_name)
{
    struct elapsed elapsed;
    int status = call(entry, (void *)rounds, 0, 0, &elapsed);
    report(ticks_name, elapsed.ticks);
    report(spins_name, elapsed.spins);
    return status;
}

int main(void)
{
    intptr_t out = file_open("out.bin", 1);
    require(out != 0, "out.bin cannot be written");
    report("obs", OBS);
    report("act", ACT);
    report("state", sizeof(kernel_state));
    report_call(KNOWN, 0, "known_0_ticks", "known_0_spins");
    report_call(KNOWN, 1000, "known_1000_ticks", "known_1000_spins");
    report_call(KNOWN, 12345, "known_12345_ticks", "known_12345_spins");
    stack_paint();
    report("vectors_f32", run(out, "f32.bin", sizeof obs.f32, STEP));
    report("stack_f32", stack_depth());
    stack_paint();
    report("vectors_i16", run(out, "i16.bin", sizeof obs.i16, STEP_I16));
    report("stack_i16", stack_depth());
    stack_paint();
    report("selftest", report_call(SELFTEST, 0, "selftest_ticks", "selftest_spins"));
    report("stack_selftest", stack_depth());
    require(file_close(out) == 0, "out.bin cannot be written");
    strcat(line, "\n");
    print_text(line);
    finish(0);
}
