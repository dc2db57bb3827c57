/*
 * @name@.c for firmware that estimates north, east, down and front, right, down: @firmware@.
 *
 * Call @name@_hook_init once at boot, @name@_hook_start when the pilot hands over, then @name@_hook_run in every loop of the
 * motors, whatever its rate: the policy runs every @period_ms@ ms, and its motor commands hold between. While
 * @name@_hook_run does not return @NAME@_FLIES, the firmware's own controller has to fly. README.md says where to put it.
 *
 * The code in this folder may be used without restriction, in any product and under any license.
 */
#ifndef @NAME@_HOOK_H
#define @NAME@_HOOK_H

#include <stdbool.h>
#include <stdint.h>

#include "@name@.h"

#ifdef __cplusplus
extern "C" {
#endif

/* Ages above which the policy does not fly [us]. */
#ifndef @NAME@_POSITION_US
#define @NAME@_POSITION_US @position_us@ /* of the last measured position: the estimate drifts from there on */
#endif
#ifndef @NAME@_ATTITUDE_US
#define @NAME@_ATTITUDE_US @attitude_us@
#endif
#ifndef @NAME@_SETPOINT_US
#define @NAME@_SETPOINT_US @setpoint_us@
#endif

/* A call that is early by this much is on time: clocks and interrupts jitter [us]. */
#ifndef @NAME@_EARLY_US
#define @NAME@_EARLY_US 500
#endif

/* A time that is ahead of now by more than this is not of now: its age is taken as too great [us]. */
#ifndef @NAME@_AHEAD_US
#define @NAME@_AHEAD_US 10000
#endif

/* What @name@_hook_run returns. A hook of zeros, which no @name@_hook_init has seen, is off. */
enum {
    @NAME@_OFF = 0, /* not handed over, or given back by @name@_hook_stop */
    @NAME@_FLIES = 1,
    /* Faults: until the next @name@_hook_start. */
    @NAME@_POSITION_OLD = 2,
    @NAME@_ATTITUDE_OLD = 3,
    @NAME@_SETPOINT_OLD = 4,
    @NAME@_NOT_FINITE = 5, /* the estimate or the set-point; or the quaternion is none */
    @NAME@_SELFTEST = 6,   /* this build does not compute the policy that was verified */
};

/* An estimate. World: north, east, down. Body: front, right, down. */
typedef struct {
    float position_m[3];
    float velocity_m_s[3];
    float attitude[4];    /* unit quaternion w, x, y, z: body to world; @name@_quaternion makes one of roll, pitch, yaw */
    float rates_rad_s[3]; /* about front, right, down; not in deg/s */
    uint32_t position_us; /* when a position was last measured */
    uint32_t attitude_us; /* when the attitude was estimated */
} @name@_estimate;

/* Where to be. */
typedef struct {
    float position_m[3]; /* north, east, down */
    float velocity_m_s[3];
    float acceleration_m_s2[3]; /* of the reference; used for what lies ahead, where the policy looks ahead */
    float jerk_m_s3[3];
    float yaw_rad; /* clockwise from north, seen from above */
    uint32_t received_us;
} @name@_setpoint;

typedef struct {
    @name@_state memory; /* of the policy */
    float motor[4];      /* its last commands */
    uint32_t next_us;
    int who;
    int status; /* of the policy's last step: 1: an input was clipped to its range */
    bool tested;
} @name@_hook;

/* Runs the policy's self-test. Returns whether it passed; if not, the policy never flies. */
bool @name@_hook_init(@name@_hook *hook);

/* Hands over to the policy, which forgets what it remembers, and clears a fault. */
void @name@_hook_start(@name@_hook *hook, uint32_t now_us);

/* Gives control back. */
void @name@_hook_stop(@name@_hook *hook);

/* Whether the policy could fly now: @NAME@_FLIES, or the fault. */
int @name@_hook_check(const @name@_hook *hook, const @name@_estimate *estimate, const @name@_setpoint *setpoint,
                      uint32_t now_us);

/* One loop of the motors. Returns who flies; only with @NAME@_FLIES are commands written to motor: @command@.
 * Order: @order@. Times may wrap around, every 71 minutes: one that never changes is fresh again for a moment then, so do not
 * hand over before each quantity was measured. */
int @name@_hook_run(@name@_hook *hook, const @name@_estimate *estimate, const @name@_setpoint *setpoint, uint32_t now_us,
                    float motor[4]);

/* The quaternion of roll, pitch and yaw [rad], turned in the order yaw, pitch, roll: body front, right, down to north, east,
 * down. */
void @name@_quaternion(float roll_rad, float pitch_rad, float yaw_rad, float attitude[4]);

#ifdef __cplusplus
}
#endif

#endif
