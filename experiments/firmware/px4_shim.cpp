/*
 * PX4's module mc_raptor for a PC: what it needs of PX4, then its own source, then calls for ctypes. MC_RAPTOR_SOURCE is its mc_raptor.cpp,
 * PX4_STORAGEDIR the folder that is its SD card.
 */
#include <array>
#include <cerrno>
#include <cfloat>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstring>
#include <fstream>
#include <iostream>
#include <random>
#include <sstream>
#include <sys/stat.h>
#include <vector>

#define MODULE_NAME "mc_raptor"
#include "px4_stub.hpp"

/* Topics of its own. */
struct tune_control_s {};
struct raptor_input_s {
    static constexpr unsigned ACTION_DIM = 4;
    uint64_t timestamp, timestamp_sample;
    bool active;
    float position[3], orientation[4], linear_velocity[3], angular_velocity[3], previous_action[4];
};
struct raptor_status_s {
    enum : uint8_t {
        EXIT_REASON_NONE, EXIT_REASON_NO_ANGULAR_VELOCITY_UPDATE, EXIT_REASON_NOT_ALL_OBSERVATIONS_SET,
        EXIT_REASON_ANGULAR_VELOCITY_STALE, EXIT_REASON_LOCAL_POSITION_STALE, EXIT_REASON_ATTITUDE_STALE,
        EXIT_REASON_EXECUTOR_STATUS_SOURCE_NOT_CONTROL,
    };
    uint64_t timestamp, timestamp_sample, timestamp_last_vehicle_angular_velocity, timestamp_last_vehicle_local_position,
        timestamp_last_vehicle_attitude, timestamp_last_trajectory_setpoint;
    uint8_t exit_reason;
    uint32_t substep;
    float control_interval, trajectory_setpoint_dt_mean, trajectory_setpoint_dt_max, trajectory_setpoint_dt_max_since_activation,
        internal_reference_position[3], internal_reference_linear_velocity[3];
    bool active, subscription_update_vehicle_status, subscription_update_angular_velocity, subscription_update_local_position,
        subscription_update_attitude, subscription_update_trajectory_setpoint, vehicle_angular_velocity_stale,
        vehicle_local_position_stale, vehicle_attitude_stale, trajectory_setpoint_stale;
};

namespace shim { int gyro_hz = 400, offboard = 0, internal_reference = 0; }
#define DEFINE_PARAMETERS(...)                     \
    Parameter _param_imu_gyro_ratemax{&shim::gyro_hz}, _param_mc_raptor_offboard{&shim::offboard}, \
        _param_mc_raptor_intref{&shim::internal_reference};

#include <matrix/math.hpp>

#define private public
#include MC_RAPTOR_SOURCE
#undef private

/* The module as it flies: a vehicle each. */
extern "C" {
void *boot(int gyro_hz)
{
    shim::gyro_hz = gyro_hz;
    shim::now_us = 1000000;
    Raptor *vehicle = new Raptor();
    if (!vehicle->init()) {
        delete vehicle;
        return nullptr;
    }
    return vehicle;
}

const char *checkpoint(void *vehicle) { return static_cast<Raptor *>(vehicle)->checkpoint_name; }
void be_quiet(int quiet) { shim::quiet = quiet; }

/* What the policy gives for inputs [steps][22], from a reset on: [steps][4]. */
void respond(void *vehicle, int steps, const float *inputs, float *outputs)
{
    Raptor &v = *static_cast<Raptor *>(vehicle);
    using Policy = Raptor::EXECUTOR_CONFIG::POLICY_TEST;
    static Policy::Buffer<false> buffer;
    static Policy::State<false> state;
    using TI = Raptor::TI;
    static rlt::Tensor<rlt::tensor::Specification<float, TI, rlt::tensor::Shape<TI, 1, 22>, false>> input;
    static rlt::Tensor<rlt::tensor::Specification<float, TI, rlt::tensor::Shape<TI, 1, 4>, false>> output;
    rlt::Mode<rlt::nn::layers::gru::NoAutoResetMode<rlt::mode::Evaluation<>>> mode;
    rlt::reset(v.device, v.policy, state, v.rng);
    for (int step = 0; step < steps; ++step) {
        for (TI i = 0; i < 22; ++i) rlt::set(v.device, input, inputs[22 * step + i], 0, i);
        rlt::evaluate_step(v.device, v.policy, input, state, output, buffer, v.rng, mode);
        for (TI i = 0; i < 4; ++i) outputs[4 * step + i] = rlt::get(v.device, output, 0, i);
    }
}

/*
 * One IMU sample at `us`. in [24]: local position x y z and velocity (NED), attitude w x y z (FRD to NED), body rates (FRD),
 * set-point x y z, velocity, yaw, yaw rate (NED); then whether position, attitude and set-point are new, and whether the mode is on.
 * out [5]: actuator_motors 1 to 4, and whether they were published.
 */
void tick(void *vehicle, uint64_t us, const float *in, const int *fresh, float *out)
{
    Raptor &v = *static_cast<Raptor *>(vehicle);
    shim::now_us = us;
    if (v.flightmode_state == Raptor::FlightModeState::UNREGISTERED)
        shim::topic<register_ext_component_reply_s> = {{Raptor::EXT_COMPONENT_REQUEST_ID, true, 3, 23}, true};
    shim::topic<vehicle_status_s> = {{uint8_t(fresh[3] ? 23 : 2), vehicle_status_s::ARMING_STATE_ARMED}, true};
    shim::topic<vehicle_local_position_s> = {{us, true, true, true, true, in[0], in[1], in[2], in[3], in[4], in[5]}, fresh[0] != 0};
    shim::topic<vehicle_attitude_s> = {{us, {in[6], in[7], in[8], in[9]}}, fresh[1] != 0};
    shim::topic<vehicle_angular_velocity_s> = {{us, {in[10], in[11], in[12]}}, true};
    trajectory_setpoint_s setpoint{{in[13], in[14], in[15]}, {in[16], in[17], in[18]}, {}, {}, in[19], in[20]};
    shim::topic<trajectory_setpoint_s> = {setpoint, fresh[2] != 0};
    shim::topic<actuator_motors_s>.fresh = false;
    v.Run();
    for (int i = 0; i < 4; ++i) out[i] = shim::topic<actuator_motors_s>.message.control[i];
    out[4] = shim::topic<actuator_motors_s>.fresh;
}
}
