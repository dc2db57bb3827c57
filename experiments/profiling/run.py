"""Where a training run's time goes: `profile_run.py [TASK] [--repeats 9]`, a table in Markdown.

Each part of one unroll-and-learn of the task's preset is compiled alone, as a Trainer's programs are, and timed, all in
turn, medians over repeats. So that nothing of a part is left out, its whole result is what the next repeat begins with,
and what it is made from differs from repeat to repeat. Parts of parts are indented. "Of the floor" is the share of that
time which its multiply-adds alone would take, at the rate of a 64 x 64 product on this machine at the same time.
"""

import argparse
import os
import time
from collections.abc import Callable
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np

from experiments.profiling.parts import REPEATED, Now, Part, Turn, now_of, parts
from qrl import request, tasks
from qrl.runs import record
from qrl.training import driver
from qrl.training.state import MemberInputs, TrainState, member_inputs, stack
from qrl.training.trainer import Trainer, make_trainer, xla_effort

WHOLE = 4  # unrolls of the whole, within a timed call


def begun(task: str) -> tuple[Trainer, MemberInputs, TrainState, Callable[..., TrainState]]:
    """A run of one member whose ring is full: trainer, points, states, and what advances them."""
    run = request.run_config(task, None, record.ConfigFile(), {}, 0, 1)
    os.environ.setdefault("PJRT_NPROC", "1")  # each device has about a core
    env, config = tasks.environment(run.task), run.learner
    trainer, points = make_trainer(env, config), stack([member_inputs(env, config)])
    states = trainer.init(driver.seeds(0, 1), points)
    advance = driver.compile_train(trainer, states, points)
    states = advance(states, points, np.int32(min(config.num_unrolls, 2 * config.replay_unrolls)))
    return trainer, points, jax.block_until_ready(states), advance


def going_on(advance: Callable[..., TrainState], states: TrainState, points: MemberInputs) -> Callable[[], None]:
    """WHOLE unrolls more, at each call."""
    box = [states]

    def whole() -> None:
        done = int(box[0].unrolls[0])
        box[0] = jax.block_until_ready(advance(box[0], points, np.int32(done + WHOLE)))

    return whole


def repeated(trainer: Trainer, part: Part, now: Now) -> Callable[[], None]:
    """The part compiled, REPEATED times in a row: each result, whole, is the next one's `last`."""

    def make(now: Now, last: Any, i: chex.Array) -> Any:
        result = part.make(trainer, Turn(now, last, i, 1e-30 * (i + 1).astype(jnp.float32)))
        return jax.tree.map(lambda x: jnp.asarray(x, jnp.result_type(x)), result)  # types that are said, not weak

    def all_of_it(now: Now, last: Any) -> Any:
        return jax.lax.scan(lambda last, i: (make(now, last, i), None), last, jnp.arange(REPEATED))[0]

    first = part.first
    if first is None:
        shapes = jax.eval_shape(lambda now: make(now, None, jnp.int32(0)), now)
        first = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
    program = jax.jit(all_of_it, donate_argnums=1, compiler_options=xla_effort(1))
    box = [jax.tree.map(jnp.array, first)]

    def timed() -> None:
        box[0] = jax.block_until_ready(program(now, box[0]))

    return timed


def product_rate() -> float:
    """Multiply-adds a second of [1600, 64] x [64, 64], at its best: what others take beside us is no floor."""
    a, b = jnp.ones((1600, 64)), jnp.full((64, 64), 1.0 / 64.0)
    program = jax.jit(lambda a, b: jax.lax.fori_loop(0, 200, lambda _, x: x @ b, a), compiler_options=xla_effort(1))
    program(a, b).block_until_ready()
    times = []
    for _ in range(9):
        begun = time.perf_counter()
        program(a, b).block_until_ready()
        times.append(time.perf_counter() - begun)
    return 200 * 1600 * 64 * 64 / min(times)


def seconds_of(call: Callable[[], None]) -> float:
    begun = time.perf_counter()
    call()
    return time.perf_counter() - begun


def measure(
    rows: list[Part], calls: list[Callable[[], None]], whole: Callable[[], None], repeats: int
) -> tuple[dict[str, float], float]:
    """Seconds an unroll of each part and of the "whole", and the product's rate; medians over repeats."""
    seconds: dict[str, list[float]] = {part.name: [] for part in rows} | {"whole": []}
    rates = []
    for _ in range(repeats + 1):  # the first compiles
        for part, call in zip(rows, calls, strict=True):
            seconds[part.name].append(seconds_of(call) / REPEATED * part.times)
        seconds["whole"].append(seconds_of(whole) / WHOLE)
        rates.append(product_rate())
    return {name: float(np.median(values[1:])) for name, values in seconds.items()}, float(np.median(rates))


def table(rows: list[Part], took: dict[str, float], rate: float) -> None:
    print("| part | ms an unroll | share | of the floor |\n|---|---|---|---|")
    for part in rows:
        seconds = took[part.name]
        floor = f"{part.adds * part.times / rate / seconds:.0%}" if part.adds else ""
        print(f"| {part.name} | {1e3 * seconds:.2f} | {seconds / took['whole']:.1%} | {floor} |")
    together = sum(took[part.name] for part in rows if not part.name.startswith("–"))
    print(f"| these together | {1e3 * together:.2f} | {together / took['whole']:.1%} | |")
    print(f"| the whole | {1e3 * took['whole']:.2f} | 100.0% | |")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("task", nargs="?", default="hover")
    parser.add_argument("--repeats", type=int, default=9)
    args = parser.parse_args()
    trainer, points, states, advance = begun(args.task)
    now = now_of(trainer, states, points)
    rows = parts(trainer, now)
    calls = [repeated(trainer, part, now) for part in rows]
    took, rate = measure(rows, calls, going_on(advance, states, points), args.repeats)
    print(
        f"{jax.devices()[0].device_kind}, jax {jax.__version__}; {2e-9 * rate:.0f} GFLOP/s in [1600, 64] x [64, 64]\n"
    )
    table(rows, took, rate)
    print(f"\n{trainer.config.steps_per_unroll / took['whole']:,.0f} env steps/s")


if __name__ == "__main__":
    main()
