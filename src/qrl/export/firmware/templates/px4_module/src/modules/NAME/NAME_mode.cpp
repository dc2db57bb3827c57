/*
 * The policy of @name@.c as a flight mode of PX4: @name@_mode.hpp.
 *
 * The code in this folder may be used without restriction, in any product and under any license.
 */
#include "@name@_mode.hpp"

#include <math.h>
#include <string.h>

ModuleBase::Descriptor @class@::desc{task_spawn, custom_command, print_usage};

@class@::@class@() :
	ModuleParams(nullptr),
	ScheduledWorkItem(MODULE_NAME, px4::wq_configurations::rate_ctrl)
{
	_actuator_motors_pub.advertise();
}

@class@::~@class@()
{
	perf_free(_loop_perf);
}

bool @class@::init()
{
	if (!@name@_hook_init(&_hook)) {
		PX4_ERR("self-test failed: this build does not compute the policy that was verified");
		return false;
	}

	if (!_vehicle_angular_velocity_sub.registerCallback()) {
		PX4_ERR("callback registration failed");
		return false;
	}

	return true;
}

void @class@::registration(const hrt_abstime now_us)
{
	register_ext_component_reply_s reply;

	while (_mode_id < 0 && _register_ext_component_reply_sub.update(&reply)) {
		if (reply.request_id == REQUEST_ID && reply.success) {
			_mode_id = reply.mode_id;
			_arming_check_id = reply.arming_check_id;
			configure();
			PX4_INFO("registered as mode %d", _mode_id);
		}
	}

	// The commander may start later, and refuses while the vehicle is armed.
	if (_mode_id < 0 && (_requested_us == 0 || now_us > _requested_us + REQUEST_US)) {
		register_ext_component_request_s request{};
		request.timestamp = hrt_absolute_time();
		request.request_id = REQUEST_ID;
		strncpy(request.name, "@mode@", sizeof(request.name) - 1);
		request.px4_ros2_api_version = register_ext_component_request_s::LATEST_PX4_ROS2_API_VERSION;
		request.register_arming_check = true;
		request.register_mode = true;
		request.enable_replace_internal_mode = _param_offboard.get();
		request.replace_internal_mode = vehicle_status_s::NAVIGATION_STATE_OFFBOARD;
		request.request_offboard_setpoints = true;
		_register_ext_component_request_pub.publish(request);
		_requested_us = now_us;
	}
}

// Turns off PX4's controllers and its control allocation in this mode: all flags are false.
void @class@::configure()
{
	vehicle_control_mode_s config{};
	config.timestamp = hrt_absolute_time();
	config.source_id = static_cast<uint8_t>(_mode_id);
	_config_control_setpoints_pub.publish(config);
}

void @class@::unregister()
{
	unregister_ext_component_s request{};
	request.timestamp = hrt_absolute_time();
	strncpy(request.name, "@mode@", sizeof(request.name) - 1);
	request.arming_check_id = _arming_check_id;
	request.mode_id = _mode_id;
	request.mode_executor_id = -1;
	_unregister_ext_component_pub.publish(request);
}

void @class@::reply_to_arming_check(const hrt_abstime now_us)
{
	arming_check_request_s request;

	if (_mode_id < 0 || !_arming_check_request_sub.update(&request)) {
		return;
	}

	// A request of before the registration does not list it. Several in a row: the commander has removed it.
	if (request.valid_registrations_mask & (1u << _arming_check_id)) {
		_unlisted = 0;

	} else if (++_unlisted >= REMOVED) { // to be asked for anew
		_mode_id = _arming_check_id = -1;
		_unlisted = 0;
		_on = false;
		return;
	}

	const int able = @name@_hook_check(&_hook, &_estimate, &_setpoint, static_cast<uint32_t>(now_us));
	arming_check_reply_s reply{};
	reply.timestamp = hrt_absolute_time();
	reply.request_id = request.request_id;
	reply.registration_id = static_cast<uint8_t>(_arming_check_id);
	reply.health_component_index = arming_check_reply_s::HEALTH_COMPONENT_INDEX_NONE;
	// A fault in flight stays one until the mode is left, so that the commander learns of it and takes another mode.
	reply.can_arm_and_run = able == @NAME@_FLIES && (!_on || _who == @NAME@_FLIES);
	reply.mode_req_prevent_arming = true; // PX4 does not see a landing without its own controllers' orders
	reply.mode_req_angular_velocity = true;
	reply.mode_req_attitude = true;
	reply.mode_req_local_alt = true;
	reply.mode_req_local_position = true;
	_arming_check_reply_pub.publish(reply);
}

// Of a time in 64 bits, one in 32 for the hook: what is further from now than it can say stays far.
static uint32_t stamp(const hrt_abstime then_us, const hrt_abstime now_us)
{
	const bool ahead = then_us > now_us;
	const hrt_abstime apart_us = ahead ? then_us - now_us : now_us - then_us;
	const uint32_t most_us = apart_us < INT32_MAX ? static_cast<uint32_t>(apart_us) : INT32_MAX;
	return static_cast<uint32_t>(now_us) + (ahead ? most_us : 0u - most_us);
}

void @class@::estimate(const vehicle_angular_velocity_s &rates, const hrt_abstime now_us)
{
	vehicle_attitude_s attitude;
	vehicle_local_position_s position;

	if (_vehicle_attitude_sub.update(&attitude)) {
		memcpy(_estimate.attitude, attitude.q, sizeof(_estimate.attitude)); // w, x, y, z, as PX4's
		_attitude_us = attitude.timestamp;
	}

	if (_vehicle_local_position_sub.update(&position) && position.xy_valid && position.z_valid && position.v_xy_valid
	    && position.v_z_valid && !position.dead_reckoning) {
		_estimate.position_m[0] = position.x;
		_estimate.position_m[1] = position.y;
		_estimate.position_m[2] = position.z;
		_estimate.velocity_m_s[0] = position.vx;
		_estimate.velocity_m_s[1] = position.vy;
		_estimate.velocity_m_s[2] = position.vz;
		_position_us = position.timestamp;
	}

	memcpy(_estimate.rates_rad_s, rates.xyz, sizeof(_estimate.rates_rad_s));
	_estimate.position_us = stamp(_position_us, now_us);
	_estimate.attitude_us = stamp(_attitude_us, now_us);
}

void @class@::hold()
{
	const float *q = _estimate.attitude;
	_setpoint = {};
	memcpy(_setpoint.position_m, _estimate.position_m, sizeof(_setpoint.position_m));
	_setpoint.yaw_rad = atan2f(2.0f * (q[0] * q[3] + q[1] * q[2]), 1.0f - 2.0f * (q[2] * q[2] + q[3] * q[3]));
	_asked = false;
}

static float or_zero(const float value)
{
	return PX4_ISFINITE(value) ? value : 0.0f;
}

void @class@::follow(const trajectory_setpoint_s &asked, const hrt_abstime now_us)
{
	for (int i = 0; i < 3; ++i) {
		if (!PX4_ISFINITE(asked.position[i])) { // for PX4: not controlled, which the policy cannot
			return;
		}
	}

	for (int i = 0; i < 3; ++i) {
		_setpoint.position_m[i] = asked.position[i];
		_setpoint.velocity_m_s[i] = or_zero(asked.velocity[i]);
		_setpoint.acceleration_m_s2[i] = or_zero(asked.acceleration[i]);
		_setpoint.jerk_m_s3[i] = or_zero(asked.jerk[i]);
	}

	if (PX4_ISFINITE(asked.yaw)) {
		_setpoint.yaw_rad = asked.yaw;
	}

	_asked = true;
	_asked_us = now_us;
}

void @class@::publish(const float motor[4], const hrt_abstime now_us)
{
	actuator_motors_s actuator_motors{};
	actuator_motors.timestamp = hrt_absolute_time();
	actuator_motors.timestamp_sample = now_us;

	for (int i = 0; i < actuator_motors_s::NUM_CONTROLS; ++i) {
		actuator_motors.control[i] = i < 4 ? motor[i] : NAN; // the hook has PX4's order
	}

	_actuator_motors_pub.publish(actuator_motors);
}

void @class@::Run()
{
	if (should_exit()) {
		_vehicle_angular_velocity_sub.unregisterCallback();

		if (_mode_id >= 0) {
			unregister();
		}

		ScheduleClear();
		exit_and_cleanup(desc);
		return;
	}

	vehicle_angular_velocity_s rates;

	if (!_vehicle_angular_velocity_sub.update(&rates)) {
		return;
	}

	perf_begin(_loop_perf);
	const hrt_abstime now_us = rates.timestamp_sample; // the policy's clock: free of this queue's delays
	registration(now_us);
	estimate(rates, now_us);

	trajectory_setpoint_s asked;
	const bool asks = _trajectory_setpoint_sub.update(&asked);
	const bool before = _on;
	vehicle_status_s status;

	if (_vehicle_status_sub.update(&status)) {
		_on = _mode_id >= 0 && status.nav_state == _mode_id && status.arming_state == vehicle_status_s::ARMING_STATE_ARMED;
	}

	if (_on && !before) {
		@name@_hook_start(&_hook, static_cast<uint32_t>(now_us)); // forgets what the policy remembers
		hold(); // a set-point of before was for another mode

	} else if (!_on) {
		@name@_hook_stop(&_hook);
		_setpoint = {}; // one that was not finite is forgotten with its fault

	} else if (asks) {
		follow(asked, now_us);
	}

	if (_on && _asked && now_us > _asked_us + @NAME@_SETPOINT_US) {
		hold();
	}

	_setpoint.received_us = static_cast<uint32_t>(now_us); // its age is seen to here

	float motor[4];
	const uint32_t due_us = _hook.next_us;
	const int who = @name@_hook_run(&_hook, &_estimate, &_setpoint, static_cast<uint32_t>(now_us), motor);

	if (who == @NAME@_FLIES && _hook.next_us != due_us) { // a step; between, outputs hold the last command
		publish(motor, now_us);
		_steps += 1;
		_clipped += _hook.status == 1;
	}

	if (who != @NAME@_FLIES && _who == @NAME@_FLIES && _on) { // a fault: no torque until PX4 takes another mode
		const float mean = 0.25f * (_hook.motor[0] + _hook.motor[1] + _hook.motor[2] + _hook.motor[3]);
		const float level[4] = {mean, mean, mean, mean};
		publish(level, now_us);
	}

	tell(who);
	reply_to_arming_check(now_us);
	perf_end(_loop_perf);
}

static const char *meaning(const int who)
{
	static const char *const meanings[] = {
		"policy flies", "off", "FAULT: local position old", "FAULT: attitude old", "FAULT: set-point old",
		"FAULT: input not finite", "FAULT: self-test failed",
	};
	return meanings[who];
}

void @class@::tell(const int who)
{
	if (who != _who) {
		PX4_INFO("%s", meaning(who));
	}

	_who = who;
}

int @class@::task_spawn(int argc, char *argv[])
{
	@class@ *instance = new @class@();

	if (instance) {
		desc.object.store(instance);
		desc.task_id = task_id_is_work_queue;

		if (instance->init()) {
			return PX4_OK;
		}

	} else {
		PX4_ERR("alloc failed");
	}

	delete instance;
	desc.object.store(nullptr);
	desc.task_id = -1;
	return PX4_ERROR;
}

int @class@::print_status()
{
	PX4_INFO_RAW("%s; mode %d, %u steps, %u with an input clipped to its range\n", meaning(_who), _mode_id, (unsigned)_steps,
		     (unsigned)_clipped);
	perf_print_counter(_loop_perf);
	return 0;
}

int @class@::custom_command(int argc, char *argv[])
{
	return print_usage("unknown command");
}

int @class@::print_usage(const char *reason)
{
	if (reason) {
		PX4_WARN("%s\n", reason);
	}

	PRINT_MODULE_DESCRIPTION(
		R"DESCR_STR(
### Description
A flight mode that a trained policy flies: @description@

)DESCR_STR");

	PRINT_MODULE_USAGE_NAME("@name@", "controller");
	PRINT_MODULE_USAGE_COMMAND("start");
	PRINT_MODULE_USAGE_DEFAULT_COMMANDS();
	return 0;
}

extern "C" __EXPORT int @name@_main(int argc, char *argv[])
{
	return ModuleBase::main(@class@::desc, argc, argv);
}
