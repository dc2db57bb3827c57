#pragma once
#include <stdint.h>
typedef uint32_t TickType_t;
#define M2T(ms) ((unsigned int)(ms))
