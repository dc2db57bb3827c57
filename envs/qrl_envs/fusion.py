"""What a compiler computes once.

XLA fuses a value into each of its uses, where it is computed anew for each number. On a CPU that can cost more than all
else; an optimization barrier does not help, for it is gone before XLA fuses. A call that is not inlined does.
"""

from typing import Any

import jax
from jax.experimental.xla_metadata import set_xla_metadata

# With nothing in it JAX would drop the call.
_same = jax.jit(jax.lax.optimization_barrier)


def stored(x: Any) -> Any:
    """`x`, any pytree of arrays, computed once where JAX's default backend is a CPU, and its cotangent too;
    elsewhere as the compiler likes.
    """
    if jax.default_backend() != "cpu":
        return x
    with set_xla_metadata(inlineable="false"):
        return _same(x)
