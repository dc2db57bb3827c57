"""The policy of one run as what another one begins with."""

import hashlib
import json
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from qrl import tasks
from qrl.algorithm.running_statistics import RunningStatistics
from qrl.algorithm.types import Env
from qrl.evaluation.trained_run import TrainedRun
from qrl.runs import shipped
from qrl.runs.record import Init, RunConfig
from qrl_envs.specfile import BadInput

# What of two tasks must agree, for the numbers that the policy is given and gives to mean the same.
MEANING = ("world", "action", "policy_frame", "preview_s", "memory")


class Initial(NamedTuple):
    """A trained policy, and what it is a policy of."""

    init: Init
    run: RunConfig
    sizes: tuple[int, int]  # how many observations it sees, and actions
    policy: Any  # the network's numbers, float32
    statistics: RunningStatistics  # of observations, where they are normalized


def load(run: str) -> Initial:
    """The policy that is deployed at the last checkpoint of a run: its folder, or the name of one that ships."""
    trained = TrainedRun.load(shipped.run_folder(Path(run)))
    learner = jax.tree.map(lambda x: np.asarray(x, np.float32), trained.deployed)
    numbers = learner.params.policy, learner.statistics
    digest = hashlib.sha256(b"".join(x.tobytes() for x in jax.tree.leaves(numbers))).hexdigest()
    return Initial(Init(run=run, sha256=digest), trained.config, sizes(trained.env), *numbers)


def recorded(init: Init) -> Initial:
    """The policy that a config.json names; BadInput if it is another one now."""
    found = load(init.run)
    if found.init != init:
        given, now = init.sha256[:12], found.init.sha256[:12]
        raise BadInput(f"{init.run}: expected the policy that the run begins with, of SHA-256 {given}…, found {now}…")
    return found


def sizes(env: Env) -> tuple[int, int]:
    """How many observations a policy sees, and actions."""
    return getattr(env, "policy_observation_size", None) or env.observation_size, env.action_size


def check(initial: Initial, run: RunConfig, env: Env) -> None:
    """BadInput, which names a key, unless `run`, which trains in `env`, can begin with that policy."""
    where, theirs, ours = f"--init {initial.init.run}", initial.run.task.spec or {}, run.task.spec or {}
    for key in MEANING:
        if theirs.get(key) != ours.get(key):
            raise BadInput(
                f"{where}: expected a policy of a task with the key '{key}' of {run.task.name},"
                f" {json.dumps(ours.get(key))}, found {json.dumps(theirs.get(key))}"
            )
    if (found := initial.sizes) != (expected := sizes(env)):
        raise BadInput(
            f"{where}: expected a policy of {expected[0]} observations and {expected[1]} actions, found {found[0]} and"
            f" {found[1]}"
        )
    if run.learner.normalize_observations and initial.statistics.mean.size != env.observation_size:
        raise BadInput(
            f"{where}: its observations are normalized: expected {env.observation_size}, with those of the critic,"
            f" found {initial.statistics.mean.size}"
        )
    seen = expected[0]
    for key in tasks.NETWORK:
        known, asked = getattr(initial.run.learner, key), getattr(run.learner, key)
        if key == "observation_scale":
            known, asked = (known or ())[:seen], (asked or ())[:seen]
        if known != asked:
            raise BadInput(f"{where}: key '{key}': expected that of its network, {known}, found {asked}")
