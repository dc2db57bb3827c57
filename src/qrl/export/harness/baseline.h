#include <stdint.h>

typedef struct {
    uint8_t unused;
} baseline_state;

void baseline_reset(baseline_state *state);
int baseline_step(baseline_state *state, const float obs[BASELINE_OBS_SIZE], float act[BASELINE_ACT_SIZE]);
int baseline_step_i16(baseline_state *state, const int16_t obs[BASELINE_OBS_SIZE], int16_t act[BASELINE_ACT_SIZE]);
int baseline_selftest(void);
