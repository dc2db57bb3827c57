# What the type checker reads in place of chex's own annotations. chex.Array is there a union with NumPy's
# scalars, on which neither indexing nor a minus is defined; in compiled code it is always a jax.Array.
from typing import Any

import jax

Array = jax.Array
PRNGKey = jax.Array
Numeric = jax.Array | float
ArrayTree = Any

def __getattr__(name: str) -> Any: ...
