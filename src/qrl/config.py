"""The learner's hyperparameters: declared once here, valued in presets/*.json (paper's symbols, FIELD's terms).

Each is declared `Traced` or `Static`. Traced ones reach the compiled program as its arguments, so that runs that
differ in them alone share one program; static ones (shapes, counts, choices, whether an optional one is there at all)
shape the program.
"""

import json
import math
from importlib import resources
from typing import Annotated, Any, Literal, TypeVar

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, model_validator


def _whole(value: Any) -> Any:
    return int(value) if isinstance(value, float) and value.is_integer() else value


def _single(value: float) -> float:
    if value and not 1e-30 <= abs(value) <= 1e30:
        raise ValueError(f"expected a magnitude that single precision holds (1e-30 to 1e30), found {value}")
    return value


Count = Annotated[int, BeforeValidator(_whole), Field(ge=1, lt=2**31)]  # accepts 2e6
CountOrZero = Annotated[int, BeforeValidator(_whole), Field(ge=0, lt=2**31)]
Positive = Annotated[float, Field(gt=0), AfterValidator(_single)]
NonNegative = Annotated[float, Field(ge=0), AfterValidator(_single)]
Fraction = Annotated[float, Field(ge=0, le=1), AfterValidator(_single)]

T = TypeVar("T")
Traced = Annotated[T, "traced"]
Static = Annotated[T, "static"]


class Config(BaseModel):
    """Everything that the learner may be told. The defaults are src/qrl/presets/default.json."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)

    steps: Static[Count] = Field(description="environment steps in all")
    episode_steps: Static[Count | None] = Field(description="longest training episode; null: the task's own")
    lanes: Static[Count] = Field(description="environments stepped side by side")
    unroll_steps: Static[Count] = Field(description="T: steps of one unroll, the trajectory length of Algorithm 2")
    ring_unrolls: Static[Count] = Field(description="slots of the ring buffer, each one unroll of all lanes")
    warmup_unrolls: Static[Count] = Field(description="unrolls collected before learning starts")
    updates_per_unroll: Static[Count] = Field(description="minibatch updates after each unroll")
    minibatch_lanes: Static[Count] = Field(description="trajectories (slot, lane) of one minibatch")
    shards: Static[Count | None] = Field(
        description="equal shares of lanes and minibatch: devices must divide them, and results are the same on any"
        " number that does; null: 8, or as many as lanes and minibatch_lanes allow"
    )

    symmetries: Static[bool] = Field(
        description="turn each trajectory of a minibatch by a random symmetry of the task, where it has some"
    )

    policy_hidden: Static[tuple[Count, ...]] = Field(description="hidden layers of the policy")
    critic_hidden: Static[tuple[Count, ...]] = Field(description="hidden layers of the critic")
    activation: Static[Literal["relu", "tanh"]] = Field(description="activation of both networks")
    observation_scale: Traced[tuple[Positive, ...] | None] = Field(
        description="factor on each observation before the networks; null: 1"
    )
    normalise_observations: Static[bool] = Field(
        description="standardise observations by their running mean and deviation"
    )
    reward_scale: Traced[Positive] = Field(description="factor on rewards, so that |V| is about 1")

    learning_rate: Traced[Positive] = Field(description="Adam's step size at the start of learning")
    learning_rate_end: Traced[NonNegative] = Field(description="and at its end, linear in between")
    gradient_clip: Traced[Positive] = Field(description="global norm at which each network's gradient is clipped")
    sigma: Traced[Positive] = Field(description="the policy's standard deviation at the start")
    sigma_end: Traced[Positive] = Field(description="and at the end of learning, log-linear in between")
    average_fraction: Static[Fraction] = Field(
        description="last part of learning over which the policy that ships is averaged; 0: not averaged"
    )

    apg_fraction: Static[Fraction] = Field(
        description="last part of the run's steps, in which the policy climbs the gradient of whole flights through the"
        " environment itself (analytic policy gradient); 0: none"
    )
    apg_lanes: Static[Count] = Field(description="flights of one such update")
    apg_steps: Static[Count] = Field(description="steps of each")
    apg_learning_rate: Traced[Positive] = Field(description="Adam's step size at its start; this and sigma fall to 0")

    gamma: Traced[Fraction] = Field(description="discount")
    lam: Traced[Fraction] = Field(description="lambda of the trace; 1 in the paper")
    rho_bar: Traced[Positive] = Field(description="V-trace's clip of rho in the temporal difference; 1 in the paper")
    c_bar: Traced[Positive] = Field(description="V-trace's clip of rho in the trace; 1 in the paper")
    advantage: Static[Literal["pi", "mu"]] = Field(
        description="pi: A^pi by V-trace (conditions 3, 4); mu: A^mu by GAE(lambda) (conditions 1, 2)"
    )
    form: Static[Literal["ratio", "difference"]] = Field(
        description="pi/mu − 1 (conditions 2, 4) or pi − mu (conditions 1, 3)"
    )
    epsilon: Traced[Positive] = Field(description="margin epsilon·|A|")
    xi: Traced[Positive | None] = Field(description="constant margin in its stead; null: none")
    normalise_advantage: Static[bool] = Field(description="divide A by its root mean square over the minibatch")

    reports: Static[Count] = Field(description="reports of a run: each an evaluation and a checkpoint")
    report_flights: Static[Count] = Field(description="fixed starts flown at each report")

    @model_validator(mode="after")
    def _consistent(self) -> "Config":
        if self.warmup_unrolls > self.learning_unrolls:
            least, found = (n * self.unroll_size for n in (self.warmup_unrolls, self.learning_unrolls))
            before = " before the analytic gradient" if self.climbs else ""
            raise ValueError(
                f"expected steps of at least warmup_unrolls · lanes · unroll_steps = {least:,}{before}, found {found:,}"
            )
        for name in ("lanes", "minibatch_lanes", *(["apg_lanes"] if self.climbs else [])):
            if (value := getattr(self, name)) % self.logical_shards:
                raise ValueError(f"expected {name} to be a multiple of shards = {self.logical_shards}, found {value}")
        return self

    @property
    def logical_shards(self) -> int:
        return self.shards or math.gcd(8, self.lanes, self.minibatch_lanes)

    @property
    def traced(self) -> dict[str, Any]:
        """The traced hyperparameters that are there (not null)."""
        return {name: value for name in TRACED if (value := getattr(self, name)) is not None}

    @property
    def static(self) -> dict[str, Any]:
        """What must be the same for two runs to share one compiled program, plain enough for JSON."""
        shapes = {name: len(value) if isinstance(value, tuple) else 1 for name, value in self.traced.items()}
        return {**self.model_dump(mode="json", exclude=set(TRACED)), "traced": shapes}

    @property
    def unroll_size(self) -> int:
        """Environment steps in one unroll of all lanes."""
        return self.lanes * self.unroll_steps

    @property
    def unrolls(self) -> int:
        """Unrolls in the whole run; never more steps than `steps`."""
        return self.steps // self.unroll_size

    @property
    def unrolls_per_climb(self) -> int:
        """What the flights of one update by the analytic gradient take of the run's steps."""
        return -(-self.apg_lanes * self.apg_steps // self.unroll_size)

    @property
    def climbs(self) -> int:
        """Updates by the analytic gradient, at the run's end."""
        return int(self.unrolls * self.apg_fraction) // self.unrolls_per_climb

    @property
    def learning_unrolls(self) -> int:
        """Unrolls that are made and learnt from; the rest of the run's steps are the climbs'."""
        return self.unrolls - self.climbs * self.unrolls_per_climb

    def work(self, first: int, last: int) -> float:
        """What there is to do from `first` to `last` unrolls, in steps flown or learnt from."""
        replayed = self.updates_per_unroll * self.minibatch_lanes / self.lanes
        learning = min(last, self.learning_unrolls) - min(first, self.learning_unrolls)
        return self.unroll_size * ((last - first) + replayed * learning)

    def whole(self, unrolls: int) -> int:
        """`unrolls`, or where it lies among the climbs, the end of the climb in which it lies."""
        into = max(0, unrolls - self.learning_unrolls)
        return unrolls + -into % self.unrolls_per_climb if into else unrolls

    @property
    def unrolls_per_report(self) -> int:
        return max(1, -(-self.unrolls // self.reports))


TRACED = tuple(name for name, field in Config.model_fields.items() if "traced" in field.metadata)


def load_preset(name: str) -> dict[str, Any]:
    """The learner's defaults laid under the preset `name` ("default" for a task without one of its own)."""
    folder = resources.files("qrl").joinpath("presets")
    data = json.loads(folder.joinpath("default.json").read_text(encoding="utf-8"))
    if name != "default":
        data |= json.loads(folder.joinpath(f"{name}.json").read_text(encoding="utf-8"))
    return data


def preset_names() -> list[str]:
    folder = resources.files("qrl").joinpath("presets")
    return sorted(entry.name.removesuffix(".json") for entry in folder.iterdir() if entry.name.endswith(".json"))
