/* Runs an emitted kernel over files of observations, on a host and on a target alike.

   Reads   f32.bin  observations, float32 little-endian [N, OBS]
           i16.bin  observations, int16 [M, OBS]
   Writes  out.bin  N records of one layout, then M of the other: status, act, guard, elapsed (below)
   and finally exactly one line of text that begins "qrl-result:", with counts, the self-test's result and the
   measurements. An error is one line that begins "qrl-error:". */
#include <string.h>

#include "platform.h"
#include "qrl_policy.h"

/* A chunk's observations and records of both kinds take at most 3.5 KB unless one vector takes more. */
enum { OBS = QRL_POLICY_OBS_SIZE, ACT = QRL_POLICY_ACT_SIZE, POISON = 0xA5 };
enum { EACH = OBS + ACT + 6, CHUNK = EACH < 560 ? 560 / EACH : 1 };

/* The kernel writes into a poisoned record, which reveals a missing output or one too many. */
static struct record_f32 {
    int32_t status;
    float act[ACT];
    float guard[2];
    struct elapsed elapsed;
} records_f32[CHUNK];

static struct record_i16 {
    int32_t status;
    int16_t act[ACT];
    int16_t guard[2];
    struct elapsed elapsed;
} records_i16[CHUNK];

static float obs_f32[CHUNK][OBS];
static int16_t obs_i16[CHUNK][OBS];

static void require(int good, const char *error)
{
    if (!good) {
        print_text("qrl-error: ");
        print_text(error);
        print_text("\n");
        finish(1);
    }
}

/* Reads the next vectors of `file`, as many as fit a chunk; returns their number, 0 at the end. */
static uint32_t next_vectors(intptr_t file, void *into, uint32_t bytes_each)
{
    uint32_t bytes = file_read(file, into, CHUNK * bytes_each);
    require(bytes % bytes_each == 0, "an observation file ends within a vector");
    return bytes / bytes_each;
}

static int32_t run_f32(intptr_t out)
{
    int32_t total = 0;
    uint32_t count;
    intptr_t in = file_open("f32.bin", 0);
    require(in != 0, "f32.bin cannot be read");
    while ((count = next_vectors(in, obs_f32, sizeof obs_f32[0])) != 0) {
        memset(records_f32, POISON, sizeof records_f32);
        for (uint32_t i = 0; i < count; i++) {
            records_f32[i].status = call_f32(obs_f32[i], records_f32[i].act, &records_f32[i].elapsed);
        }
        uint32_t bytes = count * (uint32_t)sizeof records_f32[0];
        require(file_write(out, records_f32, bytes) == bytes, "out.bin cannot be written");
        total += (int32_t)count;
    }
    file_close(in);
    return total;
}

static int32_t run_i16(intptr_t out)
{
    int32_t total = 0;
    uint32_t count;
    intptr_t in = file_open("i16.bin", 0);
    require(in != 0, "i16.bin cannot be read");
    while ((count = next_vectors(in, obs_i16, sizeof obs_i16[0])) != 0) {
        memset(records_i16, POISON, sizeof records_i16);
        for (uint32_t i = 0; i < count; i++) {
            records_i16[i].status = call_i16(obs_i16[i], records_i16[i].act, &records_i16[i].elapsed);
        }
        uint32_t bytes = count * (uint32_t)sizeof records_i16[0];
        require(file_write(out, records_i16, bytes) == bytes, "out.bin cannot be written");
        total += (int32_t)count;
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

static void report_elapsed(const char *ticks_name, const char *spins_name, struct elapsed elapsed)
{
    report(ticks_name, elapsed.ticks);
    report(spins_name, elapsed.spins);
}

int main(void)
{
    struct elapsed elapsed;
    intptr_t out = file_open("out.bin", 1);
    require(out != 0, "out.bin cannot be written");
    report("obs", OBS);
    report("act", ACT);
    call_known(0, &elapsed);
    report_elapsed("known_0_ticks", "known_0_spins", elapsed);
    call_known(1000, &elapsed);
    report_elapsed("known_1000_ticks", "known_1000_spins", elapsed);
    call_known(12345, &elapsed);
    report_elapsed("known_12345_ticks", "known_12345_spins", elapsed);
    stack_paint();
    report("vectors_f32", run_f32(out));
    report("stack_f32", stack_depth());
    stack_paint();
    report("vectors_i16", run_i16(out));
    report("stack_i16", stack_depth());
    stack_paint();
    report("selftest", call_selftest(&elapsed));
    report("stack_selftest", stack_depth());
    report_elapsed("selftest_ticks", "selftest_spins", elapsed);
    require(file_close(out) == 0, "out.bin cannot be written");
    strcat(line, "\n");
    print_text(line);
    finish(0);
}
