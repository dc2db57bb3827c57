#include <stdint.h>

typedef struct {
    uint8_t unused;
} plain_state;

void plain_reset(plain_state *state);
int plain_step(plain_state *state, const float obs[PLAIN_OBS_SIZE], float act[PLAIN_ACT_SIZE]);
int plain_step_i16(plain_state *state, const int16_t obs[PLAIN_OBS_SIZE], int16_t act[PLAIN_ACT_SIZE]);
int plain_selftest(void);
