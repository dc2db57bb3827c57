/* How firmware calls the policy: self-test at boot and a reset, then read, step, act every control period. Runs on a host too. */
#include <stdio.h>

#include "@name@.h"

static void read_sensors(float obs[@NAME@_OBS_SIZE]) {
    static const float example[@NAME@_OBS_SIZE] = {@example_obs@};
    for (int i = 0; i < @NAME@_OBS_SIZE; ++i) {
        obs[i] = example[i]; /* yours: the state estimate, in the order, units and frames of @name@.h */
    }
}

static void drive(const float act[@NAME@_ACT_SIZE]) {
    for (int i = 0; i < @NAME@_ACT_SIZE; ++i) {
        printf("%s%.4f", i ? " " : "@act_names@: ", (double)act[i]); /* yours: to the actuators */
    }
    printf("\n");
}

int main(void) {
    const int failed = @name@_selftest();
    if (failed) {
        printf("self-test %d failed: this build does not compute the policy that was verified\n", failed);
        return 1;
    }
    @name@_state state;
    @name@_reset(&state); /* again whenever the policy takes up control */
    float obs[@NAME@_OBS_SIZE], act[@NAME@_ACT_SIZE];
    read_sensors(obs);
    const int status = @name@_step(&state, obs, act);
    if (status == 2) { /* act holds the safe action, which is for one vehicle, level and at rest */
        printf("an input is not finite: hand over to a fallback controller\n");
        return 2;
    }
    if (status == 1) {
        printf("an input is beyond its calibrated range, and was clipped to it\n");
    }
    drive(act);
    return 0;
}
