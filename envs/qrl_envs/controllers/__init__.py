"""Classical controllers, as baselines for a trained policy: `geometric.controller` and `lqr.controller`.

Each turns a quadrotor task into a pure function, observation [..., 18] -> action [..., 4] in [−1, 1] (frames, units and
order of `qrl_envs.quadrotor_env.QuadrotorEnv`), designed from the task's vehicle and reward without learning.
"""
