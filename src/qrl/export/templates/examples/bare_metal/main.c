/* How firmware calls the policy: self-test at boot, then read, step, act every control period. Runs on a host too. */
#include <stdio.h>

#include "qrl_policy.h"

static void read_sensors(float obs[QRL_POLICY_OBS_SIZE]) {
    static const float example[QRL_POLICY_OBS_SIZE] = {@example_obs@};
    for (int i = 0; i < QRL_POLICY_OBS_SIZE; ++i) {
        obs[i] = example[i]; /* yours: the state estimate, in the order, units and frames of qrl_policy.h */
    }
}

static void drive(const float act[QRL_POLICY_ACT_SIZE]) {
    for (int i = 0; i < QRL_POLICY_ACT_SIZE; ++i) {
        printf("%s%.4f", i ? " " : "@act_names@: ", (double)act[i]); /* yours: to the actuators */
    }
    printf("\n");
}

int main(void) {
    const int failed = qrl_policy_selftest();
    if (failed) {
        printf("self-test %d failed: this build does not compute the policy that was verified\n", failed);
        return 1;
    }
    float obs[QRL_POLICY_OBS_SIZE], act[QRL_POLICY_ACT_SIZE];
    read_sensors(obs);
    const int status = qrl_policy_step(obs, act);
    if (status == 2) {
        printf("an input is not finite: act holds the safe action; hand over to a fallback controller\n");
    } else if (status == 1) {
        printf("an input is beyond its calibrated range\n");
    }
    drive(act);
    return 0;
}
