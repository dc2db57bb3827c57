/* The emitted app for a Crazyflie as a library on a PC: what it calls of the firmware, and its calls as arrays.
 *
 * APP: the app's source. With REAL_STOCK the stock PID and the motors' mixer are linked from the firmware; else they are the
 * simple ones below. */
#include APP

#include "power_distribution.h"

static uint32_t now_ms;

TickType_t xTaskGetTickCount(void) {
    return now_ms;
}

void vTaskDelay(const TickType_t ticks) {
    (void)ticks;
}

uint64_t usecTimestamp(void) {
    return 1000u * (uint64_t)now_ms;
}

#ifdef REAL_STOCK
int consolePutchar(int ch) {
    return ch;
}

int eprintf(putc_t putcf, const char *format, ...) {
    return putcf && format;
}
#else
int consolePrintf(const char *format, ...) {
    return format != 0;
}

/* Like the firmware's, it writes roll, pitch and yaw every second step only, and the thrust always. */
void controllerPidInit(void) {
}

bool controllerPidTest(void) {
    return true;
}

void controllerPid(control_t *control, const setpoint_t *setpoint, const sensorData_t *sensors, const state_t *state,
                   const stabilizerStep_t step) {
    const float of_state = state->position.x + state->velocity.y + state->attitudeQuaternion.w + sensors->gyro.z;
    const float asked = setpoint->mode.z == modeAbs ? setpoint->position.x : setpoint->velocity.x;
    control->controlMode = controlModeLegacy;
    if (step % 2 == 0) {
        control->roll = control->pitch = control->yaw = 0;
    }
    control->thrust = setpoint->mode.z != modeDisable && isfinite(of_state + asked + setpoint->attitude.yaw)
                          ? 30000.0f + 1000.0f * asked
                          : 0.0f;
}

void powerDistribution(const control_t *control, motors_thrust_uncapped_t *thrust) {
    for (int i = 0; i < 4; ++i) {
        const float f = control->normalizedForces[i];
        thrust->list[i] = control->controlMode == controlModeForce
                              ? (int32_t)((f < 0.0f ? 0.0f : f > 1.0f ? 1.0f : f) * 65535.0f)
                              : (int32_t)control->thrust + control->roll + control->pitch + control->yaw;
    }
}
#endif

int simple_stock(void) {
#ifdef REAL_STOCK
    return 0;
#else
    return 1;
#endif
}

float thrust_max_N(void) {
    return THRUST_MAX;
}

float thrust_min_N(void) {
    return THRUST_MIN;
}

void set_arm(const int on) {
    arm = (uint8_t)on;
}

/* Counts of resets and clipped steps. */
void counts(uint32_t out[2]) {
    out[0] = takeovers;
    out[1] = clipped;
}

int boot(void) {
    controllerOutOfTreeInit();
    self_test();
    return controllerOutOfTreeTest() && tested;
}

static control_t control; /* of the stabilizer: it outlives a step */

/* One step of the stabilizer. in, in the firmware's units: position, velocity, quaternion (x y z w), gyro; set-point:
 * position, velocity, acceleration, jerk, yaw, quaternion (x y z w), kind (0 none, 1 position and yaw, 2 full state,
 * 3 velocity), age [ms]. out: the four motors of 65535, who flies, and whether motors are ordered one by one. */
void tick(const uint32_t step, const float in[32], int32_t out[6]) {
    static const stab_mode_t position[] = {modeDisable, modeAbs, modeAbs, modeVelocity};
    static const stab_mode_t yaw[] = {modeDisable, modeAbs, modeDisable, modeVelocity};
    const int kind = (int)in[30];
    state_t state = {
        .position = {.x = in[0], .y = in[1], .z = in[2]},
        .velocity = {.x = in[3], .y = in[4], .z = in[5]},
        .attitudeQuaternion = {.x = in[6], .y = in[7], .z = in[8], .w = in[9]},
    };
    const sensorData_t sensors = {.gyro = {.x = in[10], .y = in[11], .z = in[12]}, .acc = {.z = 1.0f}};
    now_ms += 1;
    const setpoint_t setpoint = {
        .timestamp = now_ms - (uint32_t)in[31],
        .position = {.x = in[13], .y = in[14], .z = in[15]},
        .velocity = {.x = in[16], .y = in[17], .z = in[18]},
        .acceleration = {.x = in[19], .y = in[20], .z = in[21]},
        .jerk = {.x = in[22], .y = in[23], .z = in[24]},
        .attitude = {.yaw = in[25]},
        .attitudeQuaternion = {.x = in[26], .y = in[27], .z = in[28], .w = in[29]},
        .mode = {.x = position[kind],
                 .y = position[kind],
                 .z = position[kind],
                 .yaw = yaw[kind],
                 .quat = kind == 2 ? modeAbs : modeDisable},
    };
    /* As the estimators do, for the stock PID: degrees, pitch the other way round. */
    const quaternion_t q = state.attitudeQuaternion;
    const float degree = 57.295780f, sine = 2.0f * (q.w * q.y - q.x * q.z);
    state.attitude.roll = degree * atan2f(2.0f * (q.y * q.z + q.w * q.x), 1.0f - 2.0f * (q.x * q.x + q.y * q.y));
    state.attitude.pitch = -degree * asinf(sine > 1.0f ? 1.0f : sine < -1.0f ? -1.0f : sine);
    state.attitude.yaw = degree * atan2f(2.0f * (q.x * q.y + q.w * q.z), 1.0f - 2.0f * (q.y * q.y + q.z * q.z));

    controllerOutOfTree(&control, &setpoint, &sensors, &state, step);
    motors_thrust_uncapped_t thrust;
    powerDistribution(&control, &thrust);
    for (int i = 0; i < 4; ++i) {
        out[i] = thrust.list[i];
    }
    out[4] = who;
    out[5] = control.controlMode == controlModeForce;
}
