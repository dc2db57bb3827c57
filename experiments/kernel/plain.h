#include <stdint.h>

int qrl_policy_step(const float obs[QRL_POLICY_OBS_SIZE], float act[QRL_POLICY_ACT_SIZE]);
int qrl_policy_step_i16(const int16_t obs[QRL_POLICY_OBS_SIZE], int16_t act[QRL_POLICY_ACT_SIZE]);
int qrl_policy_selftest(void);
