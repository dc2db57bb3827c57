/*
 * @name@.c as the neural controller of Indiflight (Betaflight 4.4 of TU Delft): it takes the place of
 * src/main/flight/neural_controllers/nn_controller.c. Set-points are those of the external position (POS_SETPOINT).
 *
 * The code in this folder may be used without restriction, in any product and under any license.
 */
#include "platform.h"

#include "drivers/time.h"
#include "flight/nn_control.h"
#include "io/external_pos.h"

#include "nn_controller.h"
#include "@name@_hook.h"

#ifndef QRL_START_NED_M
#define QRL_START_NED_M {0.0f, 0.0f, -1.5f}
#endif
#ifndef QRL_START_YAW_RAD
#define QRL_START_YAW_RAD 0.0f
#endif
const float start_pos[3] = QRL_START_NED_M;
const float start_yaw = QRL_START_YAW_RAD;

static @name@_hook hook;

void nn_reset(void) {
    static bool booted = false;
    if (!booted) {
        @name@_hook_init(&hook);
        booted = true;
    }
    @name@_hook_start(&hook, micros());
}

/* world_state: position, velocity (north, east, down), roll, pitch, yaw [rad], rates (front, right, down) [rad/s], rotor
 * speeds. A fault hands over to Indiflight's recovery; the motors hold for this one loop. */
void nn_control(const float world_state[16], float motor_cmds[4]) {
    const uint32_t now_us = micros();
    @name@_estimate estimate = {
        .position_m = {world_state[0], world_state[1], world_state[2]},
        .velocity_m_s = {world_state[3], world_state[4], world_state[5]},
        .rates_rad_s = {world_state[9], world_state[10], world_state[11]},
        .position_us = extLatestMsgTime,
        .attitude_us = now_us, /* Indiflight's filter puts no time on it */
    };
    /* Indiflight keeps its set-point until another comes, so it has no age here. */
    const @name@_setpoint setpoint = {
        .position_m = {posSpNed.pos.V.X, posSpNed.pos.V.Y, posSpNed.pos.V.Z},
        .velocity_m_s = {posSpNed.vel.V.X, posSpNed.vel.V.Y, posSpNed.vel.V.Z},
        .yaw_rad = posSpNed.psi,
        .received_us = now_us,
    };
    @name@_quaternion(world_state[6], world_state[7], world_state[8], estimate.attitude);
    if (@name@_hook_run(&hook, &estimate, &setpoint, now_us, motor_cmds) != @NAME@_FLIES) {
        nn_deactivate();
    }
}
