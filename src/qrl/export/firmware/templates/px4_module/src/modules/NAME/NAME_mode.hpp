/*
 * A flight mode of PX4 @release@ that the policy of @name@.c flies: position and heading to actuator_motors, in place of PX4's
 * controllers and control allocation. @name@_hook.h has the frames, the clock and the time-outs; here are the topics.
 *
 * The code in this folder may be used without restriction, in any product and under any license.
 */
#pragma once

#include <px4_platform_common/defines.h>
#include <px4_platform_common/module.h>
#include <px4_platform_common/module_params.h>
#include <px4_platform_common/px4_work_queue/ScheduledWorkItem.hpp>

#include <drivers/drv_hrt.h>
#include <lib/perf/perf_counter.h>

#include <uORB/Publication.hpp>
#include <uORB/Subscription.hpp>
#include <uORB/SubscriptionCallback.hpp>
#include <uORB/topics/actuator_motors.h>
#include <uORB/topics/arming_check_reply.h>
#include <uORB/topics/arming_check_request.h>
#include <uORB/topics/register_ext_component_reply.h>
#include <uORB/topics/register_ext_component_request.h>
#include <uORB/topics/trajectory_setpoint.h>
#include <uORB/topics/unregister_ext_component.h>
#include <uORB/topics/vehicle_angular_velocity.h>
#include <uORB/topics/vehicle_attitude.h>
#include <uORB/topics/vehicle_control_mode.h>
#include <uORB/topics/vehicle_local_position.h>
#include <uORB/topics/vehicle_status.h>

#include "@name@_hook.h"

class @class@ final : public ModuleBase, public ModuleParams, public px4::ScheduledWorkItem
{
public:
	static Descriptor desc;

	@class@();
	~@class@() override;

	// Of ModuleBase.
	static int task_spawn(int argc, char *argv[]);
	static int custom_command(int argc, char *argv[]);
	static int print_usage(const char *reason = nullptr);

	/** Whether the self-test passed; if not, the mode is not registered. */
	bool init();

	int print_status() override;

private:
	static constexpr uint64_t REQUEST_ID = @request_id@; // of the registration; of the module's name
	static constexpr hrt_abstime REQUEST_US = 1000000; // between requests, until one is granted
	static constexpr int REMOVED = 3; // arming checks in a row that do not list the mode

	void Run() override;

	void registration(hrt_abstime now_us);
	void configure();
	void unregister();
	void reply_to_arming_check(hrt_abstime now_us);

	/** Reads the estimate, of which all but the body rates may be old. */
	void estimate(const vehicle_angular_velocity_s &rates, hrt_abstime now_us);

	/** Makes the place and the heading of now the set-point. */
	void hold();

	/** Follows a set-point of position; a velocity, acceleration or jerk that is not given is 0, a heading is kept. */
	void follow(const trajectory_setpoint_s &asked, hrt_abstime now_us);

	void publish(const float motor[4], hrt_abstime now_us);

	/** Says on the console who flies, when that changes. */
	void tell(int who);

	uORB::SubscriptionCallbackWorkItem _vehicle_angular_velocity_sub{this, ORB_ID(vehicle_angular_velocity)};
	uORB::Subscription _vehicle_attitude_sub{ORB_ID(vehicle_attitude)};
	uORB::Subscription _vehicle_local_position_sub{ORB_ID(vehicle_local_position)};
	uORB::Subscription _trajectory_setpoint_sub{ORB_ID(trajectory_setpoint)};
	uORB::Subscription _vehicle_status_sub{ORB_ID(vehicle_status)};
	uORB::Subscription _register_ext_component_reply_sub{ORB_ID(register_ext_component_reply)};
	uORB::Subscription _arming_check_request_sub{ORB_ID(arming_check_request)};

	uORB::Publication<actuator_motors_s> _actuator_motors_pub{ORB_ID(actuator_motors)};
	uORB::Publication<register_ext_component_request_s> _register_ext_component_request_pub{ORB_ID(register_ext_component_request)};
	uORB::Publication<unregister_ext_component_s> _unregister_ext_component_pub{ORB_ID(unregister_ext_component)};
	uORB::Publication<vehicle_control_mode_s> _config_control_setpoints_pub{ORB_ID(config_control_setpoints)};
	uORB::Publication<arming_check_reply_s> _arming_check_reply_pub{ORB_ID(arming_check_reply)};

	@name@_hook _hook{};
	@name@_estimate _estimate{};
	@name@_setpoint _setpoint{};

	hrt_abstime _position_us{0}; // of the last estimates and set-point
	hrt_abstime _attitude_us{0};
	hrt_abstime _asked_us{0};
	bool _asked{false}; // the set-point came from outside; else it is the place that is held

	bool _on{false}; // the mode is on, and the vehicle armed
	int _who{@NAME@_OFF};
	uint32_t _steps{0};
	uint32_t _clipped{0}; // steps in which an input was clipped to its range

	hrt_abstime _requested_us{0};
	int8_t _mode_id{-1};
	int8_t _arming_check_id{-1};
	int _unlisted{0}; // such arming checks until now

	perf_counter_t _loop_perf{perf_alloc(PC_ELAPSED, MODULE_NAME": cycle")};

	DEFINE_PARAMETERS(
		(ParamBool<px4::params::@parameter@>) _param_offboard
	)
};
