"""Mistakes to put into the sources of the module for PX4: each must show in a flight, or break a rule."""

from experiments.firmware.crazyflie_loop import Mutant


def mistakes(name: str) -> dict[str, list[Mutant]]:
    """In the source of the mode, and of the hook: order, signs and units, then rules."""
    take = "memcpy(_estimate.attitude, attitude.q, sizeof(_estimate.attitude));"
    by_hand = "for (int i = 0; i < 4; ++i) {{ _estimate.attitude[i] = {}; }}".format
    p = "position_m[{}] = position.{}".format
    motor, heading = "i < 4 ? motor[i]", "_setpoint.yaw_rad = asked.yaw"
    able = f"able == {name.upper()}_FLIES"
    on = "status.nav_state == _mode_id"
    found = {
        "north and east swapped": [(p(0, "x"), p(0, "y")), (p(1, "y;"), p(1, "x;"))],
        "height the other way": [("= position.z", "= -position.z")],
        "east the other way": [("= position.y", "= -position.y")],
        "velocity down the other way": [("= position.vz", "= -position.vz")],
        "quaternion x y z w": [(take, by_hand("attitude.q[(i + 1) % 4]"))],
        "quaternion conjugated": [(take, by_hand("i ? -attitude.q[i] : attitude.q[i]"))],
        "attitude of forward, left, up": [(take, by_hand("i > 1 ? -attitude.q[i] : attitude.q[i]"))],
        "rates left out": [("memcpy(_estimate.rates_rad_s, rates.xyz,", "memset(_estimate.rates_rad_s, 0,")],
        "set-point's velocity left out": [("or_zero(asked.velocity[i])", "0.0f")],
        "set-point's height the other way": [
            ("position_m[i] = asked.position[i]", "position_m[i] = i == 2 ? -asked.position[i] : asked.position[i]")
        ],
        "heading left out": [(heading, "_setpoint.yaw_rad = 0.0f")],
        "heading the other way": [(heading, "_setpoint.yaw_rad = -asked.yaw")],
        "motors mirrored: spins reversed": [(motor, "i < 4 ? motor[i ^ 2]")],
        "motors front and back swapped": [(motor, "i < 4 ? motor[3 - i]")],
        "motors in the Crazyflie's order": [(motor, "i < 4 ? motor[i == 1 ? 3 : i == 3 ? 2 : i == 2 ? 1 : 0]")],
        "commands halved": [(motor, "i < 4 ? 0.5f * motor[i]")],
        "other motors at 0": [(": NAN", ": 0.0f")],
        "ages ignored": [("ahead ? then_us - now_us : now_us - then_us", "0 * then_us")],
        "ages wrap around": [
            ("apart_us < INT32_MAX ? static_cast<uint32_t>(apart_us) : INT32_MAX", "(uint32_t)apart_us")
        ],
        "validity ignored": [("position.xy_valid && position.z_valid", "true || position.z_valid")],
        "time of the last position ignored": [("_position_us = position.timestamp", "_position_us = UINT64_MAX")],
        "memory not reset": [(f"{name}_reset(&hook->memory);", "")],
        "take-over at boot alone": [("if (_on && !before)", "if (_on && !before && _steps == 0)")],
        "flies in every mode": [(on, "status.nav_state > 0")],
        "flies disarmed": [("status.arming_state == vehicle_status_s::ARMING_STATE_ARMED", "true")],
        "arming check always granted": [(able, "able >= 0")],
        "arming check forgets a fault": [(f"{able} && (!_on || _who == {name.upper()}_FLIES)", able)],
        "fault stays with the set-point": [("_setpoint = {}; // one", "// one")],
        "set-point does not age": [(f"now_us > _asked_us + {name.upper()}_SETPOINT_US", "false")],
        "holds the place of each sample": [("_asked = false;", "_asked = true;")],
        "holds no place at the take-over": [("hold(); // a set-point", "// a set-point")],
        "holds the heading north": [("_setpoint.yaw_rad = atan2f", "_setpoint.yaw_rad = 0.0f * atan2f")],
        "a set-point of before": [("} else if (asks) {", "} if (asks) {")],
        "a set-point without a position": [("if (!PX4_ISFINITE(asked.position[i]))", "if (false)")],
        "a set-point without a velocity": [("PX4_ISFINITE(value) ? value : 0.0f", "value")],
        "a set-point without a heading": [("if (PX4_ISFINITE(asked.yaw))", "if (true)")],
        "orders at each sample": [("_hook.next_us != due_us", "true")],
        "period not kept": [
            (f"hook->next_us += {name.upper()}_PERIOD_US", f"hook->next_us = now_us + {name.upper()}_PERIOD_US")
        ],
        "another's registration": [("reply.request_id == REQUEST_ID && ", "")],
        "a registration refused": [(" && reply.success", "")],
        "asks once": [("now_us > _requested_us + REQUEST_US", "false")],
        "control allocation left on": [
            ("config.source_id", "config.flag_control_allocation_enabled = true; config.source_id")
        ],
        "body rates left to PX4": [("config.source_id", "config.flag_control_rates_enabled = true; config.source_id")],
        "arming check of another": [("= request.request_id", "= 0")],
        "not unregistered": [("request.mode_id = _mode_id;", "")],
        "never in place of Offboard": [("_param_offboard.get()", "false")],
        "a removed mode stays": [("++_unlisted >= REMOVED", "false")],
        "one arming check removes the mode": [("++_unlisted >= REMOVED", "true")],
        "arming checks that are not in a row": [("_unlisted = 0;\n\n", "")],
        "no answer while it is not listed": [
            ("arming_check_reply_s reply{};", "if (_unlisted) { return; } arming_check_reply_s reply{};")
        ],
        "may be armed in this mode": [("mode_req_prevent_arming = true", "mode_req_prevent_arming = false")],
        "dead reckoning taken for a position": [(" && !position.dead_reckoning", "")],
        "torque left at a fault": [(f"_who == {name.upper()}_FLIES && _on)", "_who < 0)")],
        "no MAVLink set-points": [("request_offboard_setpoints = true", "request_offboard_setpoints = false")],
    }
    return {what: [Mutant(*change) for change in changes] for what, changes in found.items()}
