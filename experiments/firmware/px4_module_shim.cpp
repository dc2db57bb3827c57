/*
 * The emitted module for PX4 for a PC: PX4's side of it, its own source, then calls for ctypes. MODE_SOURCE is its NAME_mode.cpp,
 * MODE its class.
 */
#include <px4_stub.hpp>

#include <cstdlib>

/* Without the library of C++, as in PX4; it is much to link for each mistake. */
void *operator new(std::size_t size) { return std::malloc(size); }
void operator delete(void *pointer) noexcept { std::free(pointer); }
void operator delete(void *pointer, std::size_t) noexcept { std::free(pointer); }

namespace shim { int offboard = 0; }
#define DEFINE_PARAMETERS(...) Parameter _param_offboard{&shim::offboard};

#include MODE_SOURCE

namespace {
constexpr int8_t MODE_ID = 23, ARMING_CHECK_ID = 3;
constexpr uint8_t ASKED = 77; // number of the arming check
}

extern "C" {
void quiet(int on) { shim::quiet = on; }

/* A vehicle; null if its self-test fails. */
void *boot()
{
    MODE *vehicle = new MODE();
    if (!vehicle->init()) {
        delete vehicle;
        return nullptr;
    }
    return vehicle;
}

/* The commander's reply to a registration comes with the next tick: as it is, refused, or another's. */
void registered(int granted, int own)
{
    const uint64_t id = shim::topic<register_ext_component_request_s>.message.request_id;
    register_ext_component_reply_s reply{};
    reply.request_id = own ? id : id + 1;
    reply.success = granted;
    reply.mode_id = MODE_ID;
    reply.arming_check_id = ARMING_CHECK_ID;
    shim::topic<register_ext_component_reply_s> = {reply, true};
}

/*
 * One IMU sample at `us`. in [27]: local position x y z and velocity (NED), attitude w x y z (FRD to NED), body rates (FRD), set-point
 * x y z, velocity, yaw, yaw rate, acceleration, jerk (NED). flags [6]: whether position (2: not valid, 3: dead reckoning), attitude and set-point are new,
 * the mode is on, the vehicle armed, the arming check asked (2: of others, the module is no longer registered).
 * out [7]: actuator_motors 1 to 4, and whether they were published; the answer to the arming check (−1: none); whether the other motors
 * are stopped, none is reversible and the times are told.
 */
void tick(void *vehicle, uint64_t us, const float *in, const int *flags, float *out)
{
    shim::now_us = us + 150; // the work queue runs later
    vehicle_local_position_s position{};
    position.timestamp = us;
    position.xy_valid = position.z_valid = position.v_xy_valid = position.v_z_valid = flags[0] == 1 || flags[0] == 3;
    position.dead_reckoning = flags[0] == 3;
    position.x = in[0];
    position.y = in[1];
    position.z = in[2];
    position.vx = in[3];
    position.vy = in[4];
    position.vz = in[5];
    shim::topic<vehicle_local_position_s> = {position, flags[0] != 0};

    vehicle_attitude_s attitude{};
    attitude.timestamp = us;
    std::memcpy(attitude.q, in + 6, sizeof attitude.q);
    shim::topic<vehicle_attitude_s> = {attitude, flags[1] != 0};

    vehicle_angular_velocity_s rates{};
    rates.timestamp_sample = us;
    std::memcpy(rates.xyz, in + 10, sizeof rates.xyz);
    shim::topic<vehicle_angular_velocity_s> = {rates, true};

    trajectory_setpoint_s setpoint{};
    std::memcpy(setpoint.position, in + 13, sizeof setpoint.position);
    std::memcpy(setpoint.velocity, in + 16, sizeof setpoint.velocity);
    setpoint.yaw = in[19];
    setpoint.yawspeed = in[20];
    std::memcpy(setpoint.acceleration, in + 21, sizeof setpoint.acceleration);
    std::memcpy(setpoint.jerk, in + 24, sizeof setpoint.jerk);
    shim::topic<trajectory_setpoint_s> = {setpoint, flags[2] != 0};

    vehicle_status_s status{};
    status.nav_state = flags[3] ? uint8_t(MODE_ID) : uint8_t(2);
    status.arming_state = flags[4] ? uint8_t(vehicle_status_s::ARMING_STATE_ARMED) : uint8_t(1);
    shim::topic<vehicle_status_s> = {status, true};

    arming_check_request_s request{};
    request.request_id = ASKED;
    request.valid_registrations_mask = flags[5] == 2 ? 0 : 1u << ARMING_CHECK_ID;
    shim::topic<arming_check_request_s> = {request, flags[5] != 0};
    shim::topic<arming_check_reply_s>.fresh = shim::topic<actuator_motors_s>.fresh = false;
    shim::topic<register_ext_component_request_s>.fresh = shim::topic<vehicle_control_mode_s>.fresh = false;

    static_cast<px4::ScheduledWorkItem *>(static_cast<MODE *>(vehicle))->Run();

    const actuator_motors_s &motors = shim::topic<actuator_motors_s>.message;
    const arming_check_reply_s &reply = shim::topic<arming_check_reply_s>.message;
    bool others = motors.reversible_flags == 0 && motors.timestamp_sample == us && motors.timestamp == shim::now_us;
    for (int i = 0; i < motors.NUM_CONTROLS; ++i) {
        if (i < 4) out[i] = motors.control[i];
        else others = others && std::isnan(motors.control[i]);
    }
    out[4] = shim::topic<actuator_motors_s>.fresh;
    const bool ours = reply.request_id == ASKED && reply.registration_id == ARMING_CHECK_ID && reply.mode_req_local_position &&
        reply.mode_req_attitude && reply.mode_req_prevent_arming && reply.mode_req_angular_velocity && reply.mode_req_local_alt && !reply.mode_req_manual_control;
    out[5] = !shim::topic<arming_check_reply_s>.fresh ? -1.0f : ours && reply.can_arm_and_run ? 1.0f : 0.0f;
    out[6] = others;
}

/* What was published with the last tick: a registration as it should be; the mode's configuration with all controllers off. */
int asked()
{
    const register_ext_component_request_s &of = shim::topic<register_ext_component_request_s>.message;
    return shim::topic<register_ext_component_request_s>.fresh && of.register_mode && of.register_arming_check &&
        of.request_offboard_setpoints && of.enable_replace_internal_mode == (shim::offboard != 0) &&
        of.replace_internal_mode == vehicle_status_s::NAVIGATION_STATE_OFFBOARD && of.name[sizeof of.name - 1] == '\0';
}
int configured()
{
    const vehicle_control_mode_s &of = shim::topic<vehicle_control_mode_s>.message;
    return shim::topic<vehicle_control_mode_s>.fresh && of.source_id == MODE_ID && !of.flag_multicopter_position_control_enabled &&
        !of.flag_control_manual_enabled && !of.flag_control_offboard_enabled && !of.flag_control_position_enabled &&
        !of.flag_control_velocity_enabled && !of.flag_control_altitude_enabled && !of.flag_control_climb_rate_enabled &&
        !of.flag_control_acceleration_enabled && !of.flag_control_attitude_enabled && !of.flag_control_rates_enabled &&
        !of.flag_control_allocation_enabled && !of.flag_control_termination_enabled;
}
const char *name() { return shim::topic<register_ext_component_request_s>.message.name; }
void in_place_of_offboard(int on) { shim::offboard = on; }

/* Whether a stop unregisters the mode. */
int stopped(void *vehicle)
{
    static_cast<MODE *>(vehicle)->stopped = true;
    static_cast<px4::ScheduledWorkItem *>(static_cast<MODE *>(vehicle))->Run();
    const unregister_ext_component_s &of = shim::topic<unregister_ext_component_s>.message;
    return of.mode_id == MODE_ID && of.arming_check_id == ARMING_CHECK_ID && std::strcmp(of.name, name()) == 0;
}
}
