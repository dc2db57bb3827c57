/*
 * The policy of @name@.c behind north, east, down: @name@_hook.h.
 *
 * The code in this folder may be used without restriction, in any product and under any license.
 */
#include "@name@_hook.h"

#include <math.h>
#include <string.h>

#if @NAME@_ACT_SIZE != 4
#error "four motors"
#endif

/* By their bits: with -ffast-math, as Betaflight is built, isfinite is always true. */
static bool all_finite(const float *numbers, const int count) {
    for (int i = 0; i < count; ++i) {
        uint32_t bits;
        memcpy(&bits, numbers + i, sizeof bits);
        if ((bits >> 23 & 255u) == 255u) {
            return false;
        }
    }
    return true;
}

/* Whether a time is further back than `most_us`. It may be a little ahead of now, where an interrupt stamps it. */
static bool old(const uint32_t now_us, const uint32_t then_us, const uint32_t most_us) {
    return now_us - then_us + @NAME@_AHEAD_US > most_us + @NAME@_AHEAD_US;
}

/* Whether an estimate and a set-point are numbers, and the quaternion is one. */
static bool usable(const @name@_estimate *estimate, const @name@_setpoint *setpoint) {
    const float *q = estimate->attitude;
    const float square = q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3];
    return all_finite(q, 4) && square > 0.9f && square < 1.1f && all_finite(estimate->position_m, 3) &&
           all_finite(estimate->velocity_m_s, 3) && all_finite(estimate->rates_rad_s, 3) &&
           all_finite(setpoint->position_m, 3) && all_finite(setpoint->velocity_m_s, 3) &&
           all_finite(setpoint->acceleration_m_s2, 3) && all_finite(setpoint->jerk_m_s3, 3) &&
           all_finite(&setpoint->yaw_rad, 1);
}

/* Writes a vector given in north, east, down to out in the policy's world: z up, x along the heading of the set-point. */
static void rotated(const float heading[2], const float north, const float east, const float down, float out[3]) {
    out[0] = heading[0] * north + heading[1] * east;
    out[1] = heading[1] * north - heading[0] * east;
    out[2] = -down;
}

/* What the policy observes, in the order of @name@.h. */
static void observe(const @name@_estimate *estimate, const @name@_setpoint *setpoint, float obs[@NAME@_OBS_SIZE]) {
    const float w = estimate->attitude[0], x = estimate->attitude[1], y = estimate->attitude[2], z = estimate->attitude[3];
    const float heading[2] = {cosf(setpoint->yaw_rad), sinf(setpoint->yaw_rad)};
    float axis[3];

    /* Front, right and down in the world are the columns of the matrix; the policy's body axes are front, left and up. */
    const float axes[3][3] = {
        {1.0f - 2.0f * (y * y + z * z), 2.0f * (x * y + w * z), 2.0f * (x * z - w * y)},
        {-2.0f * (x * y - w * z), -1.0f + 2.0f * (x * x + z * z), -2.0f * (y * z + w * x)},
        {-2.0f * (x * z + w * y), -2.0f * (y * z - w * x), -1.0f + 2.0f * (x * x + y * y)},
    };
    for (int column = 0; column < 3; ++column) {
        rotated(heading, axes[column][0], axes[column][1], axes[column][2], axis);
        for (int row = 0; row < 3; ++row) {
            obs[@NAME@_OBS_R11 + 3 * row + column] = axis[row];
        }
    }
    const float *p = estimate->position_m, *v = estimate->velocity_m_s;
    const float *to = setpoint->position_m, *at = setpoint->velocity_m_s;
    rotated(heading, p[0] - to[0], p[1] - to[1], p[2] - to[2], &obs[@NAME@_OBS_PX]);
    rotated(heading, v[0] - at[0], v[1] - at[1], v[2] - at[2], &obs[@NAME@_OBS_VX]);
    obs[@NAME@_OBS_WX] = estimate->rates_rad_s[0];
    obs[@NAME@_OBS_WY] = -estimate->rates_rad_s[1];
    obs[@NAME@_OBS_WZ] = -estimate->rates_rad_s[2];@preview@
}

/* A motor's command, of an action as a fraction of its greatest. */
static float command(const float of_most) {
@fraction@
    return share < 0.0f ? 0.0f : share > 1.0f ? 1.0f : share;
}

/* One step of the policy. Returns who flies. */
static int step(@name@_hook *hook, const @name@_estimate *estimate, const @name@_setpoint *setpoint) {
    float obs[@NAME@_OBS_SIZE], act[@NAME@_ACT_SIZE];
    observe(estimate, setpoint, obs);
    hook->status = @name@_step(&hook->memory, obs, act);
    if (hook->status == 2) {
        return @NAME@_NOT_FINITE;
    }
    hook->motor[0] = command(act[@NAME@_ACT_@m1@] / @most1@); /* @motor1@ */
    hook->motor[1] = command(act[@NAME@_ACT_@m2@] / @most2@); /* @motor2@ */
    hook->motor[2] = command(act[@NAME@_ACT_@m3@] / @most3@); /* @motor3@ */
    hook->motor[3] = command(act[@NAME@_ACT_@m4@] / @most4@); /* @motor4@ */
    return @NAME@_FLIES;
}

bool @name@_hook_init(@name@_hook *hook) {
    memset(hook, 0, sizeof *hook);
    hook->who = @NAME@_OFF;
    hook->tested = @name@_selftest() == 0;
    return hook->tested;
}

void @name@_hook_start(@name@_hook *hook, const uint32_t now_us) {
    @name@_reset(&hook->memory);
    hook->next_us = now_us;
    hook->who = hook->tested ? @NAME@_FLIES : @NAME@_SELFTEST;
}

void @name@_hook_stop(@name@_hook *hook) {
    hook->who = @NAME@_OFF;
}

int @name@_hook_check(const @name@_hook *hook, const @name@_estimate *estimate, const @name@_setpoint *setpoint,
                      const uint32_t now_us) {
    if (!hook->tested) {
        return @NAME@_SELFTEST;
    }
    if (!usable(estimate, setpoint)) {
        return @NAME@_NOT_FINITE;
    }
    if (old(now_us, estimate->position_us, @NAME@_POSITION_US)) {
        return @NAME@_POSITION_OLD;
    }
    if (old(now_us, estimate->attitude_us, @NAME@_ATTITUDE_US)) {
        return @NAME@_ATTITUDE_OLD;
    }
    return old(now_us, setpoint->received_us, @NAME@_SETPOINT_US) ? @NAME@_SETPOINT_OLD : @NAME@_FLIES;
}

int @name@_hook_run(@name@_hook *hook, const @name@_estimate *estimate, const @name@_setpoint *setpoint,
                    const uint32_t now_us, float motor[4]) {
    if (hook->who != @NAME@_FLIES) {
        return hook->who;
    }
    hook->who = @name@_hook_check(hook, estimate, setpoint, now_us);
    if (hook->who == @NAME@_FLIES && (int32_t)(now_us - hook->next_us) >= -@NAME@_EARLY_US) {
        hook->who = step(hook, estimate, setpoint);
        hook->next_us += @NAME@_PERIOD_US;
        if ((int32_t)(now_us - hook->next_us) >= 0) { /* late by a whole period: what was missed is not caught up */
            hook->next_us = now_us + @NAME@_PERIOD_US;
        }
    }
    if (hook->who == @NAME@_FLIES) {
        memcpy(motor, hook->motor, sizeof hook->motor);
    }
    return hook->who;
}

void @name@_quaternion(const float roll_rad, const float pitch_rad, const float yaw_rad, float attitude[4]) {
    const float cr = cosf(0.5f * roll_rad), sr = sinf(0.5f * roll_rad);
    const float cp = cosf(0.5f * pitch_rad), sp = sinf(0.5f * pitch_rad);
    const float cy = cosf(0.5f * yaw_rad), sy = sinf(0.5f * yaw_rad);
    attitude[0] = cr * cp * cy + sr * sp * sy;
    attitude[1] = sr * cp * cy - cr * sp * sy;
    attitude[2] = cr * sp * cy + sr * cp * sy;
    attitude[3] = cr * cp * sy - sr * sp * cy;
}
