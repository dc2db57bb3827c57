#ifndef DRIVERS_TIME_H
#define DRIVERS_TIME_H
#include <stdint.h>
typedef uint32_t timeUs_t;
timeUs_t micros(void);
#endif
