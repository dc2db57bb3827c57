/*
@banner@
 *
 * Call once every @period_s@ s, the control period of training.
@frames@
@ports@
 *
 * lsb: the value of one step of the integer entry. range: inputs beyond it are clipped, and the status is 1.
 * C99, no libm, no heap, no state. Without an FPU the float entry calls the compiler's float routines for its
 * outputs only; the integer entry calls none. Stack and instructions: report.md.
 * The code in this folder may be used without restriction, in any product and under any license.
 */
#ifndef QRL_POLICY_H
#define QRL_POLICY_H

#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

#define QRL_POLICY_OBS_SIZE @obs_size@
#define QRL_POLICY_ACT_SIZE @act_size@
#define QRL_POLICY_PERIOD_US @period_us@

/* Indices in obs and act. */
enum {
@places@
};

/* For the integer entry, as initializers: static const float obs_lsb[] = {QRL_POLICY_OBS_LSB}; an input is
   value / lsb, rounded and saturated to [least, most] before it is cast: in C a cast out of range is undefined. */
#define QRL_POLICY_OBS_LSB @obs_lsb@
#define QRL_POLICY_OBS_LEAST @obs_least@
#define QRL_POLICY_OBS_MOST @obs_most@
#define QRL_POLICY_ACT_LSB @act_lsb@

/* SI units. Returns 0; or 1: an input was clipped to its range; or 2: an input was not finite, and act holds the
   safe action. */
int qrl_policy_step(const float obs[QRL_POLICY_OBS_SIZE], float act[QRL_POLICY_ACT_SIZE]);

/* The same in steps of lsb, for chips without an FPU. Returns 0 or 1. */
int qrl_policy_step_i16(const int16_t obs[QRL_POLICY_OBS_SIZE], int16_t act[QRL_POLICY_ACT_SIZE]);

/* Run the embedded golden vectors, for example at boot. Returns 0 if all are reproduced bit for bit, else which failed. */
int qrl_policy_selftest(void);

#ifdef __cplusplus
}
#endif

#endif
