#ifndef FLIGHT_NN_CONTROL_H
#define FLIGHT_NN_CONTROL_H
void nn_deactivate(void);
#endif
