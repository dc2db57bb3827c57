/* For tests: the part of the types of crazyflie-firmware that the app uses, with its names and units. Written for this. */
#pragma once
#include <stdbool.h>
#include <stdint.h>

#define RATE_MAIN_LOOP 1000
#define STABILIZER_NR_OF_MOTORS 4

typedef uint32_t stabilizerStep_t;

typedef struct {
    float x, y, z;
} Axis3f;

typedef struct {
    uint32_t timestamp;
    float x, y, z;
} vector_t;
typedef vector_t point_t, velocity_t, acc_t, jerk_t;

typedef struct {
    uint32_t timestamp;
    float roll, pitch, yaw; /* deg */
} attitude_t;

typedef struct {
    float x, y, z, w;
} quaternion_t;

typedef struct {
    Axis3f acc;  /* g */
    Axis3f gyro; /* deg/s */
} sensorData_t;

typedef struct {
    attitude_t attitude; /* pitch the other way round */
    quaternion_t attitudeQuaternion;
    point_t position;    /* m */
    velocity_t velocity; /* m/s */
} state_t;

typedef enum { modeDisable, modeAbs, modeVelocity } stab_mode_t;

typedef struct {
    stab_mode_t x, y, z, roll, pitch, yaw, quat;
} setpoint_mode_t;

typedef struct {
    uint32_t timestamp; /* ms */
    attitude_t attitude;
    attitude_t attitudeRate; /* deg/s */
    quaternion_t attitudeQuaternion;
    float thrust;
    point_t position;     /* m */
    velocity_t velocity;  /* m/s */
    acc_t acceleration;   /* m/s^2 */
    jerk_t jerk;          /* m/s^3 */
    setpoint_mode_t mode;
} setpoint_t;

typedef enum { controlModeLegacy, controlModeForceTorque, controlModeForce } control_mode_t;

typedef struct {
    union {
        struct {
            int16_t roll, pitch, yaw;
            float thrust;
        };
        float normalizedForces[STABILIZER_NR_OF_MOTORS];
    };
    control_mode_t controlMode;
} control_t;

typedef union {
    int32_t list[STABILIZER_NR_OF_MOTORS];
} motors_thrust_uncapped_t;
