#ifndef IO_EXTERNAL_POS_H
#define IO_EXTERNAL_POS_H
#include "drivers/time.h"
typedef union {
    float A[3];
    struct {
        float X, Y, Z;
    } V;
} fp_vector_t;
typedef struct {
    fp_vector_t pos, vel;
    float psi;
} pos_setpoint_ned_t;
extern timeUs_t extLatestMsgTime;
extern pos_setpoint_ned_t posSpNed;
#endif
