/*
@banner@
 *
 * Call once every @period_s@ s, the control period of training.
@frames@
@ports@
 *
 * lsb: the value of one step of the integer entry. range: inputs beyond it are clipped, and the status is 1.
 * C99, no libm, no heap, no static state. Without an FPU the float entry calls the compiler's float routines for its
 * outputs only; the integer entry calls none. Stack and instructions: report.md.
 * The code in this folder may be used without restriction, in any product and under any license.
 */
#ifndef @NAME@_H
#define @NAME@_H

#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

#define @NAME@_OBS_SIZE @obs_size@
#define @NAME@_ACT_SIZE @act_size@
#define @NAME@_PERIOD_US @period_us@

/* Indices in obs and act. */
enum {
@places@
};

/* For the integer entry, as initializers: static const float obs_lsb[] = {@NAME@_OBS_LSB}; an input is
   value / lsb, rounded and saturated to [least, most] before it is cast: in C a cast out of range is undefined. */
#define @NAME@_OBS_LSB @obs_lsb@
#define @NAME@_OBS_LEAST @obs_least@
#define @NAME@_OBS_MOST @obs_most@
#define @NAME@_ACT_LSB @act_lsb@

/* The memory of the policy: @state_is@.
   Plain data, owned by the caller; each vehicle needs one of its own. @state_bytes@. */
typedef struct {
@state_fields@
} @name@_state;

/* Before the first step, and whenever the policy takes up control again. */
void @name@_reset(@name@_state *state);

/* SI units. Returns 0; or 1: an input was clipped to its range; or 2: an input was not finite: act holds the safe
   action, and the state is unchanged. */
int @name@_step(@name@_state *state, const float obs[@NAME@_OBS_SIZE], float act[@NAME@_ACT_SIZE]);

/* The same in steps of lsb, for chips without an FPU. Returns 0 or 1. */
int @name@_step_i16(@name@_state *state, const int16_t obs[@NAME@_OBS_SIZE], int16_t act[@NAME@_ACT_SIZE]);

/* Run the embedded golden vectors, for example at boot. Returns 0 if all are reproduced bit for bit, else which failed. */
int @name@_selftest(void);

#ifdef __cplusplus
}
#endif

#endif
