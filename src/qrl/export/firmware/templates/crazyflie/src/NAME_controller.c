/*
 * @name@.c as a controller of crazyflie-firmware: an out-of-tree app. What to set and to watch: README.md.
 *
 * The stabilizer calls controllerOutOfTree at 1 kHz. The policy runs every @period_ms@ ms, the motors hold between. It
 * flies while qrl.arm is 1 and the set-point is an absolute position with a heading; in all other cases the stock PID does.
 *
 * The code in this folder may be used without restriction, in any product and under any license.
 */
#include <math.h>
#include <stdbool.h>
#include <stdint.h>
#include <string.h>

#include "FreeRTOS.h"
#include "task.h"

#include "app.h"
#define DEBUG_MODULE "QRL"
#include "debug.h"

#include "controller.h"
#include "controller_pid.h"
#include "log.h"
#include "param.h"
#include "platform_defaults.h"
#include "usec_time.h"

#include "@name@.h"

#ifndef CONFIG_ENABLE_THRUST_BAT_COMPENSATED
#error "Forces are newtons only with the firmware's battery compensation: set CONFIG_ENABLE_THRUST_BAT_COMPENSATED"
#endif
@platform_guard@
#define PERIOD_STEPS (@NAME@_PERIOD_US / 1000)
_Static_assert(@NAME@_PERIOD_US % 1000 == 0 && RATE_MAIN_LOOP == 1000, "the period is whole steps of the main loop");
_Static_assert(STABILIZER_NR_OF_MOTORS == 4 && @NAME@_ACT_SIZE == 4, "four motors");

#define RAD_PER_DEG 0.017453293f

/* The least that keeps a motor running: below THRUST_MIN the firmware stops it, and it truncates to 1/65535. */
#define LEAST_FRACTION (THRUST_MIN / THRUST_MAX + 1.5f / 65535.0f)

/* The log variable qrl.state: who flies, and if it is the stock controller, why. */
enum {
    STOCK_UNARMED = 0,
    POLICY = 1,
    STOCK_SETPOINT = 2,     /* it is no absolute position with a heading: as ordered, or by the supervisor */
    STOCK_SETPOINT_OLD = 3, /* none for qrl.setpointMs */
    /* Faults: until qrl.arm is set to 0. */
    STOCK_STATE_OLD = 4,  /* the estimate has not changed for qrl.stateMs */
    STOCK_NOT_FINITE = 5, /* the state, the gyro or the set-point; or the quaternion is none */
    STOCK_SELFTEST = 6,   /* this build does not compute the policy that was verified */
};

static @name@_state memory; /* of the policy */
static float held[4];       /* normalizedForces of its last step */
static control_t stock;     /* the stock controller's own: it writes some of it at some steps only */

static bool tested;
static uint8_t who = STOCK_UNARMED;
static uint8_t fault = STOCK_UNARMED; /* STOCK_UNARMED: none */
static uint32_t last_step, next_step, changed_step;

static quaternion_t seen_attitude; /* of the estimate when it last changed */
static velocity_t seen_velocity;
static state_t last_state; /* the last that were finite, which the stock controller is given */
static sensorData_t last_sensors;
static setpoint_t last_setpoint;

static uint8_t arm = 0;
static uint16_t setpoint_ms = 250;
static uint16_t state_ms = 50;

static uint8_t status;
static uint32_t steps, clipped, step_us;
static uint16_t takeovers;

/* The estimators put no time on a state; with the noise of the gyro, one that is alive changes at each of its updates. */
static void watch(const state_t *state, const uint32_t step) {
    if (memcmp(&state->attitudeQuaternion, &seen_attitude, sizeof seen_attitude) != 0 ||
        memcmp(&state->velocity.x, &seen_velocity.x, sizeof seen_velocity.x) != 0 ||
        memcmp(&state->velocity.y, &seen_velocity.y, sizeof seen_velocity.y) != 0 ||
        memcmp(&state->velocity.z, &seen_velocity.z, sizeof seen_velocity.z) != 0) {
        changed_step = step;
        seen_attitude = state->attitudeQuaternion;
        seen_velocity = state->velocity;
    }
}

/* Whether the state and the gyro are numbers, and the quaternion is one. */
static bool usable(const state_t *state, const sensorData_t *sensors) {
    const quaternion_t q = state->attitudeQuaternion;
    const float square = q.x * q.x + q.y * q.y + q.z * q.z + q.w * q.w;
    return square > 0.9f && square < 1.1f && /* false for NaN */
           isfinite(state->position.x) && isfinite(state->position.y) && isfinite(state->position.z) &&
           isfinite(state->velocity.x) && isfinite(state->velocity.y) && isfinite(state->velocity.z) &&
           isfinite(sensors->gyro.x) && isfinite(sensors->gyro.y) && isfinite(sensors->gyro.z);
}

/* Whether what a set-point asks for is finite: a place and a velocity only where its modes ask for them. */
static bool asks_for_numbers(const setpoint_t *setpoint) {
    const setpoint_mode_t *mode = &setpoint->mode;
    const quaternion_t q = setpoint->attitudeQuaternion;
    const attitude_t angle = setpoint->attitude, rate = setpoint->attitudeRate;
    const bool place = mode->x == modeAbs || mode->y == modeAbs || mode->z == modeAbs;
    const bool moves = mode->x == modeVelocity || mode->y == modeVelocity || mode->z == modeVelocity;
    const float turn = angle.roll + angle.pitch + angle.yaw + rate.roll + rate.pitch + rate.yaw + q.x + q.y + q.z + q.w;
    return isfinite(turn + setpoint->thrust) &&
           (!place || isfinite(setpoint->position.x + setpoint->position.y + setpoint->position.z)) &&
           (!moves || isfinite(setpoint->velocity.x + setpoint->velocity.y + setpoint->velocity.z));
}

/* What is not finite would stay in the filters of the stock controller: it is given the last that was. */
static void keep(const setpoint_t *setpoint, const sensorData_t *sensors, const state_t *state) {
    if (usable(state, sensors) && isfinite(state->attitude.roll + state->attitude.pitch + state->attitude.yaw)) {
        last_state = *state;
        last_sensors = *sensors;
    }
    if (asks_for_numbers(setpoint)) {
        last_setpoint = *setpoint;
    }
}

static uint8_t decide(const setpoint_t *setpoint, const uint32_t step) {
    const setpoint_mode_t *mode = &setpoint->mode;
    if (!arm) {
        fault = STOCK_UNARMED;
        return STOCK_UNARMED;
    }
    if (!tested) {
        fault = STOCK_SELFTEST;
    }
    if (fault != STOCK_UNARMED) {
        return fault;
    }
    if (mode->x != modeAbs || mode->y != modeAbs || mode->z != modeAbs ||
        (mode->yaw != modeAbs && mode->quat != modeAbs)) {
        return STOCK_SETPOINT;
    }
    if ((uint32_t)(xTaskGetTickCount() - setpoint->timestamp) > M2T(setpoint_ms)) {
        return STOCK_SETPOINT_OLD;
    }
    if ((uint32_t)(step - changed_step) > state_ms) {
        fault = STOCK_STATE_OLD;
        return fault;
    }
    return POLICY;
}

/* Writes a vector of the world to out, in the world rotated about z so that its x axis is the heading of the set-point. */
static void rotated(const float heading[2], const float x, const float y, const float z, float out[3]) {
    out[0] = heading[0] * x + heading[1] * y;
    out[1] = heading[0] * y - heading[1] * x;
    out[2] = z;
}

/* Cosine and sine of the heading that is asked for. */
static void heading_of(const setpoint_t *setpoint, float heading[2]) {
    const quaternion_t q = setpoint->attitudeQuaternion;
    const float x_x = 1.0f - 2.0f * (q.y * q.y + q.z * q.z), x_y = 2.0f * (q.x * q.y + q.w * q.z);
    const float length = sqrtf(x_x * x_x + x_y * x_y);
    if (setpoint->mode.yaw == modeAbs) {
        heading[0] = cosf(setpoint->attitude.yaw * RAD_PER_DEG);
        heading[1] = sinf(setpoint->attitude.yaw * RAD_PER_DEG);
    } else {
        heading[0] = length > 0.0f ? x_x / length : 1.0f;
        heading[1] = length > 0.0f ? x_y / length : 0.0f;
    }
}

/* What the policy observes, in the order of @name@.h. */
static void observe(const setpoint_t *setpoint, const sensorData_t *sensors, const state_t *state,
                    float obs[@NAME@_OBS_SIZE]) {
    const quaternion_t q = state->attitudeQuaternion; /* body to world; x, y, z, w */
    float heading[2], axis[3];
    heading_of(setpoint, heading);

    /* The body's axes in the world are the columns of the matrix; it is row-major. */
    const float axes[3][3] = {
        {1.0f - 2.0f * (q.y * q.y + q.z * q.z), 2.0f * (q.x * q.y + q.w * q.z), 2.0f * (q.x * q.z - q.w * q.y)},
        {2.0f * (q.x * q.y - q.w * q.z), 1.0f - 2.0f * (q.x * q.x + q.z * q.z), 2.0f * (q.y * q.z + q.w * q.x)},
        {2.0f * (q.x * q.z + q.w * q.y), 2.0f * (q.y * q.z - q.w * q.x), 1.0f - 2.0f * (q.x * q.x + q.y * q.y)},
    };
    for (int column = 0; column < 3; ++column) {
        rotated(heading, axes[column][0], axes[column][1], axes[column][2], axis);
        for (int row = 0; row < 3; ++row) {
            obs[@NAME@_OBS_R11 + 3 * row + column] = axis[row];
        }
    }
    rotated(heading, state->position.x - setpoint->position.x, state->position.y - setpoint->position.y,
           state->position.z - setpoint->position.z, &obs[@NAME@_OBS_PX]);
    rotated(heading, state->velocity.x - setpoint->velocity.x, state->velocity.y - setpoint->velocity.y,
           state->velocity.z - setpoint->velocity.z, &obs[@NAME@_OBS_VX]);
    obs[@NAME@_OBS_WX] = sensors->gyro.x * RAD_PER_DEG;
    obs[@NAME@_OBS_WY] = sensors->gyro.y * RAD_PER_DEG;
    obs[@NAME@_OBS_WZ] = sensors->gyro.z * RAD_PER_DEG;@preview@
}

/* An action as a fraction of THRUST_MAX, for normalizedForces. */
static float fraction(const float action) {
@fraction@
    return share < LEAST_FRACTION ? LEAST_FRACTION : share > 1.0f ? 1.0f : share;
}

/* One step of the policy. Returns POLICY, or the fault: the set-point is not finite. */
static uint8_t run(const setpoint_t *setpoint, const sensorData_t *sensors, const state_t *state) {
    const uint64_t begin_us = usecTimestamp();
    float obs[@NAME@_OBS_SIZE], act[@NAME@_ACT_SIZE];
    observe(setpoint, sensors, state, obs);
    status = (uint8_t)@name@_step(&memory, obs, act);
    if (status == 2) {
        return STOCK_NOT_FINITE;
    }
    held[0] = fraction(act[@NAME@_ACT_@m1@]); /* M1: front right */
    held[1] = fraction(act[@NAME@_ACT_@m2@]); /* M2: back right */
    held[2] = fraction(act[@NAME@_ACT_@m3@]); /* M3: back left */
    held[3] = fraction(act[@NAME@_ACT_@m4@]); /* M4: front left */
    steps += 1;
    clipped += status == 1;
    step_us = (uint32_t)(usecTimestamp() - begin_us);
    return POLICY;
}

/* The stock PID. When it takes over, a set-point of another mode makes it forget its integrals, as the firmware's own
   mode changes do; and at step 0 all of its loops run, so that none of its outputs is from before. */
static void fly_stock(control_t *control, const setpoint_t *setpoint, const sensorData_t *sensors, const state_t *state,
                      const stabilizerStep_t step, const bool takes_over) {
    static const setpoint_t none;
    if (takes_over) {
        controllerPid(&stock, &none, sensors, state, 0);
    }
    controllerPid(&stock, setpoint, sensors, state, takes_over ? 0 : step);
    *control = stock;
}

void controllerOutOfTreeInit(void) {
    controllerPidInit();
    memset(&stock, 0, sizeof stock);
    who = STOCK_UNARMED;
    fault = STOCK_UNARMED;
}

/* At boot this runs in a task of 1,200 bytes of stack, most of which the policy's self-test takes. So the app's own task
   runs that; until it has passed, the policy does not fly. */
bool controllerOutOfTreeTest(void) {
    return controllerPidTest();
}

static void self_test(void) {
    tested = @name@_selftest() == 0;
}

void controllerOutOfTree(control_t *control, const setpoint_t *setpoint, const sensorData_t *sensors,
                         const state_t *state, const stabilizerStep_t step) {
    const bool continued = step == last_step + 1;
    const uint8_t before = who;
    if (!continued) {
        changed_step = step;
    }
    watch(state, step);
    keep(setpoint, sensors, state);
    who = decide(setpoint, step);
    if (who == POLICY) {
        if (before != POLICY || !continued) {
            @name@_reset(&memory);
            next_step = step;
            takeovers += 1;
        }
        if (!usable(state, sensors)) {
            who = STOCK_NOT_FINITE;
        } else if (step == next_step) {
            who = run(setpoint, sensors, state);
            next_step = step + PERIOD_STEPS;
        }
    }
    if (who == POLICY) {
        control->controlMode = controlModeForce;
        memcpy(control->normalizedForces, held, sizeof held);
    } else {
        if (who >= STOCK_STATE_OLD) {
            fault = who;
        }
        fly_stock(control, &last_setpoint, &last_sensors, &last_state, step, before == POLICY || !continued);
    }
    last_step = step;
}

/* The self-test; then tells on the console who flies, when it changes. */
void appMain(void) {
    static const char *const meanings[] = {
        "stock: not armed",
        "policy flies",
        "stock: set-point not absolute",
        "stock: set-point old",
        "FAULT, stock: state old",
        "FAULT, stock: input not finite",
        "FAULT, stock: self-test failed",
    };
    uint8_t told = UINT8_MAX;
    self_test();
    while (1) {
        const uint8_t now = who;
        if (now != told) {
            DEBUG_PRINT("@name@: %s\n", meanings[now]);
            told = now;
        }
        vTaskDelay(M2T(100));
    }
}

/**
 * A trained policy (@name@) that flies in place of the stock controller.
 */
PARAM_GROUP_START(qrl)
/**
 * @brief 1: the policy flies where it can; 0: the stock controller flies, and a fault is forgotten (Default: 0)
 */
PARAM_ADD(PARAM_UINT8, arm, &arm)
/**
 * @brief Age of a set-point above which the stock controller takes over [ms] (Default: 250)
 */
PARAM_ADD(PARAM_UINT16, setpointMs, &setpoint_ms)
/**
 * @brief Time without a change of the state estimate above which the stock controller takes over [ms] (Default: 50)
 */
PARAM_ADD(PARAM_UINT16, stateMs, &state_ms)
PARAM_GROUP_STOP(qrl)

/**
 * A trained policy (@name@): who flies, and how it is.
 */
LOG_GROUP_START(qrl)
/**
 * @brief 1: the policy flies. Else the stock controller: 0 not armed, 2 set-point is no absolute position, 3 set-point
 * old; faults until qrl.arm is 0: 4 state old, 5 input not finite, 6 self-test failed
 */
LOG_ADD(LOG_UINT8, state, &who)
/**
 * @brief Status of the last step of the policy: 1 if an input was clipped to its range, 2 if one was not finite
 */
LOG_ADD(LOG_UINT8, status, &status)
/**
 * @brief Steps of the policy since boot
 */
LOG_ADD(LOG_UINT32, steps, &steps)
/**
 * @brief Steps in which an input was clipped to its range
 */
LOG_ADD(LOG_UINT32, clipped, &clipped)
/**
 * @brief Time that the last step took [us]
 */
LOG_ADD(LOG_UINT32, us, &step_us)
/**
 * @brief How often the policy took up control; its memory was reset each time
 */
LOG_ADD(LOG_UINT16, takeovers, &takeovers)
/**
 * @brief Force of M1 that the policy last ordered, of THRUST_MAX
 */
LOG_ADD(LOG_FLOAT, m1, &held[0])
/**
 * @brief Force of M2 that the policy last ordered, of THRUST_MAX
 */
LOG_ADD(LOG_FLOAT, m2, &held[1])
/**
 * @brief Force of M3 that the policy last ordered, of THRUST_MAX
 */
LOG_ADD(LOG_FLOAT, m3, &held[2])
/**
 * @brief Force of M4 that the policy last ordered, of THRUST_MAX
 */
LOG_ADD(LOG_FLOAT, m4, &held[3])
LOG_GROUP_STOP(qrl)
