/*
 * What modules of PX4 need of it, for a PC: uORB with one vehicle's topics, its work queue, parameters and console. The headers that
 * they include of PX4 are empty. A shim includes this, then the module.
 */
#pragma once
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstring>

#define PX4_INFO(...) (std::snprintf(shim::said, sizeof shim::said, __VA_ARGS__), shim::say("info"))
#define PX4_WARN(...) (std::snprintf(shim::said, sizeof shim::said, __VA_ARGS__), shim::say("warn"))
#define PX4_ERR(...) (std::snprintf(shim::said, sizeof shim::said, __VA_ARGS__), shim::say("error"))
#define PX4_INFO_RAW PX4_INFO
#define PX4_ISFINITE(x) std::isfinite(x)
#define PX4_OK 0
#define PX4_ERROR (-1)
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
void say(const char *level)
{
    if (!quiet) std::fprintf(stderr, "%s: %s\n", level, said);
}
}
static hrt_abstime hrt_absolute_time() { return shim::now_us; }

/* Topics: the fields that the modules use, as PX4's msg/ names them. PX4_TOPICS: a file that has them instead. */
#ifdef PX4_TOPICS
#include PX4_TOPICS
#else
struct vehicle_local_position_s { uint64_t timestamp; bool xy_valid, z_valid, v_xy_valid, v_z_valid, dead_reckoning; float x, y, z, vx, vy, vz; };
struct vehicle_attitude_s { uint64_t timestamp; float q[4]; };
struct vehicle_angular_velocity_s { uint64_t timestamp_sample; float xyz[3]; };
struct trajectory_setpoint_s { float position[3], velocity[3], acceleration[3], jerk[3], yaw, yawspeed; };
struct vehicle_status_s {
    static constexpr uint8_t NAVIGATION_STATE_OFFBOARD = 14, ARMING_STATE_ARMED = 2;
    uint8_t nav_state, arming_state;
};
struct actuator_motors_s {
    static constexpr uint8_t NUM_CONTROLS = 12;
    uint64_t timestamp, timestamp_sample;
    uint16_t reversible_flags;
    float control[12];
};
struct register_ext_component_request_s {
    static constexpr uint16_t LATEST_PX4_ROS2_API_VERSION = 1;
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
        flag_control_position_enabled, flag_control_velocity_enabled, flag_control_altitude_enabled, flag_control_climb_rate_enabled,
        flag_control_acceleration_enabled, flag_control_attitude_enabled, flag_control_rates_enabled, flag_control_allocation_enabled,
        flag_control_termination_enabled;
};
struct arming_check_request_s { uint64_t timestamp; uint8_t request_id; uint32_t valid_registrations_mask; };
struct arming_check_reply_s {
    static constexpr uint8_t HEALTH_COMPONENT_INDEX_NONE = 0;
    uint64_t timestamp;
    uint8_t request_id, registration_id, health_component_index, num_events;
    bool can_arm_and_run, mode_req_angular_velocity, mode_req_local_position, mode_req_attitude, mode_req_local_alt,
        mode_req_home_position, mode_req_mission, mode_req_global_position, mode_req_prevent_arming, mode_req_manual_control;
};
#endif

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
    bool stopped = false;
    bool should_exit() const { return stopped; }
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
