# What the type checker reads in place of brax.envs.base. Brax declares its own physics state, though any pytree
# will do; allows dictionaries as observations, which qrl does not take; and hides `replace` from checkers.
from typing import Any

import jax

class State:
    pipeline_state: Any
    obs: jax.Array
    reward: jax.Array
    done: jax.Array
    metrics: dict[str, jax.Array]
    info: dict[str, Any]
    def __init__(
        self,
        pipeline_state: Any,
        obs: jax.Array,
        reward: jax.Array,
        done: jax.Array,
        metrics: dict[str, jax.Array] = ...,
        info: dict[str, Any] = ...,
    ) -> None: ...
    def replace(self, **changes: Any) -> State: ...

class Env:
    def reset(self, rng: jax.Array) -> State: ...
    def step(self, state: State, action: jax.Array) -> State: ...
    @property
    def observation_size(self) -> int: ...
    @property
    def action_size(self) -> int: ...
    @property
    def backend(self) -> str: ...
    @property
    def unwrapped(self) -> Env: ...

class Wrapper(Env):
    env: Env
    def __init__(self, env: Env) -> None: ...

def __getattr__(name: str) -> Any: ...
