"""Off-nominal conditions: what each changes, and that policies see sensors and measures see the truth."""

import jax
import jax.numpy as jnp
import numpy as np

from qrl.algorithm import flights as evaluate
from qrl_envs import env, off_nominal, task
from qrl_envs.off_nominal import Condition, OffNominal
from qrl_envs.uncertainty import Uncertainty

NOISE = {name: (size, size) for name, size in off_nominal.NOISE.items()}


def quadrotor_task(name: str, **changes: object) -> task.QuadrotorTask:
    loaded = task.from_data({"extend": name, **changes}, name)
    assert isinstance(loaded, task.QuadrotorTask)
    return loaded


HOVER = quadrotor_task("hover")
SHORT = quadrotor_task("hover", evaluation={"duration_s": 0.4, "tail_s": 0.1})
REAL = quadrotor_task("hover", vehicle="crazyflie")
HOVER_ENV = env.from_task(HOVER)


def keys(n: int) -> jax.Array:
    return jax.random.split(jax.random.PRNGKey(0), n)


def damped(observation: jax.Array) -> jax.Array:
    """An action that shows what is seen of position and rates, and keeps the vehicle near for a while."""
    return 0.05 * observation[..., jnp.array([9, 10, 15, 16])]


def test_the_policy_sees_the_noise_and_the_measures_do_not() -> None:
    """The actions are off those that the recorded, true observations call for by the noise, and from the first on."""
    noisy = OffNominal(SHORT, Condition("", Uncertainty(**NOISE)))
    flights = jax.tree.map(np.asarray, jax.jit(lambda keys: evaluate.fly(noisy, damped, keys, 0))(keys(200)))
    called_for = np.asarray(damped(flights.observations[:, :-1]))
    off = (flights.actions - called_for)[(np.abs(called_for) < 0.9).all(-1)] / 0.05
    assert len(off) > 200 * 30
    np.testing.assert_allclose(off.std(axis=0), [0.01, 0.01, 0.02, 0.02], rtol=0.07)
    assert (flights.actions[:, 0] != called_for[:, 0]).all()


def test_conditions_start_as_the_task_does() -> None:
    """The same keys give the starts of the ideal world, whatever the condition."""
    own = jax.jit(jax.vmap(HOVER_ENV.reset))(keys(50)).obs
    for name in ("exact", "noise", "lag_72ms"):
        other = OffNominal(HOVER, off_nominal.conditions(HOVER)[name])
        np.testing.assert_array_equal(jax.jit(jax.vmap(other.reset))(keys(50)).info["true_obs"], own)


def test_one_program_serves_all_conditions() -> None:
    """Their parameters have one structure, and each changes what it says."""
    for spec in (HOVER, REAL):
        named = {name: OffNominal(spec, c).params for name, c in off_nominal.conditions(spec).items()}
        shapes = {str(jax.tree.map(jnp.shape, params)) for params in named.values()}
        assert len(shapes) == 1
        if spec is REAL:
            named.pop("lag_72ms")  # its own
        different = {str(jax.tree.map(np.asarray, params)) for params in named.values()}
        assert len(different) == len(named)


def test_the_papers_trial_starts_anyhow_but_there() -> None:
    """Its position and velocity; attitudes uniform over SO(3), body rates in the start's ±1 rad/s."""
    trial = OffNominal(HOVER, off_nominal.conditions(HOVER)["trial"]).evaluation().env
    start = np.asarray(jax.jit(jax.vmap(trial.reset))(keys(2000)).obs)
    np.testing.assert_allclose(start[:, 9:15] - [-1.58, 0.99, 1.45, -2.39, 6.20, 0.77], 0.0, atol=1e-6)
    assert np.abs(start[:, :9].mean(axis=0)).max() < 5 / np.sqrt(3 * 2000)  # each entry: mean 0, variance 1/3
    np.testing.assert_allclose(start[:, :9].var(axis=0), 1 / 3, atol=0.04)
    assert 0.98 < np.abs(start[:, 15:18]).max() <= 1.0


def test_the_conditions_are_those_that_a_policy_is_judged_by() -> None:
    """One change each, all but "together"; the trial is a hover's, wind that of a vehicle with drag."""
    nothing = Uncertainty()
    for spec in (HOVER, REAL, quadrotor_task("circle")):
        for name, condition in off_nominal.conditions(spec).items():
            fields = Uncertainty.model_fields
            changed = {key for key in fields if getattr(condition.uncertainty, key) != getattr(nothing, key)}
            several = {
                "together": changed,
                "noise": set(NOISE),
                "gusts": {"gust_m_s"},
                "estimator": {"position_period_s", "position_delay_s", "bias_wander_m"},
            }
            if name in several:
                assert changed == several[name]
            else:
                assert len(changed) == (name not in ("exact", "trial", "half_rate")), name
    names = [set(off_nominal.conditions(spec)) for spec in (HOVER, REAL, quadrotor_task("circle"))]
    assert names[1] - names[0] == {"lag_x2", "wind"}
    assert names[0] - names[2] == {"trial"}


def test_at_half_the_rate_each_action_acts_for_two_periods() -> None:
    """Whatever the policy says in the second."""
    named = off_nominal.conditions(REAL)
    half, plain = (OffNominal(REAL, named[name]) for name in ("half_rate", "exact"))
    actions = jnp.asarray(np.random.default_rng(0).uniform(-0.3, 0.3, (6, 4)), jnp.float32)

    @jax.jit
    def after(params: off_nominal.OffNominalParams, actions: jax.Array) -> jax.Array:
        env = plain.with_params(params)  # pyright: ignore[reportArgumentType]
        start = env.reset(jax.random.PRNGKey(3))
        return jax.lax.scan(lambda s, a: (env.step(s, a), None), start, actions)[0].obs

    held = after(half.params, actions)
    np.testing.assert_allclose(held, after(plain.params, jnp.repeat(actions[::2], 2, axis=0)), atol=1e-6)
    assert jnp.abs(held - after(plain.params, actions)).max() > 0.1
