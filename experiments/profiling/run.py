"""Where a training run's time goes, as a Markdown table.

    .venv/bin/python -m experiments.profiling.run [TASK] [--repeats 9]

Each part of one unroll and its updates, with the task's preset, is compiled and timed by itself, one after the other;
medians over repeats. A repeat's result is the next one's input, so that XLA removes nothing. Parts of parts are
indented. "Of the floor" is the time of the part's multiply-adds at the rate of a 64 x 64 product, measured at the same
time, over the part's time.
"""

import os
import time
from collections.abc import Callable
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np

from experiments.arguments import Parser
from experiments.profiling.parts import REPEATS, Call, Inputs, Part, make_inputs, parts
from qrl import request, tasks
from qrl.runs import record
from qrl.training import driver
from qrl.training.state import MemberInputs, TrainState, member_inputs, stack
from qrl.training.trainer import Trainer, make_trainer, xla_effort

UNROLLS = 4  # of the full program, within a timed call


def start(task: str) -> tuple[Trainer, MemberInputs, TrainState, Callable[..., TrainState]]:
    """A run of one member with a full replay buffer: trainer, points, states, and the compiled program."""
    run = request.run_config(task, None, record.ConfigFile(), {}, 0, 1)
    os.environ.setdefault("PJRT_NPROC", "1")  # each device has about a core
    env, config = tasks.environment(run.task), run.learner
    trainer, points = make_trainer(env, config), stack([member_inputs(env, config)])
    states = trainer.init(driver.seeds(0, 1), points)
    advance = driver.compile_train(trainer, states, points)
    states = advance(states, points, np.int32(min(config.num_unrolls, 2 * config.replay_unrolls)))
    return trainer, points, jax.block_until_ready(states), advance


def full_program(advance: Callable[..., TrainState], states: TrainState, points: MemberInputs) -> Callable[[], None]:
    """A function that advances by UNROLLS at each call."""
    box = [states]

    def advance_unrolls() -> None:
        done = int(box[0].unrolls[0])
        box[0] = jax.block_until_ready(advance(box[0], points, np.int32(done + UNROLLS)))

    return advance_unrolls


def repeated(trainer: Trainer, part: Part, inputs: Inputs) -> Callable[[], None]:
    """The part compiled and repeated REPEATS times; each result is the next one's `last`."""

    def make(inputs: Inputs, last: Any, i: chex.Array) -> Any:
        result = part.make(trainer, Call(inputs, last, i, 1e-30 * (i + 1).astype(jnp.float32)))
        return jax.tree.map(lambda x: jnp.asarray(x, jnp.result_type(x)), result)  # no weak types

    def repeat(inputs: Inputs, last: Any) -> Any:
        return jax.lax.scan(lambda last, i: (make(inputs, last, i), None), last, jnp.arange(REPEATS))[0]

    first = part.first
    if first is None:
        shapes = jax.eval_shape(lambda inputs: make(inputs, None, jnp.int32(0)), inputs)
        first = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
    program = jax.jit(repeat, donate_argnums=1, compiler_options=xla_effort(1))
    box = [jax.tree.map(jnp.array, first)]

    def timed() -> None:
        box[0] = jax.block_until_ready(program(inputs, box[0]))

    return timed


def product_rate() -> float:
    """Multiply-adds a second of [1600, 64] x [64, 64], the best of nine, since other processes only slow it."""
    a, b = jnp.ones((1600, 64)), jnp.full((64, 64), 1.0 / 64.0)
    program = jax.jit(lambda a, b: jax.lax.fori_loop(0, 200, lambda _, x: x @ b, a), compiler_options=xla_effort(1))
    program(a, b).block_until_ready()
    times = []
    for _ in range(9):
        before = time.perf_counter()
        program(a, b).block_until_ready()
        times.append(time.perf_counter() - before)
    return 200 * 1600 * 64 * 64 / min(times)


def seconds_of(call: Callable[[], None]) -> float:
    before = time.perf_counter()
    call()
    return time.perf_counter() - before


def measure(
    rows: list[Part], calls: list[Callable[[], None]], full: Callable[[], None], repeats: int
) -> tuple[dict[str, float], float]:
    """Seconds an unroll of each part and of "all", and the product's rate; medians over repeats."""
    seconds: dict[str, list[float]] = {part.name: [] for part in rows} | {"all": []}
    rates = []
    for _ in range(repeats + 1):  # the first compiles
        for part, call in zip(rows, calls, strict=True):
            seconds[part.name].append(seconds_of(call) / REPEATS * part.times)
        seconds["all"].append(seconds_of(full) / UNROLLS)
        rates.append(product_rate())
    return {name: float(np.median(values[1:])) for name, values in seconds.items()}, float(np.median(rates))


def table(rows: list[Part], took: dict[str, float], rate: float) -> None:
    print("| part | ms an unroll | share | of the floor |\n|---|---|---|---|")
    for part in rows:
        seconds = took[part.name]
        floor = f"{part.adds * part.times / rate / seconds:.0%}" if part.adds else ""
        print(f"| {part.name} | {1e3 * seconds:.2f} | {seconds / took['all']:.1%} | {floor} |")
    together = sum(took[part.name] for part in rows if not part.name.startswith("–"))
    print(f"| sum of the parts | {1e3 * together:.2f} | {together / took['all']:.1%} | |")
    print(f"| all | {1e3 * took['all']:.2f} | 100.0% | |")


def main() -> None:
    parser = Parser("profile", __doc__)
    parser.add_argument("task", nargs="?", default="hover")
    parser.add_argument("--repeats", type=int, default=9)
    args = parser.parse_args()
    trainer, points, states, advance = start(args.task)
    inputs = make_inputs(trainer, states, points)
    rows = parts(trainer, inputs)
    calls = [repeated(trainer, part, inputs) for part in rows]
    took, rate = measure(rows, calls, full_program(advance, states, points), args.repeats)
    print(
        f"{jax.devices()[0].device_kind}, jax {jax.__version__}; {2e-9 * rate:.0f} GFLOP/s in [1600, 64] x [64, 64]\n"
    )
    table(rows, took, rate)
    print(f"\n{trainer.config.steps_per_unroll / took['all']:,.0f} env steps/s")


if __name__ == "__main__":
    main()
