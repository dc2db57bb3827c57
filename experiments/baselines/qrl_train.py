"""qrl itself, in one process: `qrl_train.py pendulum|hover|circle --seed N [--preset NAME] [--no-apg] [--checks N]`.

The preset (TASK_fast where it ships, else the task's own) sets the number of steps: learning rate and sigma follow its
schedule, so that a policy is best at the end. It is checked `--checks` times, as the other contestants are.
"""

import argparse
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from judge import Act, Judge, pendulum_judge, success_judge
from qrl import request, tasks
from qrl.algorithm import learner
from qrl.algorithm.flights import summarize
from qrl.config import load_preset, preset_names
from qrl.evaluation.starts import evaluation_starts
from qrl.runs import record
from qrl.training import devices, driver
from qrl.training.sharding import make_mesh
from qrl.training.state import member_inputs, stack
from qrl.training.trainer import Trainer, make_trainer


def contestant(
    task: str, preset: str | None, seed: int, flags: dict[str, Any]
) -> tuple[Trainer, Any, record.RunConfig]:
    """Trainer, inputs of its one member, and config."""
    fast = f"{task}_fast"
    name = preset or (fast if fast in preset_names() else task)
    run = request.run_config(task, None, record.ConfigFile(learner=load_preset(name)), flags, seed, 1)
    devices.configure_cpu(run, [])
    env = tasks.environment(run.task)
    trainer = make_trainer(env, run.learner, make_mesh(jax.devices(), 1, run.learner.shard_count))
    return trainer, stack([member_inputs(env, run.learner)]), run


def numpy_policy(trainer: Trainer) -> Callable[[Any], Act]:
    """The deployed policy as a function of observations in NumPy; compiled once."""
    spec, hyper = trainer.setup.spec, trainer.config.hyperparameters

    @jax.jit
    def mean(state: Any, o: Any) -> Any:
        return jnp.clip(learner.act(spec, hyper, learner.deployed(spec, state), (), o)[1], -1.0, 1.0)

    return lambda member: lambda observation: np.asarray(mean(member, jnp.asarray(observation, jnp.float32)))


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("task", choices=["pendulum", "hover", "circle"])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--preset")
    parser.add_argument("--no-apg", action="store_true", help="without APG")
    parser.add_argument("--checks", type=int, default=20)
    args = parser.parse_args()
    flags = {"apg_fraction": 0.0} if args.no_apg else {}
    trainer, points, run = contestant(args.task, args.preset, args.seed, flags)
    config = run.learner
    keys = evaluation_starts()

    def flights(learners: Any) -> dict[str, float]:
        return summarize(jax.tree.map(lambda x: x[0], trainer.fly(learners, points, keys)))

    judge: Judge = pendulum_judge() if args.task == "pendulum" else success_judge(flights)
    numpy_policy_of = numpy_policy(trainer)
    judge.listen_to_jax().start()
    states = trainer.init(driver.seeds(run.seed, 1), points)
    train, apg = driver.compile_train(trainer, states, points), driver.compile_apg(trainer, states, points)
    pieces = min(args.checks, config.num_unrolls)
    for until in sorted(
        {round(config.num_unrolls * (i + 1) / pieces) for i in range(pieces)} | {config.learning_unrolls}
    ):
        program = train if until <= config.learning_unrolls else apg
        states = jax.block_until_ready(program(states, points, np.int32(until)))
        policy: Any = states.learner
        if args.task == "pendulum":
            policy = numpy_policy_of(jax.tree.map(lambda x: x[0], trainer.gather(policy)))
        if judge.check(until * config.steps_per_unroll, policy):
            break


if __name__ == "__main__":
    main()
