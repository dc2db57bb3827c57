"""Classical controllers, to fly beside a trained policy: `geometric.controller` and `lqr.controller`.

Each makes of a quadrotor task a pure function, observation [..., 18] -> action [..., 4] in [−1, 1], from the task's own
vehicle and from what its reward asks for: nothing is learnt. Observations and actions are DESIGN.md's ("Frames, units,
order").
"""
