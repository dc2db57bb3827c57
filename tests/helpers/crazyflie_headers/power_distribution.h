#pragma once
#include "stabilizer_types.h"
void powerDistribution(const control_t *control, motors_thrust_uncapped_t *thrust);
