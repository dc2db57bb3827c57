/* In Indiflight this takes the place of src/main/flight/neural_controllers/nn_controller.h. */
#ifndef NN_CONTROLLER_H
#define NN_CONTROLLER_H

extern const float start_pos[3]; /* north, east, down [m]: the policy is activated within 0.5 m of it */
extern const float start_yaw;    /* [rad] */

void nn_reset(void);
void nn_control(const float world_state[16], float motor_cmds[4]);

#endif
