/*
 * PX4's module mc_raptor for a PC: what it needs of PX4, then its own source, then calls for ctypes. MC_RAPTOR_SOURCE is its mc_raptor.cpp,
 * PX4_STORAGEDIR the folder that is its SD card. The headers that it includes of PX4 are empty: all of that is here.
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

#define PX4_INFO(...) (std::snprintf(shim::said, sizeof shim::said, __VA_ARGS__), shim::say("info"))
#define PX4_WARN(...) (std::snprintf(shim::said, sizeof shim::said, __VA_ARGS__), shim::say("warn"))
#define PX4_ERR(...) (std::snprintf(shim::said, sizeof shim::said, __VA_ARGS__), shim::say("error"))
#define PX4_INFO_RAW PX4_INFO
#define PX4_ISFINITE(x) std::isfinite(x)
#define PX4_OK 0
#define PX4_ERROR (-1)
#define MODULE_NAME "mc_raptor"
#define __EXPORT
#define PRINT_MODULE_DESCRIPTION(...)
#define PRINT_MODULE_USAGE_NAME(...)
#define PRINT_MODULE_USAGE_COMMAND(...)
#define PRINT_MODULE_USAGE_COMMAND_DESCR(...)
#define PRINT_MODULE_USAGE_ARG(...)
#define PRINT_MODULE_USAGE_DEFAULT_COMMANDS(...)

using hrt_abstime = uint64_t;
namespace time_literals {}
namespace shim {
char said[512];
bool quiet = false;
hrt_abstime now_us;
int gyro_hz = 400;
void say(const char *level)
{
    if (!quiet) std::fprintf(stderr, "%s: %s\n", level, said);
}
}
static hrt_abstime hrt_absolute_time() { return shim::now_us; }

/* Topics: the fields that the module uses, as PX4's msg/ names them. */
struct vehicle_local_position_s { float x, y, z, vx, vy, vz; };
struct vehicle_attitude_s { float q[4]; };
struct vehicle_angular_velocity_s { uint64_t timestamp_sample; float xyz[3]; };
struct trajectory_setpoint_s { float position[3], velocity[3], yaw, yawspeed; };
struct vehicle_status_s { static constexpr uint8_t NAVIGATION_STATE_OFFBOARD = 14; uint8_t nav_state; };
struct actuator_motors_s { static constexpr unsigned NUM_CONTROLS = 12; uint64_t timestamp, timestamp_sample; float control[12]; };
struct register_ext_component_request_s {
    static constexpr unsigned LATEST_PX4_ROS2_API_VERSION = 1;
    uint64_t timestamp, request_id;
    char name[25];
    uint16_t px4_ros2_api_version;
    bool register_arming_check, register_mode, enable_replace_internal_mode, request_offboard_setpoints;
    uint8_t replace_internal_mode;
};
struct register_ext_component_reply_s { uint64_t request_id; bool success; int8_t arming_check_id, mode_id; };
struct unregister_ext_component_s { uint64_t timestamp; char name[25]; int8_t arming_check_id, mode_id, mode_executor_id; };
struct vehicle_control_mode_s {
    uint64_t timestamp;
    uint8_t source_id;
    bool flag_multicopter_position_control_enabled, flag_control_manual_enabled, flag_control_offboard_enabled,
        flag_control_position_enabled, flag_control_climb_rate_enabled, flag_control_allocation_enabled,
        flag_control_termination_enabled;
};
struct arming_check_request_s { uint64_t timestamp; uint8_t request_id; };
struct arming_check_reply_s {
    static constexpr uint8_t HEALTH_COMPONENT_INDEX_NONE = 0;
    uint64_t timestamp;
    uint8_t request_id, registration_id, health_component_index, num_events;
    bool can_arm_and_run, mode_req_angular_velocity, mode_req_local_position, mode_req_attitude, mode_req_local_alt,
        mode_req_home_position, mode_req_mission, mode_req_global_position, mode_req_prevent_arming, mode_req_manual_control;
};
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

/* One topic each, whoever publishes: `fresh` until it is read. */
namespace shim {
template <typename M>
struct Topic {
    M message{};
    bool fresh = false;
};
template <typename M>
Topic<M> topic;
struct Any {
    void *message;
    bool *fresh;
    size_t size;
};
template <typename M>
Any any() { return {&topic<M>.message, &topic<M>.fresh, sizeof(M)}; }
}
#define ORB_ID(name) shim::any<name##_s>()
namespace uORB {
struct Subscription {
    shim::Any of;
    explicit Subscription(shim::Any of) : of(of) {}
    bool updated() const { return *of.fresh; }
    bool copy(void *to)
    {
        std::memcpy(to, of.message, of.size);
        *of.fresh = false;
        return true;
    }
    bool update(void *to) { return updated() && copy(to); }
};
struct SubscriptionCallbackWorkItem : Subscription {
    SubscriptionCallbackWorkItem(void *, shim::Any of) : Subscription(of) {}
    bool registerCallback() { return true; }
    void unregisterCallback() {}
};
struct Named { Named(shim::Any) {} };
template <typename M>
struct Publication {
    explicit Publication(shim::Any) {}
    bool advertise() { return true; }
    bool publish(const M &message)
    {
        shim::topic<M> = {message, true};
        return true;
    }
};
}
/* What is published under another name than its type's. */
struct config_control_setpoints_s {};

using perf_counter_t = void *;
enum { PC_ELAPSED, PC_INTERVAL };
static perf_counter_t perf_alloc(int, const char *) { return nullptr; }
static void perf_free(perf_counter_t) {}
static void perf_begin(perf_counter_t) {}
static void perf_end(perf_counter_t) {}
static void perf_count(perf_counter_t) {}
static void perf_print_counter(perf_counter_t) {}

static constexpr int task_id_is_work_queue = -2;
struct ModuleBase {
    struct Object {
        void *held = nullptr;
        void store(void *pointer) { held = pointer; }
    };
    struct Descriptor {
        int (*task_spawn)(int, char **);
        int (*custom_command)(int, char **);
        int (*print_usage)(const char *);
        Object object{};
        int task_id = -1;
    };
    static int main(Descriptor &, int, char **) { return 0; }
    virtual ~ModuleBase() = default;
    virtual int print_status() { return 0; }
    bool should_exit() const { return false; }
    void exit_and_cleanup(Descriptor &) {}
};
template <typename M>
M *get_instance(ModuleBase::Descriptor &of) { return static_cast<M *>(of.object.held); }
struct ModuleParams {
    explicit ModuleParams(void *) {}
    virtual ~ModuleParams() = default;
};
namespace px4 {
namespace wq_configurations { static constexpr int rate_ctrl = 0; }
struct ScheduledWorkItem {
    ScheduledWorkItem(const char *, int) {}
    virtual ~ScheduledWorkItem() = default;
    virtual void Run() = 0;
    void ScheduleClear() {}
};
}
struct Parameter {
    int *value;
    int get() const { return *value; }
};
namespace shim { int offboard = 0, internal_reference = 0; }
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
    shim::topic<vehicle_status_s> = {{uint8_t(fresh[3] ? 23 : 2)}, true};
    shim::topic<vehicle_local_position_s> = {{in[0], in[1], in[2], in[3], in[4], in[5]}, fresh[0] != 0};
    shim::topic<vehicle_attitude_s> = {{{in[6], in[7], in[8], in[9]}}, fresh[1] != 0};
    shim::topic<vehicle_angular_velocity_s> = {{us, {in[10], in[11], in[12]}}, true};
    trajectory_setpoint_s setpoint{{in[13], in[14], in[15]}, {in[16], in[17], in[18]}, in[19], in[20]};
    shim::topic<trajectory_setpoint_s> = {setpoint, fresh[2] != 0};
    shim::topic<actuator_motors_s>.fresh = false;
    v.Run();
    for (int i = 0; i < 4; ++i) out[i] = shim::topic<actuator_motors_s>.message.control[i];
    out[4] = shim::topic<actuator_motors_s>.fresh;
}
}
