"""The tasks of a vehicle as environments: of an ideal plant, and of a real one."""

import copy
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp

from qrl_envs import measures, own_vehicle, plant, quadrotor, rewards, symmetry
from qrl_envs.reference import Reference
from qrl_envs.symmetry import Symmetry
from qrl_envs.target import Figure, Motion, Periodic, Target, follow
from qrl_envs.task import QuadrotorTask
from qrl_envs.task_env import Evaluation, Params, State, TaskEnv
from qrl_envs.uncertainty import Uncertainty

WORST_S = 0.5
WORLD_STREAM = 1_000_003  # folded into a start's key, so that a world does not share the start's random numbers


class QuadrotorEnv(TaskEnv):
    """Hover or circle with a quadrotor.

    Observation [18]: rotation matrix body -> world row-major, position [m] relative to the hover point or the circle's
    center and velocity [m/s] (world: x forward, y left, z up), body rates [rad/s] (body). Action [4]: a in [−1, 1] for
    the motor thrusts clip(mg/4 + action_scale·a, 0, max) [N], in the order of the task's motors.
    """

    task: QuadrotorTask

    def __init__(self, task: QuadrotorTask) -> None:
        bounds = {name: jnp.float32(value) for name, value in task.bounds.model_dump().items()}
        reward = rewards.from_spec(task.reward)
        params = Params(quadrotor.physics(task.vehicle), reward, quadrotor.start(task.start), bounds)
        super().__init__(task, params, observation_size=18, action_size=len(task.vehicle.motors))

    def reset_calibration(self, rng: chex.PRNGKey) -> State:
        # With the structure of the task's own start, beside which it stands in one program.
        nested = jax.tree.map(jnp.zeros_like, self.params.start.nested)
        start = quadrotor.start(self.task.envelope)._replace(nested=nested)
        return self._reset(self.params._replace(start=start), rng)

    def _draw(self, params: Params, rng: chex.PRNGKey) -> Any:
        return quadrotor.draw(params.start, rng)

    def _advance(self, params: Params, x: Any, action: chex.Array) -> tuple[Any, chex.Array]:
        thrust = quadrotor.thrust_N(params.physics, action)
        body = quadrotor.step(params.physics, x, thrust, self.task.control_period_s)
        return body, params.reward(body, quadrotor.applied_action(params.physics, thrust))

    def _observe(self, params: Params, x: Any) -> chex.Array:
        del params
        return quadrotor.observe(x)

    def _out_of_bounds(self, params: Params, x: Any) -> chex.Array:
        position_ok = jnp.linalg.norm(x.pose.position_m, axis=0) <= params.bounds["distance_m"]
        rate_ok = jnp.linalg.norm(x.twist.body_rate_rad_s, axis=0) <= params.bounds["body_rate_rad_s"]
        return ~(position_ok & rate_ok)  # negated, so that a NaN ends the episode too

    def _reward_out_of_bounds(self, params: Params) -> chex.Array:
        """The reward at rest under full action, upside down and as far above the origin as the bounds reach.

        The same whichever bound was left. If an end paid the reward of the state in which it came, tumbling at once,
        near the origin, would cost a tenth of any flight that a policy can make before it has learned to fly.
        """
        distance_m = params.bounds["distance_m"]
        zero, one = jnp.zeros_like(distance_m), jnp.ones_like(distance_m)
        rest = jnp.stack([zero] * 3)
        above, upside_down = jnp.stack([zero, zero, distance_m]), jnp.stack([zero, one, zero, zero])
        body = quadrotor.Body(quadrotor.Pose(above, upside_down), quadrotor.Twist(rest, rest))
        return params.reward(body, jnp.stack([one] * self.action_size))

    def symmetry(self, u: chex.Array) -> Symmetry:
        draw = symmetry.circle if self.task.reward.form == "circle" else symmetry.hover
        return draw(self.params.physics, u)

    def evaluation(self) -> Evaluation:
        spec, dt_s = self.task.evaluation, self.task.control_period_s
        start, reward = quadrotor.start(spec.start), rewards.from_spec(spec.reward)
        env = self.with_params(self.params._replace(start=start, reward=reward))

        def measure(observations: chex.Array) -> dict[str, chex.Array]:
            flight = measures.of_vehicle(observations, self.task)
            return measures.summarize(flight, round(spec.tail_s / dt_s), dt_s)

        return Evaluation(env, round(spec.duration_s / dt_s), round(spec.return_s / dt_s), measure)


class Observed(NamedTuple):
    """How many numbers of each kind the environment of a real vehicle observes, in their order."""

    body: int
    preview: int
    previous_action: int
    integral: int
    critic: int  # what a policy does not see


def observed(task: QuadrotorTask) -> Observed:
    """Of a task of a real vehicle; no array is made, so JAX need not have its devices yet."""
    motors, integrator = len(task.vehicle.motors), plant.integrator(task)
    return Observed(
        body=18,
        preview=3 * len(task.preview_s),
        previous_action=motors * task.memory.previous_action,
        integral=integrator.size if integrator else 0,
        critic=plant.PRIVILEGED + motors,
    )


class RealQuadrotorEnv(QuadrotorEnv):
    """A task of a multirotor whose rotors lag, on a plant that is drawn anew for each flight (`plant`).

    Observation: what a policy sees, [policy_observation_size]: the 18 numbers of `QuadrotorEnv` as measured, relative
    to the reference now if the task has one; the preview of it, [3] for each time ahead; then its memory, as the task
    has it: previous action [N], integral of the position error [3], on a circle [4]; then what only a critic may see
    (`plant.privileged`). `info["true_obs"]` [18 and the preview] is the body as it is. Action [N], as in
    `QuadrotorEnv`, or rotor speeds, from 0 for −1 to the greatest for 1.
    """

    def __init__(
        self, task: QuadrotorTask, uncertainty: Uncertainty | None = None, shaped_for: Uncertainty | None = None
    ) -> None:
        """With `uncertainty` in place of the task's; its state is shaped for `shaped_for`, so that environments which
        differ in what is uncertain share a program.
        """
        super().__init__(task)
        uncertainty = uncertainty or task.uncertainty or Uncertainty()
        self.params = self.params._replace(ranges=plant.ranges(uncertainty, task.vehicle))
        self._integrator = plant.integrator(task)
        self._reference = self._followed(task.reference, anywhere=True)
        self._calibrating = False
        parts = observed(task)
        self.policy_observation_size = sum(parts[:-1])
        self._sizes = sum(parts), len(task.vehicle.motors)
        self._layout = (shaped_for or uncertainty).layout(task.control_period_s)

    def _followed(self, spec: Reference | None, anywhere: bool) -> Figure | Periodic | Motion | None:
        """The reference that `spec` describes, in flight; on one that is known, flights may begin anywhere."""
        return None if spec is None else follow(spec, self.task.control_period_s, self.task.preview_s, anywhere)

    def _target(self, world: plant.World, steps: chex.Array) -> Target | None:
        return self._reference.at(world.reference, steps) if self._reference else None

    def step(self, state: State, action: chex.Array) -> State:
        return self._with_truth(super().step(state, action))

    def step_lanes(self, state: State, action: chex.Array) -> State:
        return super().step_lanes(state, action)  # so that `step` above is known to be for many lanes, too

    def _reset(self, params: Any, rng: chex.PRNGKey) -> State:
        return self._with_truth(super()._reset(params, rng))

    def _with_truth(self, state: State) -> State:
        x: plant.Flight = state.pipeline_state.x
        true, target = quadrotor.observe(self._error(x)), self._target(x.world, x.steps)
        if target is not None:
            true = jnp.concatenate([true, target.preview_m_s])
        return state.replace(info={**state.info, "true_obs": true})

    def _error(self, x: plant.Flight) -> quadrotor.Body:
        """The body as it is, relative to the reference."""
        target = self._target(x.world, x.steps)
        return x.body if target is None else plant.relative(x.body, target)

    @property
    def body_view(self) -> quadrotor.BodyView | None:
        """What the policy is given in the body frame; None if it is given the world's."""
        if self.task.policy_frame == "world":
            return None
        on_circle = self.task.reward.form == "circle"
        last = 0 if self._integrator is None else 2 if on_circle else 3
        return quadrotor.BodyView(heading=not on_circle, vectors=len(self.task.preview_s), last=last)

    def policy_view(self, observation: chex.Array) -> chex.Array:
        view = self.body_view
        return observation if view is None else quadrotor.in_body_frame(observation, view)

    def _start(self, params: Any, key: chex.PRNGKey) -> quadrotor.Body:
        return quadrotor.draw(params.start, key)

    def _draw(self, params: Any, rng: chex.PRNGKey) -> plant.Flight:
        # The start's key is that of the ideal world: the same starts, whatever the plant.
        stream, more = jax.random.fold_in(rng, WORLD_STREAM), None
        draws, others = plant.DRAWS + self.action_size, self._reference.draws if self._reference else 0
        vehicles, own = self.task.distribution, None
        u = jax.random.uniform(stream, (draws + others + (own_vehicle.DRAWS if vehicles else 0),))
        if self._layout.gusts or self._layout.positions:  # apart, so that what was drawn before these were there stays
            more = jax.random.uniform(jax.random.fold_in(rng, WORLD_STREAM + 1), (plant.MORE_DRAWS,))
        if vehicles:
            own = own_vehicle.draw(vehicles, params.physics, u[draws + others :])
        world = plant.draw(params.ranges, params.physics, u[:draws], self._layout, more, own)
        body, origin_m = self._start(params, rng), 0.0
        if self._reference:
            thrust = jnp.sum(world.motor_factor * world.physics.motor_max_N)
            world = world._replace(reference=self._reference.draw(u[draws : draws + others], world.physics, thrust))
            target = self._reference.at(world.reference, jnp.int32(0))
            origin_m = target.position_m
            body = plant.relative(body, jax.tree.map(jnp.negative, target))
        return plant.begin(body, world, self._layout, self._integrator, self.task.control_period_s, origin_m)

    def _advance(self, params: Params, x: plant.Flight, action: chex.Array) -> tuple[plant.Flight, chex.Array]:
        world, before = x.world, x.previous_action
        x = x._replace(world=jax.lax.stop_gradient(world))
        target = self._target(x.world, x.steps + 1)
        origin_m = 0.0 if target is None else target.position_m
        rotor_speed = self.task.action == "rotor_speed"
        flight = plant.step(x, action, self._integrator, self.task.control_period_s, origin_m, rotor_speed)
        flight = flight._replace(world=world)
        body = flight.body if target is None else plant.relative(flight.body, target)
        return flight, params.reward(body, flight.previous_action, before)

    def _observe(self, params: Params, x: plant.Flight) -> chex.Array:
        seen = plant.observe(x, self.task.memory.previous_action, self._target(x.world, x.steps))
        own = self.task.distribution is not None
        return jnp.concatenate([seen, plant.privileged(x, params.physics, self.task.control_period_s, own)])

    def _out_of_bounds(self, params: Params, x: plant.Flight) -> chex.Array:
        return super()._out_of_bounds(params, self._error(x))

    def evaluation(self) -> Evaluation:
        plan, spec = super().evaluation(), self.task.evaluation
        if isinstance(env := plan.env, RealQuadrotorEnv) and not self._calibrating:
            env._reference = self._followed(spec.reference, anywhere=False)
        return plan

    def calibrating(self) -> "RealQuadrotorEnv":
        """A copy that evaluates on what is followed in training: an exported policy must be ready for all of it."""
        other = copy.copy(self)
        other._calibrating = True
        return other

    def _reward_out_of_bounds(self, params: Params) -> chex.Array:
        """To track, also with the greatest body rate, turned about, and every action changed as far as it can."""
        if self.task.reward.form != "track":
            return super()._reward_out_of_bounds(params)
        distance_m, rate = params.bounds["distance_m"], params.bounds["body_rate_rad_s"]
        zero, one = jnp.zeros_like(distance_m), jnp.ones_like(distance_m)
        above, about = jnp.stack([zero, zero, distance_m]), jnp.stack([zero, zero, zero, one])
        # A velocity has no bound: that of a distance in WORST_S.
        twist = quadrotor.Twist(above / WORST_S, jnp.stack([rate, zero, zero]))
        actions = jnp.stack([one] * self.action_size)
        return params.reward(quadrotor.Body(quadrotor.Pose(above, about), twist), actions, -actions)

    def symmetry(self, u: chex.Array) -> Symmetry:
        plain = super().symmetry(u)
        world, body = plain.observation[9:12, 9:12], plain.observation[15:18, 15:18]
        parts = [plain.observation, *[world] * len(self.task.preview_s)]
        if self.task.memory.previous_action:
            parts.append(plain.action)
        if self._integrator:
            parts += [jnp.eye(2), world[:2, :2]] if self._integrator.circle_m else [world]
        parts += [world, body, jnp.eye(plant.PRIVILEGED - 6), plain.action]
        return Symmetry(jax.scipy.linalg.block_diag(*parts), plain.action)
