"""No random number is drawn twice: whatever keys the train loop derives, each is drawn from, split or folded once."""

from collections import Counter
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from qrl.algorithm import augmentation, replay_buffer, rollout
from qrl.training import trainer
from qrl.training.state import member_inputs
from qrl.training.trainer import Setup
from small_run import pendulum, run_config

LANES, UNROLLS, UPDATES, BATCH, APG_UPDATES, APG_LANES, T = 4, 4, 3, 4, 3, 4, 10
DRAWS = ("bits", "normal", "uniform")


class Seen:
    """What was done with keys, and which numbers came of it, over the calls of a program."""

    def __init__(self) -> None:
        self.uses: list[tuple[Any, ...]] = []  # (what, key, number that is folded into it)
        self.values: dict[str, list[np.ndarray]] = {}

    def use(self, what: str, key: jax.Array, data: Any) -> jax.Array:
        """`key`, once it is known that it was used so; a callback whose result is needed is made in any program."""

        def record(key: np.ndarray, data: np.ndarray) -> np.ndarray:
            for one, folded in zip(key.reshape(-1, 2).tolist(), np.ravel(data).tolist(), strict=True):
                self.uses.append((what, tuple(one), folded))
            return np.zeros_like(key)

        nothing = jax.ShapeDtypeStruct(key.shape, key.dtype)
        data = jnp.asarray(data, jnp.uint32)
        return key ^ jax.pure_callback(record, nothing, key, data, vmap_method="broadcast_all")

    def value(self, name: str, x: jax.Array) -> None:
        jax.debug.callback(lambda x: self.values.setdefault(name, []).append(np.asarray(x)), x)


def spy(monkeypatch: pytest.MonkeyPatch) -> Seen:
    seen = Seen()
    original_split, original_uniform = jax.random.split, jax.random.uniform

    def watched(name: str) -> None:
        original = getattr(jax.random, name)

        def function(key: Any, *args: Any, **kwargs: Any) -> Any:
            folded = args[0] if name == "fold_in" else 0
            if jnp.issubdtype(key.dtype, jax.dtypes.prng_key):
                seen.use(name, jax.random.key_data(key), folded)
                return original(key, *args, **kwargs)
            return original(seen.use(name, key, folded), *args, **kwargs)

        monkeypatch.setattr(jax.random, name, function)

    for name in (*DRAWS, "split", "fold_in"):
        watched(name)

    def unroll(*args: Any, **kwargs: Any) -> Any:
        lanes, buffer = original_unroll(*args, **kwargs)
        policy, sigma = args[3:5]
        transitions = replay_buffer.newest(buffer)
        seen.value("noise", (transitions.action - policy((), transitions.observation)[1]) / sigma)
        return lanes, buffer

    def gather(buffer: Any, index: jax.Array) -> Any:
        seen.value("minibatch", index)
        return original_gather(buffer, index)

    def augment(env: Any, batch: Any, draws: jax.Array) -> Any:
        seen.value("symmetry", draws)
        return original_augment(env, batch, draws)

    def returns(env: Any, policy: Any, memory: Any, sigma: Any, keys: Any, *more: Any) -> Any:
        seen.value("start", jax.vmap(lambda key: original_uniform(original_split(key)[0], (2,)))(keys))
        return original_returns(env, policy, memory, sigma, keys, *more)

    original_unroll, original_gather, original_augment = rollout.unroll, replay_buffer.gather, augmentation.augment
    original_returns = trainer.analytic_gradient.returns
    monkeypatch.setattr(rollout, "unroll", unroll)
    monkeypatch.setattr(replay_buffer, "gather", gather)
    monkeypatch.setattr(augmentation, "augment", augment)
    monkeypatch.setattr(trainer.analytic_gradient, "returns", returns)
    return seen


@pytest.fixture(scope="module")
def seen() -> Seen:
    """Of two shards: four unrolls with three minibatches each, and three APG updates."""
    config = run_config(
        num_envs=LANES,
        unroll_length=T,
        episode_length=T,  # all lanes begin together: a lane that waits for others is shown the same start again
        warmup_unrolls=1,
        updates_per_unroll=UPDATES,
        batch_size=BATCH,
        num_shards=2,
        apg_fraction=0.4,
        apg_num_envs=APG_LANES,
        apg_episode_length=5,
    ).learner
    env = pendulum()
    setup, inputs = Setup(trainer.adapt(env), config), member_inputs(env, config)
    with pytest.MonkeyPatch.context() as monkeypatch:
        seen = spy(monkeypatch)
        state = jax.jit(lambda: trainer.init_state(setup, jnp.int32(0), inputs))()
        learn = jax.jit(lambda state: trainer.train_step(setup, inputs, state))
        for _ in range(UNROLLS):
            state = learn(state)
        polish = jax.jit(lambda step, state: trainer.apg_step(setup, inputs, step, state))
        for step in range(APG_UPDATES):
            state = polish(jnp.int32(step), state)
        jax.effects_barrier()
    return seen


def test_no_key_is_used_twice(seen: Seen) -> None:
    """Not drawn from twice; and what is drawn from is not also split, or a number folded into it.

    (The same number may be folded in twice, as a lane's is for each of its starts: what comes of it is looked at too.)
    """
    twice = [use for use, times in Counter(seen.uses).items() if times > 1 and use[0] in DRAWS]
    assert not twice
    ways: dict[Any, set[str]] = {}
    for what, key, _ in seen.uses:
        ways.setdefault(key, set()).add(what)
    assert not {key: found for key, found in ways.items() if len(found) > 1}
    draws = Counter(what for what, *_ in seen.uses)
    assert draws["normal"] == APG_UPDATES * APG_LANES, "each flight's of each update"


def rows(values: list[np.ndarray], axes: int) -> np.ndarray:
    """All that was seen, one row for each index of the first `axes` axes."""
    stacked = np.stack(values)
    return stacked.reshape(int(np.prod(stacked.shape[:axes])), -1)


def test_no_number_is_drawn_twice(seen: Seen) -> None:
    """Noise over unrolls, lanes and steps; symmetries over updates and trajectories; starts over updates and flights;
    minibatches over updates and unrolls.
    """
    noise, symmetry, start = (
        rows(seen.values["noise"], 3),
        rows(seen.values["symmetry"], 2),
        rows(seen.values["start"], 2),
    )
    assert len(noise) == UNROLLS * LANES * T
    assert len(symmetry) == UNROLLS * UPDATES * BATCH
    assert len(start) == APG_UPDATES * APG_LANES
    for each in (noise.round(4), symmetry, start):
        assert len(np.unique(each, axis=0)) == len(each)
    minibatches = np.stack(seen.values["minibatch"])
    assert minibatches.shape == (UNROLLS * UPDATES, BATCH)
    assert len(np.unique(minibatches[-2 * UPDATES :], axis=0)) == 2 * UPDATES, "of 12 or 16 trajectories"
