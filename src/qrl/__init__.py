"""From a task to a policy that flies from a microcontroller.

    import qrl

    run = qrl.train("hover", out="runs/hover")  # or qrl.load("runs/hover")
    action = run.policy(observation)

Each name is imported when it is used: `import qrl` alone loads neither JAX nor Brax.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from qrl.api import Run, load, train
    from qrl.config import Config

__all__ = ["Config", "Run", "load", "train"]


def __getattr__(name: str) -> Any:
    if name == "Config":
        from qrl.config import Config

        return Config
    if name in __all__:
        from qrl import api

        return getattr(api, name)
    raise AttributeError(f"module 'qrl' has no attribute '{name}'")


def __dir__() -> list[str]:
    return [*globals(), *__all__]
