"""Hyperparameters of the learner: declared once here, valued in presets/*.json.

Each is `Traced` or `Static`. A traced one reaches the compiled program as an argument (`Hyperparameters`), so runs that
differ in traced ones alone share one program. A static one (shape, count, choice, presence) shapes the program.
Symbols are the paper's; names are those of Brax and Stable-Baselines3 where they have one.
"""

import json
import math
from collections.abc import Mapping
from importlib import resources
from typing import Annotated, Any, Literal, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, model_validator

from qrl_envs.specfile import BadInput, Count, Fraction, NonNegative, Positive, nearest

T = TypeVar("T")
Traced = Annotated[T, "traced"]
Static = Annotated[T, "static"]

# Names of the first version, still read from files and flags. To be removed in 0.3.
FORMER_NAMES = {
    "steps": "num_timesteps",
    "episode_steps": "episode_length",
    "lanes": "num_envs",
    "unroll_steps": "unroll_length",
    "ring_unrolls": "replay_unrolls",
    "minibatch_lanes": "batch_size",
    "shards": "num_shards",
    "policy_hidden": "policy_hidden_layer_sizes",
    "critic_hidden": "critic_hidden_layer_sizes",
    "normalise_observations": "normalize_observations",
    "normalise_advantage": "normalize_advantage",
    "reward_scale": "reward_scaling",
    "gradient_clip": "max_grad_norm",
    "apg_lanes": "apg_num_envs",
    "apg_steps": "apg_episode_length",
    "reports": "num_evals",
    "report_flights": "num_eval_envs",
}


class Hyperparameters(NamedTuple):
    """The traced hyperparameters as arrays: float32 [], `observation_scale` [F]; None where there is none."""

    observation_scale: Any
    reward_scaling: Any
    learning_rate: Any
    learning_rate_end: Any
    max_grad_norm: Any
    sigma: Any
    sigma_end: Any
    apg_cotangent_norm: Any
    apg_learning_rate: Any
    gamma: Any
    lam: Any
    rho_bar: Any
    c_bar: Any
    epsilon: Any
    xi: Any


class Config(BaseModel):
    """All hyperparameters of the learner. Defaults: presets/default.json."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)

    num_timesteps: Static[Count] = Field(description="environment steps of the run, APG flights included")
    episode_length: Static[Count | None] = Field(description="maximum steps of a training episode; null: the task's")
    num_envs: Static[Count] = Field(description="environments stepped in parallel (lanes)")
    unroll_length: Static[Count] = Field(description="T: steps of one unroll, the trajectory length of Algorithm 2")
    replay_unrolls: Static[Count] = Field(description="capacity of the replay buffer, in unrolls of all environments")
    warmup_unrolls: Static[Count] = Field(description="unrolls collected before the first update")
    updates_per_unroll: Static[Count] = Field(description="minibatch updates after each unroll")
    batch_size: Static[Count] = Field(description="trajectories of unroll_length steps in a minibatch")
    num_shards: Static[Count | None] = Field(
        description="equal shares of environments and minibatch; results are the same on any number of devices that"
        " divides it; null: 8, or the largest that num_envs and batch_size allow"
    )

    sampling: Static[Literal["replay", "epochs"]] = Field(
        description="minibatches: replay draws with replacement from the buffer; epochs, as PPO, makes whole passes"
        " over the last unroll in random order, with advantages fixed at their start"
    )
    symmetries: Static[bool] = Field(
        description="transform each trajectory of a minibatch by a random symmetry of the task (data augmentation)"
    )

    policy_hidden_layer_sizes: Static[tuple[Count, ...]] = Field(description="hidden layers of the policy network")
    policy_gru_size: Static[Count | None] = Field(
        default=None,
        exclude_if=lambda x: x is None,  # a run of before it was there has the same fingerprint
        description="units of a gated recurrent unit after the policy's hidden layers; null: none, feed-forward",
    )
    critic_hidden_layer_sizes: Static[tuple[Count, ...]] = Field(description="hidden layers of the value network")
    activation: Static[Literal["relu", "tanh"]] = Field(description="activation of both networks")
    observation_scale: Traced[tuple[Positive, ...] | None] = Field(
        description="factor on each observation before the networks; null: 1"
    )
    observation_limit: Static[tuple[Positive | None, ...] | None] = Field(
        default=None,
        exclude_if=lambda x: x is None,  # a run of before it was there has the same fingerprint
        description="greatest size of each of the first observations, before their factor: beyond it they are clipped;"
        " null: none",
    )
    normalize_observations: Static[bool] = Field(
        description="standardize observations by their running mean and deviation"
    )
    reward_scaling: Traced[Positive] = Field(description="factor on rewards; choose it such that |V| is about 1")

    learning_rate: Traced[Positive] = Field(description="initial step size of Adam")
    learning_rate_end: Traced[NonNegative] = Field(description="final step size of the linear schedule")
    max_grad_norm: Traced[Positive] = Field(description="global norm at which each network's gradient is clipped")
    sigma: Traced[Positive] = Field(description="initial standard deviation of the policy")
    sigma_end: Traced[Positive] = Field(description="final standard deviation of the log-linear schedule")
    average_fraction: Static[Fraction] = Field(
        description="last fraction of learning over which the deployed policy's parameters are averaged; 0: no average"
    )

    apg_fraction: Static[Fraction] = Field(
        description="last fraction of num_timesteps spent on the analytic policy gradient (APG), less where the policy"
        " does not fly when it is to begin and apg_cotangent_norm is null; 0: the paper's method alone"
    )
    apg_num_envs: Static[Count] = Field(description="flights of one APG update")
    apg_episode_length: Static[Count] = Field(description="steps of one APG flight")
    apg_split: Static[Count] = Field(
        default=1,
        exclude_if=lambda x: x == 1,
        description="each of the first APG updates (apg_split_fraction) becomes this many, on flights this many times"
        " shorter and with full steps of Adam: long flights teach a policy that cannot fly yet little",
    )
    apg_split_fraction: Static[Fraction] = Field(
        default=0.0, exclude_if=lambda x: x == 0.0, description="first fraction of APG that is split"
    )
    apg_cotangent_norm: Traced[Positive | None] = Field(
        default=None,
        exclude_if=lambda x: x is None,  # a run of before it was there has the same fingerprint
        description="norm at which the gradient of a flight's return with respect to its state, its observation and the"
        " policy's memory is cut at each step; null: none",
    )
    apg_learning_rate: Traced[Positive] = Field(description="initial step size of APG; decays to 0, as sigma then does")

    gamma: Traced[Fraction] = Field(description="discount")
    lam: Traced[Fraction] = Field(description="lambda of the trace; the paper has 1")
    rho_bar: Traced[Positive] = Field(description="V-trace's clip of rho in the temporal difference; the paper has 1")
    c_bar: Traced[Positive] = Field(description="V-trace's clip of rho in the trace; the paper has 1")
    advantage: Static[Literal["pi", "mu"]] = Field(
        description="pi: A^pi by V-trace (conditions 3, 4); mu: A^mu by GAE(lambda) (conditions 1, 2)"
    )
    form: Static[Literal["ratio", "difference"]] = Field(
        description="ratio: pi/mu - 1 (conditions 2, 4); difference: pi - mu (conditions 1, 3)"
    )
    epsilon: Traced[Positive] = Field(description="margin epsilon·|A|, PPO's clip")
    xi: Traced[Positive | None] = Field(description="constant margin, overrides epsilon; null: none")
    normalize_advantage: Static[bool] = Field(description="divide A by its root mean square over the minibatch")

    num_evals: Static[Count] = Field(description="reports of a run: an evaluation and a checkpoint each")
    num_eval_envs: Static[Count] = Field(description="fixed starts flown at each report")

    @model_validator(mode="after")
    def _consistent(self) -> "Config":
        if self.warmup_unrolls > self.learning_unrolls and not self.all_apg:
            least, found = (n * self.steps_per_unroll for n in (self.warmup_unrolls, self.learning_unrolls))
            before = " before APG" if self.num_apg_updates else ""
            raise ValueError(
                f"expected num_timesteps of at least warmup_unrolls · num_envs · unroll_length = {least:,}{before},"
                f" found {found:,}"
            )
        if self.sampling == "epochs":
            if self.advantage != "mu" or self.replay_unrolls != 1 or self.symmetries:
                raise ValueError("expected advantage mu, replay_unrolls 1 and symmetries false with sampling epochs")
            if self.updates_per_unroll * self.batch_size % self.num_envs or self.num_envs % self.batch_size:
                raise ValueError(
                    "expected updates_per_unroll minibatches of batch_size trajectories that make whole passes over"
                    f" num_envs = {self.num_envs} with sampling epochs"
                )
        if self.observation_limit and self.normalize_observations:
            raise ValueError("expected normalize_observations false with observation_limit")
        if self.policy_gru_size and not self.policy_hidden_layer_sizes:
            raise ValueError("expected policy_hidden_layer_sizes of at least one layer with policy_gru_size")
        if self.policy_gru_size and self.symmetries:
            raise ValueError("expected symmetries false with policy_gru_size: a stored memory cannot be transformed")
        if self.apg_episode_length % self.apg_split:
            raise ValueError(
                f"expected apg_episode_length to be a multiple of apg_split = {self.apg_split}, found"
                f" {self.apg_episode_length}"
            )
        if (self.apg_split > 1) != (self.apg_split_fraction > 0.0):
            raise ValueError(
                "expected apg_split above 1 and apg_split_fraction above 0, or neither, found"
                f" {self.apg_split} and {self.apg_split_fraction:g}"
            )
        for name in ("num_envs", "batch_size", *(["apg_num_envs"] if self.num_apg_updates else [])):
            if (value := getattr(self, name)) % self.shard_count:
                raise ValueError(f"expected {name} to be a multiple of num_shards = {self.shard_count}, found {value}")
        return self

    @classmethod
    def preset(cls, name: str) -> "Config":
        """The preset of that name; BadInput if there is none."""
        return cls.model_validate_json(json.dumps(load_preset(name)))

    @property
    def hyperparameters(self) -> Hyperparameters:
        """The traced hyperparameters as NumPy arrays."""
        values = {name: getattr(self, name) for name in Hyperparameters._fields}
        return Hyperparameters(**{k: None if v is None else np.asarray(v, np.float32) for k, v in values.items()})

    @property
    def static(self) -> dict[str, Any]:
        """What two runs must share to share a compiled program, as JSON values."""
        shapes = {name: x.shape for name, x in self.hyperparameters._asdict().items() if x is not None}
        return {**self.model_dump(mode="json", exclude=set(Hyperparameters._fields)), "traced": shapes}

    def observation_limits(self, size: int) -> NDArray[np.float32]:
        """`observation_limit` of the first `size` observations, infinite where there is none; [size]."""
        given = [np.inf if limit is None else limit for limit in (self.observation_limit or ())[:size]]
        return np.array([*given, *[np.inf] * (size - len(given))], np.float32)

    @property
    def shard_count(self) -> int:
        return self.num_shards or math.gcd(8, self.num_envs, self.batch_size)

    @property
    def steps_per_unroll(self) -> int:
        """Environment steps of one unroll of all environments."""
        return self.num_envs * self.unroll_length

    @property
    def num_unrolls(self) -> int:
        """Unrolls of the run; never more steps than `num_timesteps`."""
        return self.num_timesteps // self.steps_per_unroll

    @property
    def unrolls_per_apg_update(self) -> int:
        """Unrolls that the flights of one APG update count for."""
        return -(-self.apg_num_envs * self.apg_episode_length // self.steps_per_unroll)

    @property
    def num_apg_updates(self) -> int:
        """APG updates at the end of the run, each split one counted once."""
        return int(self.num_unrolls * self.apg_fraction) // self.unrolls_per_apg_update

    @property
    def learning_unrolls(self) -> int:
        """Unrolls that are collected and learned from; the rest of the steps are those of APG."""
        return self.num_unrolls - self.num_apg_updates * self.unrolls_per_apg_update

    @property
    def all_apg(self) -> bool:
        """Whether every step is APG's: a run that begins with a policy that flies needs no other."""
        return self.num_apg_updates > 0 and self.learning_unrolls == 0

    def estimated_cost(self, first: int, last: int) -> float:
        """Work from `first` to `last` unrolls, in steps that are flown or learned from."""
        replayed = self.updates_per_unroll * self.batch_size / self.num_envs
        learning = min(last, self.learning_unrolls) - min(first, self.learning_unrolls)
        return self.steps_per_unroll * ((last - first) + replayed * learning)

    def align_to_apg_update(self, unrolls: int) -> int:
        """`unrolls`, rounded up to the end of an APG update where it lies within one."""
        into = max(0, unrolls - self.learning_unrolls)
        return unrolls + -into % self.unrolls_per_apg_update if into else unrolls

    def planned_updates(self, learning_unrolls: int) -> int:
        """Minibatch updates of a learning phase of that many unrolls."""
        return max(1, (learning_unrolls - self.warmup_unrolls + 1) * self.updates_per_unroll)

    def extended_learning(self, learning_unrolls: int) -> int:
        """Unrolls of the learning phase of a policy that does not fly at its end: twice as many, while a quarter of the
        APG updates would be left.
        """
        most = self.num_unrolls - max(1, self.num_apg_updates // 4) * self.unrolls_per_apg_update
        return max(learning_unrolls, min(most, self.align_to_apg_update(2 * learning_unrolls)))

    @property
    def unrolls_per_eval(self) -> int:
        return max(1, -(-self.num_unrolls // self.num_evals))


def current_names(values: Mapping[str, Any], where: str) -> dict[str, Any]:
    """`values` with hyperparameters under today's names; BadInput, naming `where`, if one has both names."""
    for former, name in FORMER_NAMES.items():
        if former in values and name in values:
            raise BadInput(f"{where}: key '{former}': is called '{name}' now, and both are given")
    return {FORMER_NAMES.get(name, name): value for name, value in values.items()}


def with_defaults(values: Mapping[str, Any]) -> dict[str, Any]:
    """`values` and, where they are whole, what such a record leaves out since it is at its default; a part as it is."""
    fields = Config.model_fields.items()
    if any(field.is_required() and name not in values for name, field in fields):
        return dict(values)
    return {name: field.default for name, field in fields if not field.is_required()} | dict(values)


def load_preset(name: str) -> dict[str, Any]:
    """Values of the preset `name` over those of "default"; BadInput if there is none of that name."""
    if name not in preset_names():
        raise BadInput(f"no preset '{name}'{nearest(name, preset_names())}")
    folder = resources.files("qrl").joinpath("presets")
    data = json.loads(folder.joinpath("default.json").read_text(encoding="utf-8"))
    if name != "default":
        data |= json.loads(folder.joinpath(f"{name}.json").read_text(encoding="utf-8"))
    return data


def preset_names() -> list[str]:
    folder = resources.files("qrl").joinpath("presets")
    return sorted(entry.name.removesuffix(".json") for entry in folder.iterdir() if entry.name.endswith(".json"))
